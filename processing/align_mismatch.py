"""Binary sections laid over each other so that they differ least: the Ex-OR area over shift and turn.

|A ⊕ B| = |A| + |B| − 2 |A ∩ B|, each taken where both pictures are seen, so that three correlations give it for all
whole shifts at once; between pixels it is measured on masks whose pixels are partly covered. It rises on both sides of
its minimum in nearly straight lines, which are fitted and meet at the minimum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from processing.align_models import in_pixels
from processing.align_start import signed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

COARSE_SIDE = 128
NEAR_DEG, ALL_DEG = np.arange(-15.0, 15.1, 2.5), np.arange(-180.0, 180.0, 2.5)
GOOD = 0.5  # of what chance leaves: only a worse place has all turns tried
PARTED = 0.8  # share of the variance between dark and bright from which a picture is as good as binary
UNEVEN = 16  # times the width of what is taken for light
LEAST_OVERLAP = 0.4
SOFT_PX = 0.7
CURVE_PX = np.arange(-8.0, 9.0)
CURVE_DEG = np.arange(-4.0, 4.25, 0.5)
SIDE_STEPS = 4  # steps from the lowest point that a side of the curve is fitted to
AXES = ("x", "y", "turn")
ROUNDS = 4
DONE = 0.02  # steps of the curve
WORST = 0.8  # of what chance leaves is no match


@dataclass(frozen=True)
class Mismatch:
    """The best way to lay a binary picture on another.

    Attributes
    ----------
    matrix : array (3, 3)
        Shift and turn from pixels of the first to those of the second.
    least : float
        Ex-OR area over the area both show: 0 the same; `chance` says what pictures of different things have.
    curves : dict of str to array (steps, 2)
        For x, y (pixels) and turn (degrees): offset from the best, mismatch.
    """

    matrix: Array
    least: float
    curves: dict[str, Array]


def binaries(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the masks of what is rarer in both pictures, dark or bright; (h, w) bool each.

    Otsu's threshold (1979); where it does not part two kinds of pixels well, unevenness of the light is taken away
    first.
    """
    masks = tuple(_thresholded(picture) for picture in (first, second))
    rare = float(np.mean([mask.mean() for mask in masks])) <= 0.5
    return (masks[0], masks[1]) if rare else (~masks[0], ~masks[1])


def _thresholded(picture: Array) -> Array:
    mask, parted = _otsu(picture)
    if parted >= PARTED:
        return mask
    width = max(picture.shape) / UNEVEN
    return _otsu(cv2.GaussianBlur(picture, (0, 0), 1.0) - cv2.GaussianBlur(picture, (0, 0), width))[0]


def _otsu(picture: Array) -> tuple[Array, float]:
    """Return the mask of what is bright, and the share of the variance that lies between both kinds."""
    low, high = float(picture.min()), float(picture.max())
    eight = np.rint((picture - low) * (255 / max(high - low, 1e-9))).astype(np.uint8)
    limit, _ = cv2.threshold(eight, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    mask, share = eight > limit, float((eight > limit).mean())
    if not 0 < share < 1:
        return mask, 0.0
    apart = float(eight[mask].mean() - eight[~mask].mean())
    return mask, share * (1 - share) * apart**2 / max(float(eight.var()), 1e-9)


def least_mismatch(first: Array, second: Array, *, turn: bool = True) -> Mismatch | None:
    """Find the shift and turn under which two masks differ least.

    Parameters
    ----------
    first, second : array (height, width) bool
        Of one shape.
    turn : bool
        Whether to turn as well as to shift.

    Returns
    -------
    Mismatch or None
        None when a mask is empty or full, or nothing is better than chance.
    """
    if not all(0 < mask.mean() < 1 for mask in (first, second)):
        return None
    one, other = (np.asarray(cv2.GaussianBlur(m.astype(np.float32), (0, 0), SOFT_PX)) for m in (first, second))
    place, least = coarse_place(one, other, NEAR_DEG if turn else np.zeros(1))
    if turn and least > GOOD * chance(first, second):
        place, least = coarse_place(one, other, ALL_DEG)
    curves: dict[str, Array] = {}
    for _ in range(ROUNDS):
        before = place.copy()
        for axis in range(3 if turn else 2):
            place, curves[AXES[axis]] = lowered(one, other, place, axis)
        if np.abs(place - before).max() < DONE:
            break
    least = mismatch(one, other, place)
    return None if least > WORST * chance(first, second) else Mismatch(placed(place, first.shape), least, curves)


def chance(first: Array, second: Array) -> float:
    """Return the mismatch of two masks that have nothing to do with each other."""
    a, b = float(first.mean()), float(second.mean())
    return a + b - 2 * a * b


def placed(place: Array, shape: tuple[int, ...]) -> Array:
    """Return the map of a shift (x, y) in pixels and a turn in degrees about the middle of the first picture."""
    angle, half = np.radians(place[2]), max(shape[:2]) / 2
    cosine, sine = np.cos(angle), np.sin(angle)
    return in_pixels(np.array([[cosine, -sine, place[0] / half], [sine, cosine, place[1] / half], [0, 0, 1]]), shape)


def mismatch(first: Array, second: Array, place: Array) -> float:
    """Return the Ex-OR area of masks with partly covered pixels, over the area both show; 1 where that is too small."""
    matrix = placed(place, first.shape)[:2]
    size, flags = first.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen, moved = (cv2.warpAffine(m, matrix, size, flags=flags) for m in (np.ones_like(second), second))
    both = float(seen.sum())
    return float((seen * np.abs(first - moved)).sum()) / both if both >= LEAST_OVERLAP * first.size else 1.0


def coarse_place(first: Array, second: Array, turns_deg: Array) -> tuple[Array, float]:
    """Return the whole shift and the turn of least mismatch at low resolution, in pixels and degrees, and the least."""
    factor = min(1.0, COARSE_SIDE / max(first.shape))
    one, other = (
        np.asarray(cv2.resize(m, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)) for m in (first, second)
    )
    best, found = float("inf"), np.zeros(3)
    for turn in turns_deg:
        surface = all_shifts(one, other, float(turn))
        y, x = np.unravel_index(int(surface.argmin()), surface.shape)
        if surface[y, x] < best:
            shift = np.array([signed(int(x), surface.shape[1]), signed(int(y), surface.shape[0]), 1.0])
            turned = placed(np.array([0, 0, turn]), one.shape)
            best, found = float(surface[y, x]), np.array([*(turned[:2, :2] @ shift[:2] / factor), turn])
    return found, best


def all_shifts(first: Array, second: Array, turn_deg: float) -> Array:
    """Return the mismatch of two small masks for every whole shift at one turn; 1 where they share too little."""
    matrix = placed(np.array([0, 0, turn_deg]), first.shape)[:2]
    size, flags = first.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved, seen = (cv2.warpAffine(m, matrix, size, flags=flags) for m in (second, np.ones_like(second)))
    period = tuple(cv2.getOptimalDFTSize(2 * n) for n in first.shape)
    mask, whole = (np.conj(np.fft.rfft2(m, period)) for m in (first, np.ones_like(first)))
    other, there = (np.fft.rfft2(m, period) for m in (moved, seen))
    differ = np.fft.irfft2(mask * there + whole * other - 2 * mask * other, period)
    both = np.fft.irfft2(whole * there, period)
    return np.where(both >= LEAST_OVERLAP * first.size, differ / np.maximum(both, 1), 1.0)


def lowered(first: Array, second: Array, place: Array, axis: int) -> tuple[Array, Array]:
    """Move one of x, y and turn to the minimum of its curve; returns the curve about the new place, too."""
    offsets = CURVE_DEG if axis == 2 else CURVE_PX
    values = np.array([mismatch(first, second, place + offset * np.eye(3)[axis]) for offset in offsets])
    best = meeting(offsets, values)
    moved = place + best * np.eye(3)[axis]
    return moved, np.column_stack([offsets - best, values])


def meeting(offsets: Array, values: Array) -> float:
    """Return where the straight sides of a V-shaped curve meet; its lowest point where a side is missing."""
    low = int(values.argmin())
    left, right = offsets[:low][::-1][:SIDE_STEPS], offsets[low + 1 :][:SIDE_STEPS]
    if min(left.size, right.size) < 2:
        return float(offsets[low])
    sides = [np.polyfit(o, values[np.searchsorted(offsets, o)], 1) for o in (left, right)]
    slope = sides[1][0] - sides[0][0]
    met = (sides[0][1] - sides[1][1]) / slope if slope > 0 else offsets[low]
    return float(np.clip(met, offsets[low - 1], offsets[low + 1]))
