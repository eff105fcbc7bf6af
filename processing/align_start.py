"""Where one section lies on another, roughly: starts for the refinement, each a function of two views.

A start is right when it is within a few pixels of the coarsest picture. They are tried from the cheapest to the
dearest, and what the refinement makes of each is judged by how well the pictures agree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from processing.align_models import frame
from processing.align_pair import NO_MATCH, Match, View, between_sizes, refined

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.align_models import Model

    Array = NDArray[Any]
    Start = Callable[[View, View], Array | None]

NEAR_DEG, NEAR_STEP_DEG = 15.0, 3.0
ALL_STEP_DEG = 4.0
FEATURES, RATIO, MISFIT_PX = 2000, 0.8, 4.0
FEWEST_FEATURES = 12
SURE = 0.6  # correlation from which no other start is tried


def match(first: View, second: View, model: Model, predicted: Array | None = None) -> Match:
    """Lay the second section on the first.

    Parameters
    ----------
    first, second : View
        Of the same shape.
    model : Model
        Maps allowed.
    predicted : array (3, 3), optional
        A map to begin with, in pixels; used when it proves right.

    Returns
    -------
    Match
        The best found, by the correlation of what both show; ``believed`` says whether it is a match at all.
    """
    best = NO_MATCH
    if predicted is not None:
        best = refined(first, second, predicted, model, "predicted", levels=2)
    for name, start in STARTS.items():
        if best.believed and best.correlation >= SURE:
            break
        found = start(first, second)
        if found is not None:
            best = max(best, _through_all(first, second, found, model, name), key=_quality)
        if best.believed and name in {"features", "correlation at any angle"}:
            break
    return best


def _through_all(first: View, second: View, start: Array, model: Model, name: str) -> Match:
    """Refine from the coarsest picture, first within the maps that cannot run away."""
    return refined(first, second, start, model, name, levels=len(first.levels))


def _quality(found: Match) -> tuple[bool, float]:
    return found.believed, found.correlation


def turned_correlation(first: View, second: View, angles_deg: Array) -> Array:
    """Return the rigid map of highest correlation among all shifts at the given angles (TECHNIQUES B3)."""
    a, b = first.levels[0], second.levels[0]
    size = tuple(cv2.getOptimalDFTSize(2 * n) for n in a.shape)
    spectrum = np.conj(np.fft.rfft2(a, size))
    best, found = -np.inf, np.eye(3)
    for angle in angles_deg:
        turn = turned(float(angle), a.shape)
        seen = cv2.warpAffine(b, turn[:2], a.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        surface = np.fft.irfft2(spectrum * np.fft.rfft2(seen, size), size)
        y, x = np.unravel_index(int(surface.argmax()), surface.shape)
        if surface[y, x] > best:
            best, found = surface[y, x], turn @ shifted(signed(int(x), size[1]), signed(int(y), size[0]))
    return between_sizes(found, a.shape, first.shape)


def signed(offset: int, period: int) -> int:
    """Return a shift found by Fourier transforms, which count backward ones from the other end."""
    return offset - period if offset > period // 2 else offset


def turned(angle_deg: float, shape: tuple[int, ...]) -> Array:
    """Rotation about the middle of a picture, in pixels."""
    to_frame, angle = frame(shape), np.radians(angle_deg)
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return np.asarray(np.linalg.inv(to_frame) @ turn @ to_frame)


def shifted(x: float, y: float) -> Array:
    """Shift by (x, y) pixels."""
    matrix = np.eye(3)
    matrix[:2, 2] = x, y
    return matrix


def near_correlation(first: View, second: View) -> Array:
    """Correlation over all shifts and rotations up to 15°."""
    return turned_correlation(first, second, np.arange(-NEAR_DEG, NEAR_DEG + 1, NEAR_STEP_DEG))


def any_correlation(first: View, second: View) -> Array:
    """Correlation over all shifts and rotations."""
    return turned_correlation(first, second, np.arange(-180, 180, ALL_STEP_DEG))


def ecc(first: View, second: View) -> Array | None:
    """Enhanced correlation coefficient through the scales (Evangelidis and Psarakis 2008), as OpenCV has it."""
    parameters = cv2.ECCParameters()
    parameters.motionType = cv2.MOTION_AFFINE
    try:
        _, found = cv2.findTransformECCMultiScale(first.small, second.small, np.eye(2, 3, dtype=np.float32), parameters)
    except cv2.error:  # it says so when it does not converge
        return None
    return between_sizes(np.vstack([found, [0, 0, 1]]).astype(np.float64), first.small.shape, first.shape)


def features(first: View, second: View) -> Array | None:
    """Affine map of the features both show (SIFT, Lowe 2004), by random sample consensus."""
    finder = cv2.SIFT.create(FEATURES)
    (points_a, a), (points_b, b) = (finder.detectAndCompute(eight_bit(v.small), None) for v in (first, second))
    if min(len(points_a), len(points_b)) < FEWEST_FEATURES:
        return None
    pairs = [p for p in cv2.BFMatcher().knnMatch(a, b, k=2) if len(p) == 2]
    good = [near for near, next_ in pairs if near.distance < RATIO * next_.distance]
    if len(good) < FEWEST_FEATURES:
        return None
    source = np.array([points_a[m.queryIdx].pt for m in good])
    target = np.array([points_b[m.trainIdx].pt for m in good])
    found, inside = cv2.estimateAffine2D(source, target, method=cv2.RANSAC, ransacReprojThreshold=MISFIT_PX)
    if int(inside.sum()) < FEWEST_FEATURES:
        return None
    return between_sizes(np.vstack([found, [0, 0, 1]]), first.small.shape, first.shape)


def eight_bit(picture: Array) -> Array:
    """Return a picture stretched to 8 bit."""
    low, high = float(picture.min()), float(picture.max())
    return np.asarray(np.rint((picture - low) * (255 / max(high - low, 1e-9))), np.uint8)


STARTS: dict[str, Start] = {
    "correlation": near_correlation,
    "ECC": ecc,
    "features": features,
    "correlation at any angle": any_correlation,
}
