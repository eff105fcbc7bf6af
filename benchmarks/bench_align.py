"""How right the alignment of sections is, beside pystackreg and elastix on the same pictures in the same run.

Run: ``STEREOTOME_DATA=DIR STEREOTOME_PEERS=PYTHON python benchmarks/bench_align.py``; PYTHON is the interpreter of an
environment with the dependency group ``peers``, without which their rows are left out. Prints a table and a line of
JSON; ends with 1 when a limit is missed. No parameter was chosen on these seeds: those were 7001 and below, and 9001 to
9505 were looked at.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import tifffile
from sections_scene import Sections, sections

from devices.errors import InputError
from processing.align_fiducials import Marks
from processing.align_mark_search import find_marks
from processing.align_models import applied, deformation, distance_px, fitted, grid
from processing.align_pair import view
from processing.align_report import resampled
from processing.align_stack import Alignment, SectionAligner
from processing.align_start import match
from processing.align_trend import drift

Row = tuple[str, float, str]
SIDE = 512
SHAPE = (SIDE, SIDE)
PAIR_SEEDS, STACK_SEED, LEANING_SEED, TWISTED_SEED = (9601, 9602, 9603, 9604), 9611, 9621, 9631
GROSS_PX = 1.0
MARK_ERROR_PX = 0.05
PLACES = np.array([(0.15, 0.14), (0.84, 0.18), (0.17, 0.83), (0.82, 0.86)]) * (SIDE - 1)
PEERS = Path(__file__).with_name("peers") / "align_peers.py"


def main() -> int:
    rows = [*pairs(), *whole_stack(), *leaning(), *twisted()]
    if data := os.environ.get("STEREOTOME_DATA"):
        rows += misaligned(Path(data))
    print(f"{'what':<72} {'measured':>10}  limit")
    for name, value, limit in rows:
        print(f"{name:<72} {value:>10.4g}  {limit}{'' if kept(value, limit) else '  MISSED'}")
    print(json.dumps({"benchmark": "align", **{name: value for name, value, _ in rows}}))
    return 0 if all(kept(value, limit) for _, value, limit in rows) else 1


def kept(value: float, limit: str) -> bool:
    if not limit:
        return True
    relation, number = limit.split()
    return value <= float(number) if relation == "<=" else value >= float(number)


def true_steps(scene: Sections) -> list[np.ndarray]:
    return [b @ np.linalg.inv(a) for a, b in pairwise(scene.matrices)]


def pairs() -> list[Row]:
    ours: list[float] = []
    theirs: dict[str, list[float]] = {}
    seconds: dict[str, float] = {"": 0.0}
    for seed in PAIR_SEEDS:
        scene = sections(seed, 26)
        found, took = own_pairs(scene)
        ours += errors(found, scene)
        seconds[""] += took
        for name, answer in peers(scene).items():
            theirs.setdefault(name, []).extend(errors(answer["matrices"], scene))
            seconds[name] = seconds.get(name, 0.0) + answer["seconds"]
    rows = described("pairs", ours, seconds[""], ("<= 0.05", "<= 0", "<= 80"))
    for name, off in theirs.items():
        rows += described(f"pairs, {name}", off, seconds[name], ("", "", ""))
    return rows


def described(name: str, off: list[float], seconds: float, limits: tuple[str, str, str]) -> list[Row]:
    return [
        (f"{name}: mean error, px", float(np.mean(off)), limits[0]),
        (f"{name}: worst, px", float(np.max(off)), ""),
        (f"{name}: wrong by more than a pixel, of {len(off)}", float(np.sum(np.array(off) > GROSS_PX)), limits[1]),
        (f"{name}: CPU, ms a pair", 1e3 * seconds / len(off), limits[2]),
    ]


def own_pairs(scene: Sections) -> tuple[list[np.ndarray], float]:
    match(view(scene.images[0]), view(scene.images[1]), "affine")  # compiled, loaded
    start = time.process_time()
    views = [view(image) for image in scene.images]
    found = [match(a, b, "affine").matrix for a, b in pairwise(views)]
    return found, time.process_time() - start


def errors(found: list[np.ndarray], scene: Sections) -> list[float]:
    return [distance_px(np.asarray(m), true, SHAPE) for m, true in zip(found, true_steps(scene), strict=True)]


def peers(scene: Sections, *names: str) -> dict[str, dict]:
    python = os.environ.get("STEREOTOME_PEERS")
    if not python:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "scene.npz", images=scene.images)
        command = [python, str(PEERS), str(Path(folder) / "scene.npz"), *names]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(said.splitlines()[-1])


def aligned(scene: Sections, marks: Marks | None = None) -> Alignment:
    aligner = SectionAligner("affine")
    for image in scene.images:
        aligner.add(image)
    return aligner.finish(0, marks.rows("affine", 0) if marks else ())


def known_marks(scene: Sections, seed: int) -> Marks:
    seen = scene.marks + np.random.default_rng(seed).normal(0, MARK_ERROR_PX, scene.marks.shape)
    return Marks(seen, PLACES, MARK_ERROR_PX)


def stack_error_px(matrices: list[np.ndarray], scene: Sections) -> float:
    """Mean error of all sections once one affine map of the whole output is taken away."""
    points = grid(SHAPE)
    block = np.array([applied(np.linalg.inv(t) @ m, points) for t, m in zip(scene.matrices, matrices, strict=True)])
    return float(np.linalg.norm(levelled(block, points) - points, axis=2).mean())


def levelled(block: np.ndarray, points: np.ndarray) -> np.ndarray:
    count = len(block)
    common = fitted("affine", block.reshape(-1, 2), np.tile(points, (count, 1)))
    return applied(common, block.reshape(-1, 2)).reshape(block.shape)


def compression_rms(matrices: list[np.ndarray], scene: Sections) -> float:
    points = grid(SHAPE)
    block = np.array([applied(np.linalg.inv(t) @ m, points) for t, m in zip(scene.matrices, matrices, strict=True)])
    common = fitted("affine", np.tile(points, (len(block), 1)), block.reshape(-1, 2))
    found = [deformation(m @ np.linalg.inv(common)).compression for m in matrices]
    return float(np.sqrt(np.mean((np.array(found) - scene.compression) ** 2)))


def whole_stack() -> list[Row]:
    scene = sections(STACK_SEED, 50, marks=False)
    free = list(aligned(scene).matrices)
    rows = [
        ("stack of 50, no marks: mean error, px", stack_error_px(free, scene), "<= 0.35"),
        ("stack of 50, no marks: compression, rms", compression_rms(free, scene), "<= 0.002"),
    ]
    for name, answer in peers(scene, "pystackreg affine").items():
        rows.append((f"stack of 50, {name} chained: mean error, px", stack_error_px(chained(answer), scene), ""))
    fixed = aligned(scene, known_marks(scene, 1))
    found = [distance_px(m, t, SHAPE) for m, t in zip(fixed.matrices, scene.matrices, strict=True)]
    bent = [s.deformation.compression for s in fixed.sections] - scene.compression
    rows += [
        ("stack of 50, four marks of 0.05 px each: mean error, px", float(np.mean(found)), "<= 0.06"),
        ("stack of 50, marks: compression, rms", float(np.sqrt(np.mean(bent**2))), "<= 0.002"),
    ]
    return rows


def chained(answer: dict) -> list[np.ndarray]:
    found = [np.eye(3)]
    for step in answer["matrices"]:
        found.append(np.asarray(step) @ found[-1])
    return found


def leaning() -> list[Row]:
    return own_shape("inclined cylinder", sections(LEANING_SEED, 30, marks=True, lean_px=0.5))


def twisted() -> list[Row]:
    return own_shape("twisted prism", sections(TWISTED_SEED, 30, marks=True, twist_deg=0.3))


def own_shape(name: str, scene: Sections) -> list[Row]:
    """How far a shape is bent that a stack with marks must leave as it is; a section is as thick as a pixel is wide."""
    free = aligned(scene)
    lean = turn = float("nan")  # refused: no limit is kept
    with suppress(InputError):
        marks = find_marks(list(scene.images), free.matrices, 0)
        lean, turn = bent_deg(list(aligned(scene, marks).matrices), scene)
    moved = drift(list(free.matrices), SHAPE)
    return [
        (f"{name}, marks found by itself: axis off, degrees", lean, "<= 0.2"),
        (f"{name}, marks found by itself: twist off, degrees over the stack", turn, "<= 0.2"),
        (f"{name}, no marks: warned that it is not unique", float("not unique" in moved.words(30)), ">= 1"),
        (f"{name}, no marks: steady drift stands out of the jitter", float(moved.seen), ""),
    ]


def bent_deg(matrices: list[np.ndarray], scene: Sections) -> tuple[float, float]:
    moved = [np.linalg.inv(t) @ m for t, m in zip(scene.matrices, matrices, strict=True)]
    middle = np.array([applied(m, np.full((1, 2), SIDE / 2))[0] for m in moved])
    turns = [deformation(m).rotation_deg for m in moved]
    place = np.arange(len(moved))
    slope = np.polyfit(place, middle, 1)[0]
    return float(np.degrees(np.arctan(np.hypot(*slope)))), float(abs(np.polyfit(place, turns, 1)[0]) * len(moved))


def misaligned(data: Path) -> list[Row]:
    """Real sections put out of place by known maps."""
    folder = data / "sections_misaligned"
    images = tifffile.imread(next(folder.glob("*.tif")))
    crop = np.array([[1, 0, 25], [0, 1, 25], [0, 0, 1.0]])
    taken = json.loads((folder / "truth" / "transforms.json").read_text(encoding="utf-8"))["sections"]
    truth = [np.linalg.inv(np.vstack([s["matrix_out_xy_to_src_xy"], [0, 0, 1]])) @ crop for s in taken]
    places = np.array([(20.0, 25.0), (170.0, 30.0), (25.0, 175.0), (178.0, 168.0)])
    noise = np.random.default_rng(2).normal(0, 0.1, (len(images), 4, 2))
    seen = np.array([applied(t, places) for t in truth]) + noise
    aligner = SectionAligner("rigid")
    for image in images:
        aligner.add(image)
    free = aligner.finish()
    fixed = aligner.finish(0, Marks(seen, places, 0.1).rows("rigid", 0))
    whole = next((data / "fibsem_medulla").glob("*.tif"))
    still = SectionAligner("rigid")
    for image in tifffile.imread(whole)[: len(images), 25:225, 25:225]:
        still.add(image)
    own = [t @ s.matrix for t, s in zip(truth, still.finish().sections, strict=True)]
    shape = images.shape[1:]
    return [
        ("sections_misaligned, marks of 0.1 px: mean error, px", mean_px(fixed.matrices, truth, shape), "<= 0.3"),
        ("sections_misaligned, marks: correlation of neighbours", alike(images, fixed), ">= 0.95"),
        ("sections_misaligned, no marks: steps, px", mean_px(steps(free.matrices), steps(truth), shape), ""),
        (
            "sections_misaligned, no marks: steps beside those of the undisturbed sections, px",
            mean_px(steps(free.matrices), steps(own), shape),
            "<= 0.3",
        ),
        ("sections_misaligned, no marks: correlation of neighbours", alike(images, free), ">= 0.95"),
    ]


def steps(matrices: list[np.ndarray] | np.ndarray) -> list[np.ndarray]:
    return [b @ np.linalg.inv(a) for a, b in pairwise(matrices)]


def mean_px(found: list[np.ndarray] | np.ndarray, true: list[np.ndarray], shape: tuple[int, ...]) -> float:
    return float(np.mean([distance_px(a, b, shape) for a, b in zip(found, true, strict=True)]))


def alike(images: np.ndarray, found: Alignment) -> float:
    """Mean correlation of neighbours after alignment, where all sections show something."""
    stack = [resampled(image, m)[45:-45, 45:-45].ravel() for image, m in zip(images, found.matrices, strict=True)]
    return float(np.mean([np.corrcoef(a, b)[0, 1] for a, b in pairwise(stack)]))


if __name__ == "__main__":
    sys.exit(main())
