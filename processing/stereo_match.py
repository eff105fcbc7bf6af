"""Area matching of a stereo pair: the parallax of every pixel, how sure it is, and where there is none.

Lines of both views run along x; a point at column x of the left view lies at x - p in the right one, p its parallax.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from devices.errors import InputError
from processing import stereo_kernels as kernels

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Array = NDArray[Any]

SMALL_CHANGE, LARGE_CHANGE = 7, 86  # prices in differing comparisons, Hirschmüller's ratio for codes of this length
EDGE_GREY = 10.0  # of 255: a step in the image where a jump of parallax costs half
REACH_PX = 5  # of the window that refines: 11×11
TEAR_PX = 1.5  # neighbours that part by more belong to different surfaces
AGREEMENT_PX = 1.5
LEAST_RATIO = 0.02
LEAST_SIMILARITY = 0.2
WIDEST_SIGMA_PX = 1.0
LEAST_CONTRAST_GREY = 1.0  # of 255, standard deviation in a window
SPECKLE_PX = 50  # islands smaller than this are chance
OUTLIER_PX = 2.0
LOCAL_SIGMA_PX = 8.0
MEMORY_BYTES = 512_000_000
BYTES_PER_CANDIDATE = 3
OVERLAP_ROWS = 32
COARSE_SIDE_PX = 256
COARSE_BAND = 0.3  # of the width, to either side, when the user gives no band
BAND_MARGIN = 0.2
BAND_PERCENT = (0.5, 99.5)
SMALLEST_SIDE = 32
LEAST_SHARE = 0.35  # of all pixels that must match, or the views show different things
LEAST_MEDIAN_SIMILARITY = 0.45


@dataclass(frozen=True)
class ParallaxMap:
    """Parallax of the left view's pixels; all arrays (height, width).

    Attributes
    ----------
    parallax_px : array float32
        x_left - x_right; NaN where there is no match.
    sigma_px : array float32
        Its standard error from the scatter within the window; NaN where there is no match. What is wrong with the
        views themselves (distortion, light that turns with the specimen) is not in it.
    similarity : array float32
        Correlation coefficient of the matched windows; 0 where there is no match.
    band_px : (int, int)
        Lowest and highest parallax that were tried.
    """

    parallax_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    similarity: NDArray[np.float32]
    band_px: tuple[int, int]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where there is a parallax."""
        return np.isfinite(self.parallax_px)


def match_area(
    left: Array,
    right: Array,
    *,
    band_px: tuple[int, int] | None = None,
    reach_px: int = REACH_PX,
    progress: Callable[[float], None] | None = None,
) -> ParallaxMap:
    """Match two views by the looks of small areas.

    Each pixel's neighbourhood is coded by which neighbours are brighter, candidates within the band are compared and
    the costs smoothed along eight paths (semi-global matching, Hirschmüller 2008; census codes, Zabih and Woodfill
    1994). What the right view does not choose in its turn is left open: it is hidden in one of the views. A
    least-squares fit of a tilted window then gives the parallax between pixels and its error.

    Parameters
    ----------
    left, right : array (height, width) or (height, width, 3), uint8, uint16 or float
        The views; the same point lies in the same row of both.
    band_px : (int, int), optional
        Lowest and highest parallax; found at low resolution when left out.
    reach_px : int
        The window that refines is 2 × reach + 1 wide and high.
    progress : callable, optional
        Is told the share of the work done, 0 to 1.

    Raises
    ------
    InputError
        Views that differ in size, are too small, featureless, or show different things; a band that makes no sense.
    """
    left, right = prepared_pair(left, right)
    band = found_band(left, right) if band_px is None else checked_band(band_px, left.shape[1])
    parallax, sigma, similarity = (np.full(left.shape, np.nan, np.float32) for _ in range(3))
    for k, (inner, outer, count) in enumerate(row_bands(left.shape, band)):
        within = slice(inner.start - outer.start, inner.stop - outer.start)
        matched = _match_rows(left[outer], right[outer], band, reach_px)
        for whole, part in zip((parallax, sigma, similarity), matched, strict=True):
            whole[inner] = part[within]
        if progress is not None:
            progress((k + 1) / count)
    keep = without_outliers(parallax)
    found = ParallaxMap(_kept(parallax, keep), _kept(sigma, keep), np.where(keep, similarity, 0), band)
    return checked_match(found)


def prepared_pair(left: Array, right: Array) -> tuple[Array, Array]:
    """Return both views grey, float32 and on the scale 0 … 255 of the left one's 0.1 and 99.9 percentiles.

    Raises
    ------
    InputError
        As `match_area`.
    """
    if left.shape[:2] != right.shape[:2]:
        raise InputError(
            f"the views differ in size: {_size(left)} and {_size(right)} px.",
            fix="give two views of the same field at the same magnification.",
            code="stereo-size",
        )
    if min(left.shape[:2]) < SMALLEST_SIDE:
        raise InputError(
            f"views of {_size(left)} px are too small to be matched.",
            fix=f"give views of at least {SMALLEST_SIDE}×{SMALLEST_SIDE} px.",
            code="stereo-size",
        )
    return _scaled(left, "left"), _scaled(right, "right")


def _size(view: Array) -> str:
    return f"{view.shape[1]}×{view.shape[0]}"


def _scaled(view: Array, name: str) -> Array:
    grey = view.astype(np.float32) if view.ndim == 2 else view.astype(np.float32) @ np.full(3, 1 / 3, np.float32)
    if not np.isfinite(grey).all():
        raise InputError(
            f"the {name} view has pixels that are not numbers.",
            fix="replace them, for example by 0.",
            code="stack-nan",
        )
    low, high = np.percentile(grey, (0.1, 99.9))
    if high <= low:
        raise InputError(
            f"the {name} view shows nothing: all its pixels are {low:g}.",
            fix="check exposure and contrast; matching lives from texture.",
            code="stereo-featureless",
        )
    return np.asarray((grey - low) * (255 / (high - low)), np.float32)


def checked_band(band_px: tuple[int, int], width: int) -> tuple[int, int]:
    """Return the band if it has a width and leaves an overlap of the views, else raise `InputError`."""
    low, high = band_px
    if low < high and max(abs(low), abs(high)) < width:
        return low, high
    raise InputError(
        f"a band of parallax from {low} to {high} px makes no sense for views {width} px wide.",
        fix="give the lowest, then the highest parallax in pixels: --band-px -20 20",
        code="stereo-band",
    )


def found_band(left: Array, right: Array) -> tuple[int, int]:
    """Find the band of parallax at low resolution: what occurs there, and a margin.

    Raises
    ------
    InputError
        The views do not match anywhere.
    """
    shrink = max(1.0, max(left.shape) / COARSE_SIDE_PX)
    size = tuple(max(SMALLEST_SIDE, round(n / shrink)) for n in left.shape[::-1])
    small = [cv2.resize(v, size, interpolation=cv2.INTER_AREA) for v in (left, right)]
    widest = int(COARSE_BAND * size[0])
    parallax, _, similarity = _match_rows(small[0], small[1], (-widest, widest), REACH_PX)
    checked_match(ParallaxMap(parallax, parallax, similarity, (-widest, widest)))
    scale = left.shape[1] / size[0]
    low, high = np.nanpercentile(parallax, BAND_PERCENT) * scale
    margin = max(BAND_MARGIN * (high - low), 2 * scale)
    limit = left.shape[1] - 1
    return max(-limit, int(np.floor(low - margin))), min(limit, int(np.ceil(high + margin)))


def checked_match(found: ParallaxMap) -> ParallaxMap:
    """Return what was found, or raise `InputError` when it is no more than chance gives."""
    share = float(np.mean(found.valid))
    alike = float(np.median(found.similarity[found.valid])) if share else 0.0
    if share >= LEAST_SHARE and alike >= LEAST_MEDIAN_SIMILARITY:
        return found
    raise InputError(
        f"the views do not match: {share:.0%} of the pixels find a partner, of similarity {alike:.2f}.",
        why="They do not overlap, are turned or shifted against each other across the tilt, or show no texture.",
        fix=(
            "check that both show the same field and that the tilt axis runs along y (up and down the picture)",
            "give the band of parallax to look in: --band-px -40 40",
        ),
        code="stereo-no-match",
    )


def row_bands(shape: tuple[int, ...], band_px: tuple[int, int]) -> Iterator[tuple[slice, slice, int]]:
    """Cut the rows into bands that fit into memory: the rows of each, with those around them, and how many there are.

    Raises
    ------
    InputError
        Not even the rows that overlap fit; says what would be needed.
    """
    height, width = shape
    per_row = width * (band_px[1] - band_px[0] + 1) * BYTES_PER_CANDIDATE
    rows = MEMORY_BYTES // per_row
    if rows < min(height, 3 * OVERLAP_ROWS):
        raise InputError(
            f"matching views {width} px wide in a band of {band_px[1] - band_px[0] + 1} px takes "
            f"{per_row * 3 * OVERLAP_ROWS / 1e6:.0f} MB; {MEMORY_BYTES / 1e6:.0f} MB are allowed.",
            fix=("give a narrower band: --band-px -40 40", "cut the views, or halve them"),
            code="stereo-memory",
        )
    step = height if rows >= height else rows - 2 * OVERLAP_ROWS
    starts = range(0, height, step)
    for start in starts:
        stop = min(start + step, height)
        yield slice(start, stop), slice(max(start - OVERLAP_ROWS, 0), min(stop + OVERLAP_ROWS, height)), len(starts)


def _match_rows(left: Array, right: Array, band: tuple[int, int], reach_px: int) -> tuple[Array, Array, Array]:
    """Return parallax, its error and similarity of one band of rows."""
    best, ratio, of_right = cheapest(left, right, band)
    sure = mutual(best, of_right) & (ratio >= LEAST_RATIO)
    start = without_speckles(np.where(sure, best, np.float32(np.nan)))
    parallax, sigma, similarity = (np.empty_like(best) for _ in range(3))
    even = (evened(left), evened(right))
    kernels.refine(*even, start, reach_px, TEAR_PX, parallax, sigma, similarity)
    partner = np.arange(left.shape[1]) - parallax
    keep = (similarity >= LEAST_SIMILARITY) & (sigma <= WIDEST_SIGMA_PX) & textured(left, reach_px)
    keep &= (partner >= 0) & (partner <= left.shape[1] - 1)
    return _kept(parallax, keep), _kept(sigma, keep), np.where(keep, similarity, np.float32(0))


def _kept(values: Array, keep: Array) -> Array:
    return np.where(keep, values, np.float32(np.nan))


def cheapest(left: Array, right: Array, band: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Return the parallax of least cost of each left pixel, its lead over the runner-up, and of each right pixel."""
    costs = np.empty((*left.shape, band[1] - band[0] + 1), np.uint8)
    kernels.census_costs(census_codes(left), census_codes(right), band[0], costs)
    total = np.zeros(costs.shape, np.uint16)
    for turn in (slice(None), slice(None, None, -1)):
        turned = [a[turn, turn] for a in (costs, left, total)]
        kernels.add_paths(turned[0], turned[1], SMALL_CHANGE, LARGE_CHANGE, EDGE_GREY, turned[2])
    best, ratio, of_right = (np.empty(left.shape, np.float32) for _ in range(3))
    kernels.winners(total, band[0], best, ratio, of_right)
    return best, ratio, of_right


def census_codes(view: Array) -> Array:
    """Return the census code of every pixel, (height, width) uint64."""
    rows, columns = kernels.CENSUS_ROWS, kernels.CENSUS_COLUMNS
    codes = np.empty(view.shape, np.uint64)
    kernels.census(cv2.copyMakeBorder(view, rows, rows, columns, columns, cv2.BORDER_REPLICATE), codes)
    return codes


def evened(view: Array) -> Array:
    """Return the view with its local mean and contrast evened out: light differs between tilted views."""
    blur = ((0, 0), LOCAL_SIGMA_PX)
    mean = cv2.GaussianBlur(view, *blur)
    contrast = np.sqrt(cv2.GaussianBlur((view - mean) ** 2, *blur) + 4)
    return np.asarray((view - mean) / contrast, np.float32)


def textured(view: Array, reach_px: int) -> NDArray[np.bool_]:
    """Return where the window around a pixel shows anything: clipped and blank parts cannot be matched."""
    size = (2 * reach_px + 1,) * 2
    mean = cv2.boxFilter(view.astype(np.float64), -1, size)
    variance = cv2.boxFilter(view.astype(np.float64) ** 2, -1, size) - mean**2
    return np.asarray(variance >= LEAST_CONTRAST_GREY**2)


def mutual(best: Array, of_right: Array) -> NDArray[np.bool_]:
    """Return where the right view chooses the same partner: everything else is hidden in one of the views."""
    width = best.shape[1]
    partner = np.arange(width) - np.rint(best).astype(int)
    back = np.take_along_axis(of_right, np.clip(partner, 0, width - 1), 1)
    return np.asarray((partner >= 0) & (partner < width) & (np.abs(back - best) <= AGREEMENT_PX))


def without_speckles(parallax: Array) -> Array:
    """Open islands of fewer than 50 pixels, at steps of more than 1.5 px from what is around them."""
    sixteenths = np.where(np.isfinite(parallax), np.rint(16 * parallax), -32768).astype(np.int16)
    cv2.filterSpeckles(sixteenths, -32768, SPECKLE_PX, int(16 * TEAR_PX))
    return _kept(parallax, sixteenths > -32768)


def without_outliers(parallax: Array) -> NDArray[np.bool_]:
    """Return where the parallax is known and within 2 px of the median of its neighbours two pixels away."""
    padded = np.pad(parallax, 2, constant_values=np.nan)
    height, width = parallax.shape
    around = np.stack([padded[i : i + height, j : j + width] for i in (0, 2, 4) for j in (0, 2, 4)])
    around.sort(axis=0)  # what is not known comes last
    middle = np.maximum(np.isfinite(around).sum(axis=0) - 1, 0) // 2
    median = np.take_along_axis(around, middle[np.newaxis], 0)[0]
    return np.asarray(np.abs(parallax - median) <= OUTLIER_PX)
