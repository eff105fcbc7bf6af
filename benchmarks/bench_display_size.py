"""What pictures of volumes cost: the first one of 512³ beside reading its file, memory, and time against size.

``python benchmarks/bench_display_size.py [FOLDER]`` writes ``display-cost.csv`` and ``display-cost.png`` into a folder,
docs/pictures when left out. Ends with 1 when a limit is missed.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile

from display.gl.renderer import Renderer
from display.load import as_volume, load_volume
from display.modes import find_mode
from display.render import picture
from display.scene import Layer, Scene, View
from display.view import MOVING_PIXELS

FOLDER = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent.parent / "docs" / "pictures"
SIDE, SIZE = 512, (1024, 768)
SIDES, WINDOWS = (64, 128, 192, 256, 384, 512), (256, 512, 768, 1024)
MODES = ("mip", "translucent", "first")
FIRST_LIMIT, MEMORY_LIMITS = 3.0, {"cpu": 5.0, "gl": 1.5}
ROUNDS = 3


def specimen(side: int) -> np.ndarray:
    """Shells over faint noise: what a microscope sees of cells."""
    rng = np.random.default_rng(5)
    volume = rng.integers(0, 12, (side, side, side), np.uint8)
    grid = np.arange(side, dtype=np.float32)
    for _ in range(40):
        centre, radius = rng.uniform(0.1, 0.9, 3) * side, rng.uniform(0.03, 0.08) * side
        low, high = np.maximum(centre - radius - 2, 0).astype(int), np.minimum(centre + radius + 3, side).astype(int)
        z, y, x = (grid[a:b] - c for a, b, c in zip(low, high, centre, strict=True))
        shell = 230 * np.exp(-((np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2) - radius) ** 2) / 2)
        part = volume[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        np.maximum(part, shell.astype(np.uint8), out=part)
    return volume


def scene_of(volume, mode: str) -> Scene:
    return Scene((Layer(volume, mode, find_mode(mode).look()),), View(30, 20))


def resident() -> int:
    """Return the bytes this process has in memory now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def opened(link, path: Path, executor: str, mode: str) -> None:
    """Read a file and draw it as the commands do; tell what each took, and the memory beyond an empty program's."""
    renderer = Renderer(executor=executor)
    for moving in (False, True):
        renderer.canvas.moving = moving
        picture(renderer, scene_of(as_volume(specimen(32)), mode), (64, 48))  # kernels and shaders are there
    renderer.end_frame()
    empty = resident()
    forget(path)
    begin = time.perf_counter()
    path.read_bytes()
    reading = time.perf_counter() - begin
    forget(path)
    begin = time.perf_counter()
    volume = load_volume(path)
    renderer.canvas.moving = True
    picture(renderer, scene_of(volume, mode), SIZE, coarse=MOVING_PIXELS)  # what `view` shows first
    first = time.perf_counter() - begin
    renderer.canvas.moving = False
    picture(renderer, scene_of(volume, mode), SIZE)
    memory = (resident() - empty) / volume.bands[0].values.nbytes
    link.send((reading, first, time.perf_counter() - begin, memory))


def forget(path: Path) -> None:
    """Have a file come from the disk when it is read next."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def asked(*arguments):
    """Run `opened` in a process of its own."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=opened, args=(there, *arguments))
    process.start()
    answer = here.recv()
    process.join()
    return answer


def first_pictures() -> bool:
    kept = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "volume.tif"
        tifffile.imwrite(path, specimen(SIDE), photometric="minisblack")
        for executor, memory_limit in MEMORY_LIMITS.items():
            for mode in ("mip", "translucent"):
                answers = [asked(path, executor, mode) for _ in range(ROUNDS)]
                reading, first, still, memory = (sorted(part)[ROUNDS // 2] for part in zip(*answers, strict=True))
                limit = FIRST_LIMIT if executor == "cpu" else float("inf")  # its rasteriser draws slowly here
                met = first / reading <= limit and memory <= memory_limit
                kept &= met
                print(
                    f"{SIDE}³ uint8, {mode}, executor {executor}: bare reading {reading:.2f} s, first picture after "
                    f"{first:.2f} s = {first / reading:.1f} times (limit {limit:g}), exact one after {still:.2f} s; "
                    f"memory {memory:.2f} times the volume (limit {memory_limit:g}){'' if met else ': MISSED'}",
                    flush=True,
                )
    return kept


def cpu_ms(renderer: Renderer, scene: Scene, size: tuple[int, int]) -> float:
    """Return the CPU time of one picture, the least of some."""
    renderer.draw(scene, size)
    best = float("inf")
    for _ in range(ROUNDS):
        begin = time.process_time()
        renderer.draw(scene, size)
        best = min(best, time.process_time() - begin)
    return 1e3 * best


def costs() -> list[dict[str, object]]:
    """Return what a picture costs for volumes of several sizes at one window, and windows of several at one volume."""
    rows: list[dict[str, object]] = []
    with Renderer() as renderer:
        for side, window in [(side, 512) for side in SIDES] + [(256, window) for window in WINDOWS if window != 512]:
            volume = as_volume(specimen(side))
            for mode in MODES:
                for moving in (False, True):
                    if moving and mode == "first":
                        continue  # the same
                    renderer.canvas.moving = moving
                    used = cpu_ms(renderer, scene_of(volume, mode), (window, window))
                    name = f"{mode}, moving" if moving else mode
                    rows.append({"side": side, "window": window, "mode": name, "cpu_ms": round(used, 1)})
                    print(f"  {side}³ to {window}², {name}: {used:.0f} CPU-ms", flush=True)
            renderer.end_frame()
    return rows


def draw(rows: list[dict[str, object]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for name in dict.fromkeys(str(row["mode"]) for row in rows):
        for axes, fixed, varied in ((left, ("window", 512), "side"), (right, ("side", 256), "window")):
            chosen = sorted(
                (row[varied], row["cpu_ms"]) for row in rows if row["mode"] == name and row[fixed[0]] == fixed[1]
            )
            axes.loglog(*zip(*chosen, strict=True), "o-", markersize=4, label=name)
    for axes, label, ticks in (
        (left, "voxels along a side, at 512² pixels", SIDES),
        (right, "pixels along a side, of 256³ voxels", WINDOWS),
    ):
        axes.set_xlabel(label)
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.grid(visible=True, alpha=0.3)
    left.set_ylabel("CPU time of a picture, ms")
    right.legend(fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    fine = first_pictures()
    table = costs()
    with (FOLDER / "display-cost.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    draw(table, FOLDER / "display-cost.png")
    sys.exit(0 if fine else 1)
