"""Operators on range images: median, smoothing, rolling ball, levelling, filling of holes.

A range image is (height, width) float32 in µm or planes; NaN, or a confidence under the threshold, means that nothing
is known there. Unknown pixels have no say in the others' values, and stay unknown unless they are filled.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from devices.errors import InputError
from processing.compiled import compiled
from processing.operators import Layer, like, operator

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[Any]

CONFIDENT = 0.8
TUKEY = 3 * 1.4826  # times the median absolute residual
LEVEL_STEPS = 12
BALL_PX = 8.0  # larger balls roll over an image that is reduced to this radius
UNKNOWN = 1e-6


@operator("range.median", gives=[like("range")])
def median(range_: Array, *, side_px: int = 5) -> Array:
    """Median of a square window: single wrong pixels go, steps stay.

    Parameters
    ----------
    range_ : array (height, width) float32
        NaN where nothing is known.
    side_px : int
        Side of the window, odd.

    Returns
    -------
    array float32
        NaN where it was.

    Raises
    ------
    InputError
        ``operator-params``: an even or negative side.
    """
    if side_px < 1 or side_px % 2 == 0:
        raise _refused(f"range.median: a window of {side_px} pixels has no middle", "side_px=3, 5, 7 …")
    whole = _bridged(range_)
    return np.where(np.isnan(range_), np.float32(np.nan), _median_of(whole, side_px))


def _median_of(whole: Array, side_px: int) -> Array:
    if side_px in {3, 5}:
        return cv2.medianBlur(whole, side_px)
    from scipy.ndimage import median_filter  # noqa: PLC0415  a second, which filling holes does without

    return np.asarray(median_filter(whole, side_px, mode="nearest"))


def _gaussian_reach(params: Mapping[str, Any]) -> tuple[int, ...]:
    return (int(np.ceil(4 * params["sigma_px"])) + 1,) * 2


@operator("range.smooth", gives=[like("range")], halo=_gaussian_reach)
def smooth(range_: Array, confidence: Array | None = None, *, sigma_px: float = 2.0) -> Array:
    """Gaussian mean, weighted by the confidence where there is one.

    Parameters
    ----------
    range_, confidence : array (height, width) float32
        NaN where nothing is known.
    sigma_px : float
        Standard deviation of the window.

    Returns
    -------
    array float32
        Normalised convolution Σ w r / Σ w (Knutsson and Westin 1993); NaN where it was.

    Raises
    ------
    InputError
        ``operator-params``: a sigma that is not positive.
    """
    if not sigma_px > 0:
        raise _refused(f"range.smooth: a window of {sigma_px:g} pixels is none", "sigma_px=2")
    known = np.isfinite(range_)
    weight = known * np.float32(1) if confidence is None else np.where(known, confidence, 0).astype(np.float32)
    weight = np.maximum(weight, UNKNOWN * known)
    blurred = cv2.GaussianBlur(np.stack([weight * np.where(known, range_, 0), weight], -1), (0, 0), sigma_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known, blurred[..., 0] / blurred[..., 1], np.nan).astype(np.float32)


@operator("range.level", gives=[like("range"), Layer("plane_fit", dtype="float64")])
def level(
    range_: Array,
    confidence: Array | None = None,
    pixel_um: float | None = None,
    *,
    least: float = CONFIDENT,
) -> tuple[Array, Array]:
    """Heights from the plane that fits the surface best.

    Parameters
    ----------
    range_, confidence : array (height, width) float32
        NaN where nothing is known.
    pixel_um : float, optional
        Size of a pixel; slopes are per pixel without it.
    least : float
        Pixels of less confidence have no say in the plane.

    Returns
    -------
    array (height, width) float32, array (3,) float64
        Range minus plane; the plane's value in the middle of the field, and its slopes along x and y.

    Raises
    ------
    InputError
        ``range-unknown``: fewer than three pixels are known.

    Notes
    -----
    Least squares with Tukey's weights at 3 robust standard deviations, so that pits and bumps do not tilt the plane.
    """
    sure = np.isfinite(range_) & (True if confidence is None else confidence >= least)
    if sure.sum() < 3:
        raise _nothing_known("a plane")
    size = pixel_um or 1.0
    y, x = ((np.arange(n) - (n - 1) / 2) * size for n in range_.shape)
    columns = np.stack([np.ones(range_.shape), *np.broadcast_arrays(x, y[:, np.newaxis])], -1)
    fit = robust_plane(columns[sure], range_[sure].astype(np.float64))
    return (range_ - columns @ fit).astype(np.float32), fit


def robust_plane(columns: Array, values: Array) -> NDArray[np.float64]:
    """Coefficients of least squares with Tukey's weights, iterated from the plain fit."""
    weight = np.ones(values.size)
    fit = np.zeros(columns.shape[1])
    for _ in range(LEVEL_STEPS):
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(columns * root[:, np.newaxis], values * root, rcond=None)[0]
        residual = np.abs(values - columns @ fit)
        scale = TUKEY * float(np.median(residual))
        weight = np.clip(1 - (residual / scale) ** 2, 0, 1) ** 2 if scale > 0 else weight
    return fit


@operator("range.rolling_ball", gives=[like("range"), like("background", "range")])
def rolling_ball(
    range_: Array,
    *,
    radius_px: float,
    height: float | None = None,
    side: Literal["below", "above"] = "below",
) -> tuple[Array, Array]:
    """Heights from the surface that a ball rolled along it reaches: the coarse shape goes, what is finer stays.

    Parameters
    ----------
    range_ : array (height, width) float32
        NaN where nothing is known.
    radius_px : float
        Radius of the ball in the plane; choose it larger than what shall stay.
    height : float
        Its radius along z in the unit of the range; ``radius_px`` times a fifth of a robust slope when left out.
    side : {"below", "above"}
        Where the ball rolls.

    Returns
    -------
    array float32, array float32
        Range minus background, and the background; NaN where the range was.

    Raises
    ------
    InputError
        ``operator-params``: a radius or height that is not positive.

    Notes
    -----
    The grey opening by a half ellipsoid (Sternberg 1983). For radii above 8 pixels, of an image reduced by minima and
    enlarged again linearly: the background may then lie lower than the exact one, by the relief within a reduced pixel.
    """
    if not radius_px > 0 or (height is not None and not height > 0):
        raise _refused("range.rolling_ball: radius and height must be positive", "radius_px=50:height=10")
    sign = np.float32(1 if side == "below" else -1)
    whole = sign * _bridged(range_)
    factor = max(1, int(np.ceil(radius_px / BALL_PX)))
    reduced = block_minima(whole, factor)
    tall = usual_height(whole, radius_px) if height is None else height
    rolled = ball_opening(reduced, half_ellipsoid(radius_px / factor, tall))
    background = sign * np.minimum(enlarged(rolled, factor, whole.shape), whole)
    background = np.where(np.isnan(range_), np.float32(np.nan), background)
    return range_ - background, background


def usual_height(whole: Array, radius_px: float) -> float:
    """Height of a ball that is flat enough to bridge what is finer, and curved enough to follow the coarse shape."""
    slope = np.percentile(np.abs(np.diff(cv2.GaussianBlur(whole, (0, 0), radius_px / 2), axis=1)), 90)
    return max(float(slope) * radius_px / 5, 1e-3 * float(np.ptp(whole)), 1e-9)


def half_ellipsoid(radius: float, height: float) -> NDArray[np.float32]:
    """Upper half of a ball of that radius and height, -inf beside it."""
    reach = int(np.ceil(radius))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = 1 - (x * x + y * y) / radius**2
    return np.where(inside >= 0, height * np.sqrt(np.maximum(inside, 0)), -np.inf).astype(np.float32)


@compiled
def _rolled(image: Array, ball: Array, sign: float, out: Array) -> None:
    """Erosion (sign -1) or dilation (sign 1) by a non-flat window; pixels outside the image have no say."""
    reach, turned = ball.shape[0] // 2, np.float32(sign)
    height, width = image.shape
    for i in range(height):
        for j in range(width):
            best = np.float32(-np.inf)
            for a in range(max(-reach, -i), min(reach, height - 1 - i) + 1):
                for b in range(max(-reach, -j), min(reach, width - 1 - j) + 1):
                    best = max(best, turned * image[i + a, j + b] + ball[reach + a, reach + b])
            out[i, j] = turned * best


def ball_opening(image: Array, ball: Array) -> NDArray[np.float32]:
    """Grey opening of ``image`` by a symmetric non-flat window."""
    eroded, opened = np.empty_like(image), np.empty_like(image)
    _rolled(image, ball, -1.0, eroded)
    _rolled(eroded, ball, 1.0, opened)
    return opened


def block_minima(image: Array, factor: int) -> NDArray[np.float32]:
    """Smallest value of each block of ``factor``² pixels; blocks at the rim may be smaller."""
    rows = np.minimum.reduceat(image, np.arange(0, image.shape[0], factor), axis=0)
    return np.ascontiguousarray(np.minimum.reduceat(rows, np.arange(0, image.shape[1], factor), axis=1), np.float32)


def enlarged(image: Array, factor: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Enlarge by a whole factor, linearly, block centres kept, cut to ``shape``."""
    if factor == 1:
        return image
    whole = cv2.resize(image, (image.shape[1] * factor, image.shape[0] * factor), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[: shape[0], : shape[1]])


@operator("range.fill", gives=[like("range"), like("filled", "range", dtype="bool")])
def fill(
    range_: Array,
    confidence: Array | None = None,
    *,
    least: float = CONFIDENT,
) -> tuple[Array, Array]:
    """Fill what is not known from what is known around it, and mark it.

    Parameters
    ----------
    range_, confidence : array (height, width) float32
        NaN where nothing is known.
    least : float
        Pixels of less confidence are replaced, too.

    Returns
    -------
    array float32, array bool
        Range, known pixels untouched; and where it was filled.

    Raises
    ------
    InputError
        ``range-unknown``: no pixel is known.

    Notes
    -----
    Push-pull (Gortler and others 1996): means of what is known, level by level down to one pixel, then back up, each
    level taking the coarser one only where it knows nothing itself.
    """
    known = np.isfinite(range_) & (True if confidence is None else confidence >= least)
    if not known.any():
        raise _nothing_known("holes")
    return np.where(known, range_, push_pull(np.where(known, range_, 0), known)), ~known


def push_pull(values: Array, known: Array) -> NDArray[np.float32]:
    """Values (height, width) float32 with all that is not known taken from coarser levels."""
    if known.all() or values.size == 1:
        return values
    coarse_shape = tuple((n + 1) // 2 for n in values.shape)
    even = [(0, 2 * c - n) for c, n in zip(coarse_shape, values.shape, strict=True)]
    total, count = (
        np.pad(a.astype(np.float32), even).reshape(coarse_shape[0], 2, coarse_shape[1], 2).sum((1, 3))
        for a in (values * known, known)
    )
    coarse = push_pull(total / np.maximum(count, 1), count > 0)
    return np.where(known, values, enlarged(coarse, 2, values.shape)).astype(np.float32)


def _bridged(values: Array) -> NDArray[np.float32]:
    """Return the range without NaN: bridged from around, so that windows can be laid over holes."""
    known = np.isfinite(values)
    if not known.any():
        raise _nothing_known("anything")
    whole = values.astype(np.float32)
    return whole if known.all() else push_pull(np.where(known, whole, 0), known)


def _nothing_known(what: str) -> InputError:
    return InputError(
        f"the range image knows too little for {what}.",
        why="Every pixel is NaN, or less sure than the threshold.",
        fix="lower the threshold: least=0.3; or look at the stack: texture, contrast, exposure",
        code="range-unknown",
    )


def _refused(what: str, example: str) -> InputError:
    return InputError(f"{what}.", fix=f"for example {example}", code="operator-params")
