"""Operators on volumes beside SciPy, scikit-image and ITK in one run: CPU seconds, and whether the results agree.

``python benchmarks/peers/bench_volumes.py [side [word]]``, 256 when left out; a word chooses among the rows. Each
function is called once before, then ours and the peers' twice each in turn; the smaller time counts. Ends with 1 when a
limit is missed.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import SimpleITK as sitk  # noqa: N813  as its own pages call it
from scipy import ndimage
from skimage.filters import rank
from skimage.segmentation import flood, watershed

from processing import morphology, volume_filters
from processing.distance import distance
from processing.growing import region
from processing.labels import components
from processing.masks import fill_holes
from processing.watershed import flood_downhill, summits_of

if TYPE_CHECKING:
    from collections.abc import Callable

    Call = Callable[[], Any]

SIDE = int(sys.argv[1]) if len(sys.argv) > 1 else 256
WORD = sys.argv[2] if len(sys.argv) > 2 else ""
SEED = 2026
FEWEST, MOST, ENOUGH_S = 2, 7, 60.0
CUBE = np.ones((3, 3, 3), bool)
CROSS = ndimage.generate_binary_structure(3, 1)


@dataclass(frozen=True)
class Row:
    """One operator, its peers, how the first peer's result is compared, and what is wanted."""

    name: str
    ours: Call
    peers: dict[str, Call]
    limit: float
    agree: float = 1.0


def cpu_seconds(call: Call) -> tuple[float, Any]:
    begin = time.process_time()
    result = call()
    return time.process_time() - begin, result


def in_turn(calls: dict[str, Call]) -> dict[str, float]:
    """Least CPU seconds of each; all are called in turn, so that whatever else the machine does meets them alike."""
    turns: list[dict[str, float]] = []
    while len(turns) < FEWEST or (len(turns) < MOST and sum(sum(turn.values()) for turn in turns) < ENOUGH_S):
        turns.append({name: cpu_seconds(call)[0] for name, call in calls.items()})
    return {name: min(turn[name] for turn in turns) for name in calls}


def as_array(result: Any) -> np.ndarray:
    return sitk.GetArrayFromImage(result) if isinstance(result, sitk.Image) else np.asarray(result)


def agreement(ours: Any, peer: Any, inside: slice) -> float:
    """Share of voxels that are equal; real numbers within a hundred-thousandth."""
    a, b = (as_array(r)[inside, inside, inside] for r in (ours, peer))
    if a.dtype.kind == "f" or b.dtype.kind == "f":
        return float(np.isclose(a, b, rtol=1e-5, atol=1e-4).mean())
    return float((a == b).mean())


def rows() -> list[Row]:
    """All operators that were promised to be faster."""
    noise = np.random.default_rng(SEED).normal(size=(SIDE,) * 3).astype(np.float32)
    smooth = ndimage.gaussian_filter(noise, 3)
    smooth /= smooth.std()
    grey = np.clip(128 + 40 * smooth + 8 * noise, 0, 255).astype(np.uint8)
    real = grey.astype(np.float32)
    mask = smooth > 0
    heights = np.rint(16 * distance(mask)).astype(np.uint16)
    markers = summits_of(heights, 26, 16)
    depth = -distance(mask)
    seed = tuple(int(i) for i in np.unravel_index(smooth.argmax(), smooth.shape))
    image, image32 = sitk.GetImageFromArray(grey), sitk.GetImageFromArray(real)
    bits = sitk.GetImageFromArray(mask.astype(np.uint8))
    basins = sitk.GetImageFromArray(markers)
    hills = sitk.GetImageFromArray(depth)
    tolerance = 110.0  # a third of the volume
    top = float(grey[seed])
    return [
        Row("median, 26 neighbours", lambda: volume_filters.median(grey), {
            "SciPy": lambda: ndimage.median_filter(grey, 3, mode="nearest"),
            "scikit-image": lambda: rank.median(grey, CUBE),
            "ITK": lambda: sitk.Median(image, (1, 1, 1)),
        }, 20),
        Row("Sobel", lambda: volume_filters.sobel(grey), {
            "SciPy": lambda: np.sqrt(sum(ndimage.sobel(real, i, mode="nearest") ** 2 for i in range(3))) / 32,
            "ITK": lambda: sitk.SobelEdgeDetection(image32),
        }, 15),
        Row("variance, 26 neighbours", lambda: volume_filters.variance(grey), {
            "SciPy": lambda: ndimage.uniform_filter(real * real, 3, mode="nearest")
            - ndimage.uniform_filter(real, 3, mode="nearest") ** 2,
            "ITK": lambda: sitk.Noise(image32, (1, 1, 1)),
        }, 15, 0.0),
        Row("erosion, 26 neighbours", lambda: morphology.erode(grey), {
            "SciPy": lambda: ndimage.grey_erosion(grey, 3, mode="nearest"),
            "ITK": lambda: sitk.GrayscaleErode(image, (1, 1, 1), sitk.sitkBox),
        }, 10),
        Row("distance map", lambda: distance(mask), {
            "SciPy": lambda: ndimage.distance_transform_edt(mask),
            "ITK": lambda: sitk.SignedMaurerDistanceMap(bits, True, False, False),
        }, 4),
        Row("labels, 6 neighbours", lambda: components(mask, rule=6)[0], {
            "SciPy": lambda: ndimage.label(mask)[0],
            "ITK": lambda: sitk.ConnectedComponent(bits, False),
        }, 2),
        Row("labels, 26 neighbours", lambda: components(mask, rule=26)[0], {
            "SciPy": lambda: ndimage.label(mask, CUBE)[0],
            "ITK": lambda: sitk.ConnectedComponent(bits, True),
        }, 2),
        Row("fill holes", lambda: fill_holes(mask) > 0, {
            "SciPy": lambda: ndimage.binary_fill_holes(mask),
            "ITK": lambda: sitk.BinaryFillhole(bits, False, 1),
        }, 1),
        Row("watershed from markers, 6", lambda: flood_downhill(heights, markers, 6), {
            "scikit-image": lambda: watershed(depth, markers, connectivity=CROSS, mask=mask),
            "ITK": lambda: sitk.MorphologicalWatershedFromMarkers(hills, basins, False, False),
        }, 3, 0.999),
        Row("watershed from markers, 26", lambda: flood_downhill(heights, markers, 26), {
            "scikit-image": lambda: watershed(depth, markers, connectivity=CUBE, mask=mask),
            "ITK": lambda: sitk.MorphologicalWatershedFromMarkers(hills, basins, False, True),
        }, 3, 0.999),
        Row("region growing", lambda: region(grey, seed=seed, tolerance=tolerance, rule=6) > 0, {
            "scikit-image": lambda: flood(grey, seed, connectivity=1, tolerance=tolerance),
            "ITK": lambda: sitk.ConnectedThreshold(image, [seed[::-1]], top - tolerance, min(top + tolerance, 255)),
        }, 3),
    ]  # fmt: skip


def main() -> int:
    """Print the table; returns 1 when a limit is missed."""
    missed = False
    print(f"{SIDE}³, CPU seconds\n")
    print("| | ours | SciPy | scikit-image | ITK | best of them / ours | wanted | equal to the first |")
    print("|---" * 8 + "|")
    for row in (row for row in rows() if WORD in row.name):
        calls = {"ours": row.ours, **row.peers}
        results = {name: call() for name, call in calls.items()}
        seconds = in_turn(calls)
        best = min(seconds[name] for name in row.peers)
        equal = agreement(results["ours"], results[next(iter(row.peers))], slice(1, -1))
        ratio = best / seconds["ours"]
        wrong = ratio < row.limit or equal < row.agree
        missed |= wrong
        cells = [
            f"{seconds[name]:.3g}" if name in seconds else "–" for name in ("ours", "SciPy", "scikit-image", "ITK")
        ]
        said = f"{ratio:.1f}{' missed' if wrong else ''}"
        print(f"| {row.name} | {' | '.join(cells)} | {said} | {row.limit:g} | {equal:.6f} |", flush=True)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
