"""Single ways of laying one section on another, for users who want one of them and nothing else.

Each is a function of two views and a model that returns the map as it finds it; no refinement follows. How well the
pictures then agree is judged like any other match, on a coarse picture: these ways are right to a pixel or so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import cv2
import numpy as np

from processing.align_mismatch import NEAR_DEG, binaries, coarse_place, least_mismatch, placed
from processing.align_models import about_centre, fitted, nearest_in_pixels
from processing.align_pair import NO_MATCH, Fit, Match, View, between_sizes, one_step
from processing.align_start import features, match, shifted

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.align_models import Model

    Array = NDArray[Any]
    Way = Callable[[View, View, Model], Array | None]

Method = Literal["auto", "centroids", "mismatch", "phase", "fourier-mellin", "features"]
METHODS: tuple[Method, ...] = get_args(Method)
JUDGED_LEVEL = 1  # of the pictures from the coarsest
SMALLEST_FEATURE_PX = 12
SIZES_ALIKE = 2.0  # ratio of the areas of one feature in two sections
ROUNDS = 12
LOG_POLAR = 256  # angles and radii of a spectrum
LOWEST_RESPONSE = 0.02


def matcher(method: Method) -> Callable[[View, View, Model, Array | None], Match]:
    """Return the function that matches two views by a method; auto tries several and refines."""
    if method == "auto":
        return match
    if method == "mismatch":
        return by_mismatch
    way = WAYS[method]
    return lambda first, second, model, _: judged(first, second, model, way(first, second, model), method)


def judged(first: View, second: View, model: Model, found: Array | None, name: str) -> Match:
    """Return how well two views agree under a map, which stays as it is."""
    if found is None:
        return NO_MATCH
    level = min(JUDGED_LEVEL, len(first.levels) - 1)
    a, b = first.levels[level], second.levels[level]
    inside = about_centre(between_sizes(found, first.shape, a.shape), a.shape)
    fit = Fit(1.0, 0.0)
    for _ in range(3):  # gain and offset, and with them which pixels have a say
        step = one_step(a, b, inside, fit, model)
        if step is None:
            return NO_MATCH
        fit = step[1]
    scale = max(first.shape) / max(a.shape)
    seen = fit.judged(found, a, b)
    return replace(seen, error_px=seen.error_px * scale, start=name)


def by_centroids(first: View, second: View, model: Model) -> Array | None:
    """Minimise the sum of squared distances between the centroids of features both show (TECHNIQUES B1).

    Features are connected parts of the binary picture. Beginning with the least mismatch at low resolution, each is
    paired with the nearest of like area; maps and pairs are found in turn until they stay (Besl and McKay 1992,
    iterated closest points).
    """
    masks = binaries(first.grey, second.grey)
    if any(mask.all() or not mask.any() for mask in masks):
        return None
    source, target = (centroids(mask) for mask in masks)
    if min(len(source), len(target)) < 1:
        return None
    shape, soft = first.grey.shape, tuple(np.asarray(mask, np.float32) for mask in masks)
    matrix = placed(coarse_place(soft[0], soft[1], np.zeros(1) if model == "translation" else NEAR_DEG)[0], shape)
    for _ in range(ROUNDS):
        pairs = same_features(matrix, source, target, reach=max(shape) / 20)
        if len(pairs) < {"translation": 1, "rigid": 3, "similarity": 3}.get(model, 6):
            return None
        new = fitted(model, source[pairs[:, 0], :2], target[pairs[:, 1], :2])
        if np.abs(new - matrix).max() < 1e-6:
            break
        matrix = new
    return between_sizes(matrix, shape, first.shape)


def centroids(mask: Array) -> Array:
    """Return centroid and area of every feature that does not touch the border, (features, 3) as x, y, pixels."""
    count, _, stats, places = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    x, y, width, height, area = stats[1:count].T
    inside = (x > 0) & (y > 0) & (x + width < mask.shape[1]) & (y + height < mask.shape[0])
    whole = inside & (area >= SMALLEST_FEATURE_PX)
    return np.column_stack([places[1:count][whole], area[whole]])


def same_features(matrix: Array, source: Array, target: Array, reach: float) -> Array:
    """Return pairs (i, j) of features that are nearest to each other under a map, within reach and of like area."""
    moved = source[:, :2] @ matrix[:2, :2].T + matrix[:2, 2]
    apart = np.linalg.norm(moved[:, None] - target[None, :, :2], axis=2)
    unlike = np.abs(np.log(source[:, None, 2] / target[None, :, 2])) > np.log(SIZES_ALIKE)
    apart[unlike | (apart > reach)] = np.inf
    nearest_to = apart.argmin(axis=1)
    mutual = apart.argmin(axis=0)[nearest_to] == np.arange(len(source))
    good = mutual & np.isfinite(apart.min(axis=1))
    return np.column_stack([np.flatnonzero(good), nearest_to[good]])


def by_phase(first: View, second: View, _model: Model) -> Array | None:
    """Shift of highest phase correlation, between pixels (Kuglin and Hines 1975; centroid of the peak)."""
    window = cv2.createHanningWindow(first.grey.shape[::-1], cv2.CV_32F)
    (x, y), response = cv2.phaseCorrelate(first.grey, second.grey, window)
    return between_sizes(shifted(x, y), first.grey.shape, first.shape) if response >= LOWEST_RESPONSE else None


def by_fourier_mellin(first: View, second: View, model: Model) -> Array | None:
    """Turn and scale from the shift between log-polar spectra, then the shift by phase (Reddy and Chatterji 1996).

    A spectrum looks alike when turned by half a turn; the phase correlation tells which of both it is.
    """
    shape = first.grey.shape
    a, b = (log_polar_spectrum(view.grey) for view in (first, second))
    (along, around), _ = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F))
    scale = 1.0 if model in {"rigid", "translation"} else float(np.exp(-along * np.log(min(shape) / 2) / LOG_POLAR))
    turn = around * 180.0 / LOG_POLAR
    tried = [_shift_after(first.grey, second.grey, turned_and_scaled(turn + half, scale, shape)) for half in (0, 180)]
    response, found = max(tried, key=lambda pair: pair[0])
    return between_sizes(found, shape, first.shape) if response >= LOWEST_RESPONSE else None


def log_polar_spectrum(picture: Array) -> Array:
    """Return the magnitude of the spectrum over angle (rows, half a turn) and the logarithm of frequency (columns)."""
    window = cv2.createHanningWindow(picture.shape[::-1], cv2.CV_32F)
    side = max(picture.shape)
    square = np.zeros((side, side), np.float32)
    square[: picture.shape[0], : picture.shape[1]] = (picture - picture.mean()) * window
    spectrum = np.fft.fftshift(np.log1p(np.abs(np.fft.fft2(square)))).astype(np.float32)
    y, x = np.ogrid[-0.5 : 0.5 : side * 1j, -0.5 : 0.5 : side * 1j]
    high_pass = 1 - (np.cos(np.pi * x) * np.cos(np.pi * y)) ** 2
    angle = np.arange(LOG_POLAR)[:, None] * np.pi / LOG_POLAR
    radius = np.exp(np.arange(LOG_POLAR) * np.log(min(picture.shape) / 2) / LOG_POLAR)[None, :]
    columns, rows = (side // 2 + radius * trig(angle) for trig in (np.cos, np.sin))
    flat = (spectrum * high_pass).astype(np.float32)
    return np.asarray(cv2.remap(flat, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR))


def turned_and_scaled(turn_deg: float, scale: float, shape: tuple[int, ...]) -> Array:
    """Return the map that turns and enlarges a picture about its middle, in pixels."""
    found = np.eye(3)
    found[:2] = cv2.getRotationMatrix2D(((shape[1] - 1) / 2, (shape[0] - 1) / 2), -turn_deg, scale)
    return found


def _shift_after(first: Array, second: Array, turn: Array) -> tuple[float, Array]:
    seen = cv2.warpAffine(second, turn[:2], first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (x, y), response = cv2.phaseCorrelate(first, seen, window)
    return float(response), turn @ shifted(x, y)


def by_features(first: View, second: View, model: Model) -> Array | None:
    """Map of the model next to the affine map of features both show (SIFT, Lowe 2004, random sample consensus)."""
    found = features(first, second)
    return None if found is None else nearest_in_pixels(model, found, first.shape)


def by_mismatch(first: View, second: View, model: Model, _predicted: Array | None = None) -> Match:
    """Least Ex-OR area of the binary pictures over shift and turn (TECHNIQUES B2), with its curves."""
    found = least_mismatch(*binaries(first.grey, second.grey), turn=model != "translation")
    if found is None:
        return NO_MATCH
    matrix = between_sizes(found.matrix, first.grey.shape, first.shape)
    return replace(judged(first, second, model, matrix, "mismatch"), curves=found.curves, mismatch=found.least)


WAYS: dict[Method, Way] = {
    "centroids": by_centroids,
    "phase": by_phase,
    "fourier-mellin": by_fourier_mellin,
    "features": by_features,
}
