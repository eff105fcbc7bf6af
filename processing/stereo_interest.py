"""Where a picture is worth matching: interest operators, the points they find, and dark markers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

Interest = Literal["variance", "entropy", "high-pass", "zuniga-haralick"]

WINDOW_PX = 7
GREY_CLASSES = 16
PREBLUR_PX = 1.0
EDGE_PERCENT = 75.0  # an isophote has a curvature worth the name only where the gradient is among the strong ones
FACET = 2  # rows and columns to either side of a cubic facet
NEAR_PX = 5  # distance of points, at least
MOST_POINTS = 4000
MARKER_SIGMAS = 6.0
MARKER_BACKGROUND_PX = 15
SMALLEST_MARKER_PX = 4
NORMAL_MAD = 1.4826


def local_variance(image: Array, window_px: int = WINDOW_PX) -> Array:
    """Return the variance of the grey values in a square window, (height, width) float32."""
    grey = image.astype(np.float64)
    size = (window_px, window_px)
    mean = cv2.boxFilter(grey, -1, size)
    return np.maximum(cv2.boxFilter(grey * grey, -1, size) - mean * mean, 0).astype(np.float32)


def local_entropy(image: Array, window_px: int = WINDOW_PX) -> Array:
    """Return -Σ q log2 q of the grey values in a square window, in bits, 16 classes from darkest to brightest."""
    low, high = float(image.min()), float(image.max())
    classes = np.minimum((image - low) * (GREY_CLASSES / max(high - low, 1e-6)), GREY_CLASSES - 1).astype(np.uint8)
    bits = np.zeros(image.shape, np.float32)
    for grey in range(GREY_CLASSES):
        share = cv2.boxFilter((classes == grey).astype(np.float32), -1, (window_px, window_px))
        bits -= share * np.log2(np.maximum(share, 1e-9))
    return bits


def high_pass(image: Array, sigma_px: float = 2.0) -> Array:
    """Return how far each pixel differs from its smoothed surroundings, (height, width) float32."""
    grey = image.astype(np.float32)
    return np.asarray(np.abs(grey - cv2.GaussianBlur(grey, (0, 0), sigma_px)))


def cubic_facet(image: Array) -> tuple[Array, ...]:
    """Return k2 … k6 of the cubic k1 + k2 r + k3 c + k4 r² + k5 rc + k6 c² + … that fits 5×5 pixels best.

    r runs down, c to the right, in pixels from the centre; each array (height, width) float64.
    """
    side = np.arange(-FACET, FACET + 1.0)
    r, c = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    terms = np.stack([r**i * c**j for n in range(4) for i, j in ((n - m, m) for m in range(n + 1))], axis=1)
    kernels = np.linalg.pinv(terms).reshape(-1, side.size, side.size)
    return tuple(cv2.filter2D(image.astype(np.float64), -1, kernel) for kernel in kernels[1:6])


def isophote_curvature(image: Array) -> tuple[Array, Array]:
    """Return the curvature of the lines of equal grey, in 1/px, and the steepness, from the cubic facet.

    Along the unit tangent t = (-f_c, f_r)/|∇f| of an isophote its direction turns by -(tᵀ H t)/|∇f| per unit length, H
    the second derivatives 2 k4, k5, 2 k6. Hence -2 (k2² k6 - k2 k3 k5 + k3² k4) / (k2² + k3²)^(3/2): Zuniga and
    Haralick 1983 (Proc. IEEE CVPR, corner detection using the facet model). Negative around a dark spot; 0 where the
    image is flat.
    """
    k2, k3, k4, k5, k6 = cubic_facet(image)
    steep = np.hypot(k2, k3)
    above = -2 * (k2 * k2 * k6 - k2 * k3 * k5 + k3 * k3 * k4)
    return np.divide(above, steep**3, out=np.zeros_like(above), where=steep > 1e-9), steep


def zuniga_haralick(image: Array) -> Array:
    """Return how sharply isophotes turn where the image is steep, (height, width) float32: corners stand out."""
    curvature, steep = isophote_curvature(cv2.GaussianBlur(image.astype(np.float32), (0, 0), PREBLUR_PX))
    turn = np.minimum(np.abs(curvature), 1.0)  # tighter than a pixel is noise
    return np.where(steep >= np.percentile(steep, EDGE_PERCENT), turn * steep, 0).astype(np.float32)


OPERATORS: dict[Interest, Callable[[Array], Array]] = {
    "variance": local_variance,
    "entropy": local_entropy,
    "high-pass": high_pass,
    "zuniga-haralick": zuniga_haralick,
}


def interesting_points(image: Array, interest: Interest = "zuniga-haralick", *, near_px: int = NEAR_PX) -> Array:
    """Find the pixels where an operator is highest within ``near_px``, the strongest 4000 of them.

    Returns
    -------
    array (points, 2) float64
        x, y; down the rows.
    """
    strength = OPERATORS[interest](image)
    around = cv2.dilate(strength, np.ones((2 * near_px + 1,) * 2, np.uint8))
    inside = np.zeros(strength.shape, bool)
    inside[near_px:-near_px, near_px:-near_px] = True
    y, x = np.nonzero((strength == around) & (strength > 0) & inside)
    strongest = np.sort(np.argsort(strength[y, x])[::-1][:MOST_POINTS])
    return np.stack([x[strongest], y[strongest]], axis=1).astype(np.float64)


def dark_markers(image: Array, *, sigmas: float = MARKER_SIGMAS) -> Array:
    """Find small dark spots, such as gold particles, on an uneven background.

    Returns
    -------
    array (markers, 3) float64
        x and y of the centre of darkness, and the darkness summed over the spot.
    """
    grey = image.astype(np.float32)
    side = 2 * MARKER_BACKGROUND_PX + 1
    closed = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    smooth = cv2.GaussianBlur(grey, (0, 0), PREBLUR_PX)
    dark = cv2.GaussianBlur(closed, (0, 0), MARKER_BACKGROUND_PX / 2) - smooth
    middle = float(np.median(dark))
    spread = NORMAL_MAD * float(np.median(np.abs(dark - middle)))
    depth = np.maximum(dark - middle, 0)
    seen = (depth > max(sigmas * spread, 0.25 * float(depth.max()))).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(seen)
    whole = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= SMALLEST_MARKER_PX]
    return np.array([_centre(depth, labels, k, stats[k]) for k in whole], np.float64).reshape(-1, 3)


def _centre(depth: Array, labels: Array, k: int, box: Array) -> tuple[float, float, float]:
    x0, y0, width, height = (int(n) for n in box[:4])
    cut = (slice(y0, y0 + height), slice(x0, x0 + width))
    weight = np.where(labels[cut] == k, depth[cut], 0).astype(np.float64)
    y, x = np.mgrid[y0 : y0 + height, x0 : x0 + width]
    total = float(weight.sum())
    return float((weight * x).sum() / total), float((weight * y).sum() / total), total
