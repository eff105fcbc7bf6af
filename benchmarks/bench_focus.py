"""What extended focus and range cost, and how near they come to the truth.

Run: ``python benchmarks/bench_focus.py``. Times are CPU time of this process, beside what the simplest method costs on
the same planes (Laplacian energy in a Gaussian window, best plane so far). Errors are measured against the truth of a
rendered relief and, when STEREOTOME_DATA names the example data, of the published generated stacks, beside the modified
Laplacian with a log-parabola. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from processing.focus import FocusSweep, focus_stack
from sim.scenes.focus import scene

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SIDE = 1024
PLANES = 40
REPEATS = 5
LIMITS_GENERATED = {1: 0.13, 2: 0.13, 3: 0.16}
COLD = """
import time; start = time.perf_counter()
import numpy as np
from processing.focus import focus_stack
focus_stack(list(np.zeros((3, 64, 64), np.uint8)))
print(time.perf_counter() - start)
"""

Row = tuple[str, float, str]


def main() -> int:
    rows = [*cost(), *cold_start(), *rendered(), *generated()]
    print(f"{'what':<64} {'measured':>10}  limit")
    for name, value, limit in rows:
        print(f"{name:<64} {value:>10.4g}  {limit}{'' if kept(value, limit) else '  MISSED'}")
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    print(json.dumps({"benchmark": "focus", **machine, **{name: value for name, value, _ in rows}}))
    return 0 if all(kept(value, limit) for _, value, limit in rows) else 1


def kept(value: float, limit: str) -> bool:
    """Return whether a value keeps a limit written as ``<= 6``; an empty limit is always kept."""
    if not limit:
        return True
    relation, number = limit.split()
    return value <= float(number) if relation == "<=" else value >= float(number)


def cpu_ms(work: Callable[[], object]) -> float:
    """Median CPU milliseconds of all threads over a few repetitions, after a warm-up."""
    work()
    took = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        took.append(1000 * (time.process_time() - start))
    return statistics.median(took)


def moving_focus(dtype: type, bands: tuple[int, ...]) -> list[np.ndarray]:
    """Planes of a slope: every column is sharp in one of them."""
    grain = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (SIDE, SIDE, *bands)).astype(dtype)
    blurred = [cv2.GaussianBlur(grain, (0, 0), 0.5 + 0.5 * d) for d in range(PLANES)]
    columns = np.linspace(2, PLANES - 3, SIDE).round().astype(int)
    planes = []
    for k in range(PLANES):
        plane = np.empty_like(grain)
        for d in range(PLANES):
            plane[:, np.abs(columns - k) == d] = blurred[d][:, np.abs(columns - k) == d]
        planes.append(plane)
    return planes


def cost() -> Iterator[Row]:
    for dtype, bands, limit in ((np.uint8, (), "<= 6"), (np.uint16, (), "<= 6"), (np.uint8, (3,), "")):
        planes = moving_focus(dtype, bands)
        name = f"{np.dtype(dtype).name}{' colour' if bands else ''}"
        mega = SIDE * SIDE / 1e6
        sweep = FocusSweep((SIDE, SIDE))
        added = cpu_ms(lambda sweep=sweep, planes=planes: [sweep.add(p) for p in planes]) / PLANES / mega
        yield f"{name}: CPU ms per megapixel plane, add()", added, limit
        yield f"{name}: the same over the simplest method's", added / (naive_ms(planes) / mega), ""
        done = FocusSweep((SIDE, SIDE))
        for plane in planes:
            done.add(plane)
        yield f"{name}: bytes of state per pixel", done.state_bytes_per_pixel, "<= 20"
        yield f"{name}: CPU ms from last plane to range, {PLANES} planes", cpu_ms(done.finish), ""
        last = cpu_ms(lambda done=done, planes=planes: done.compose(planes, done.finish(), unit="plane"))
        yield f"{name}: CPU ms from last plane to range and extended focus", last, "<= 100"


def naive_ms(planes: list[np.ndarray]) -> float:
    """CPU ms per plane of Laplacian energy, Gaussian window and best plane so far."""

    def run() -> None:
        best = np.full((SIDE, SIDE), -1, np.float32)
        index = np.zeros((SIDE, SIDE), np.uint16)
        for k, plane in enumerate(planes):
            grey = plane if plane.ndim == 2 else cv2.cvtColor(plane, cv2.COLOR_RGB2GRAY)
            energy = cv2.GaussianBlur(cv2.Laplacian(grey, cv2.CV_32F) ** 2, (0, 0), 4)
            better = energy > best
            best[better], index[better] = energy[better], k

    return cpu_ms(run) / len(planes)


def cold_start() -> Iterator[Row]:
    """Seconds of a first use on a machine that never ran it, and of the next one."""
    with tempfile.TemporaryDirectory() as cache:
        for name, limit in (("first use ever, everything compiled", "<= 10"), ("first use of a process", "")):
            said = subprocess.run(
                [sys.executable, "-c", COLD],
                env={**os.environ, "NUMBA_CACHE_DIR": cache},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            yield f"seconds: {name}", float(said), limit


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error, dtype=np.float64))))


def rendered() -> Iterator[Row]:
    for seed in (1, 2):
        relief = scene(seed)
        result = focus_stack(list(relief.planes))
        psnr = 20 * np.log10(255 / rms(result.extended_focus - relief.sharp))
        yield f"relief {seed}: extended focus, PSNR in dB", psnr, ">= 44"
        nearest = np.take_along_axis(relief.planes, np.rint(relief.depth).astype(int)[None], 0)[0]
        yield f"relief {seed}: the same, true nearest plane", 20 * np.log10(255 / rms(nearest - relief.sharp)), ""
        error = result.range - relief.depth
        yield f"relief {seed}: range error in planes, rms", rms(error), "<= 1.1"
        yield f"relief {seed}: range error in planes, median", float(np.median(np.abs(error))), ""
        yield (
            f"relief {seed}: the same, rms, modified Laplacian",
            rms(modified_laplacian(relief.planes) - relief.depth),
            "",
        )


def generated() -> Iterator[Row]:
    data = os.environ.get("STEREOTOME_DATA")
    if not data:
        print("without STEREOTOME_DATA the published stacks are left out", file=sys.stderr)
        return
    folder = Path(data) / "focus_generated"
    for stack, limit in LIMITS_GENERATED.items():
        planes = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted((folder / f"stack{stack}").glob("*.jpg"))]
        with np.load(folder / "truth" / f"stack{stack}_depth_in_frames.npz") as truth:
            row, column = truth["crop_origin_rc"]
            depth = truth["depth_frames"]
        window = np.s_[row : row + depth.shape[0], column : column + depth.shape[1]]
        error = focus_stack(planes).range[window] - depth
        plain = rms(modified_laplacian(np.array(planes))[window] - depth)
        yield f"stack{stack}: range error in frames, rms", rms(error), f"<= {limit}"
        yield f"stack{stack}: bias in frames, absolute", abs(float(error.mean())), "<= 0.01"
        yield f"stack{stack}: rms over that of the modified Laplacian", rms(error) / plain, "<= 1"


def modified_laplacian(planes: np.ndarray) -> np.ndarray:
    """Range by the sum-modified Laplacian, Gaussian window of 3 pixels, log-parabola through three planes."""
    mask = np.float32([[-1, 2, -1]])
    energy = np.array(
        [
            cv2.GaussianBlur(
                np.abs(cv2.filter2D(p, cv2.CV_32F, mask)) + np.abs(cv2.filter2D(p, cv2.CV_32F, mask.T)), (0, 0), 3
            )
            for p in planes
        ]
    )
    best = np.clip(energy.argmax(axis=0), 1, len(planes) - 2)
    before, at, after = (np.log(np.take_along_axis(energy, (best + i)[None], 0)[0] + 1e-6) for i in (-1, 0, 1))
    bend = before - 2 * at + after
    return best + np.clip(np.where(bend < 0, (before - after) / (2 * np.minimum(bend, -1e-9)), 0), -0.5, 0.5)


if __name__ == "__main__":
    sys.exit(main())
