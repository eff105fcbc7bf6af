"""Two sections laid over each other: a start that is near enough, then a robust Gauss-Newton refinement.

Sections differ in more than place: staining, light, dirt, and the specimen itself changes from one to the next. So
pictures are compared after a band-pass with local contrast made equal, gain and offset are free, and pixels that do not
fit have no say (Tukey's weights; the linearisation with the mean gradient of both is Benhimane's and Malis's, 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from processing.align_models import about_centre, applied, frame, grid, in_pixels, nearest, tangent
from processing.align_refine import SUMS, UNKNOWNS, normal_equations, sampled_residuals

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from processing.align_models import Model

    Array = NDArray[Any]

FINEST_SIDE = 1024  # pixels; larger sections are matched at reduced size, to some hundredths of a pixel all the same
COARSEST_SIDE = 64  # pixels
START_SIDE = 256  # the start is sought at this size
SMALLEST_SIDE = 32  # smaller pictures show too little
BLUR, BAND, CONTRAST = 0.6, 3.0, 12.0  # pixels: noise, band-pass, neighbourhood whose contrast is made equal
FLATTEST = 0.25  # of the typical local contrast: flatter neighbourhoods are not raised any further
STEPS = 12
CONVERGED, COARSELY = 0.01, 0.05  # pixels a step moves: near the solution the next is a small fraction of it
SPARSE = 4  # contrast varies slowly: it is worked out on every fourth pixel
TUKEY = 3 * 1.4826  # times the median absolute residual
STRIDE = 4
ALIKE = 0.3  # correlation of the filtered pictures from which a match is believed
BEYOND_CHANCE = 8.0  # standard errors it must differ from 0 by: many places were tried, and the best one taken
SPECTRUM_SIDE = 128  # of the part from which it is told how many pixels say something of their own
FEWEST = 0.2  # of the pixels must be seen by both
CUBIC = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
LINEAR = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
CORRELATED_PX = 4.0  # area over which the filters make residuals alike
LARGEST_STRAIN = 0.45  # no section is compressed or swollen by more


@dataclass(frozen=True)
class View:
    """A section made ready to be matched.

    Attributes
    ----------
    shape : tuple of int
        Height and width of the section in its own pixels.
    levels : tuple of array (h, w) float32
        Band-pass with local contrast made equal: from about `COARSEST_SIDE` pixels to at most `FINEST_SIDE`.
    grey : array (h, w) float32
        As it is, at most `FINEST_SIDE` pixels wide or high.
    texture : float
        Share of the section that shows structure, 0 … 1.
    """

    shape: tuple[int, ...]
    levels: tuple[Array, ...]
    grey: Array
    texture: float

    @property
    def small(self) -> Array:
        """Grey, at most `START_SIDE` pixels wide or high."""
        return shrunk(self.grey, START_SIDE)


@dataclass(frozen=True)
class Match:
    """How one section lies on another.

    Attributes
    ----------
    matrix : array (3, 3)
        From pixels (x, y) of the first to those of the second.
    correlation : float
        Of the two filtered pictures where both show something, with the weights of the fit: −1 … 1.
    error_px : float
        Expected mean error from noise alone; the specimen's change from section to section comes on top.
    inliers : float
        Mean weight of the pixels in the fit: low with dirt, folds or damage.
    overlap : float
        Share of the first picture that the second one shows.
    beyond_chance : float
        Standard errors of the correlation between the pictures' 0 and what was found, by Fisher's transformation.
    start : str
        What the refinement began with, or the method whose map it is.
    mismatch : float, optional
        Ex-OR area over the shared area, where that was measured; ``curves`` then hold it against the offset.
    """

    matrix: Array
    correlation: float
    error_px: float
    inliers: float
    overlap: float
    beyond_chance: float = 0.0
    start: str = "given"
    mismatch: float | None = None
    curves: Mapping[str, Array] | None = None

    @property
    def believed(self) -> bool:
        """True when the two pictures are of the same thing, as far as pictures can tell."""
        lengths = np.linalg.svd(self.matrix[:2, :2], compute_uv=False)
        sane = np.abs(np.log(np.maximum(lengths, 1e-9))).max() < LARGEST_STRAIN and np.linalg.det(self.matrix) > 0
        alike = self.correlation >= ALIKE and self.beyond_chance >= BEYOND_CHANCE
        return bool(sane and alike and self.overlap >= FEWEST)


NO_MATCH = Match(np.eye(3), 0.0, float("inf"), 0.0, 0.0, start="none")


def grey(section: Array) -> Array:
    """Return a section, (h, w) or RGB (h, w, 3), as grey float32."""
    return (section if section.ndim == 2 else cv2.cvtColor(section, cv2.COLOR_RGB2GRAY)).astype(np.float32)


def view(section: Array) -> View:
    """Make a section, (h, w) or RGB (h, w, 3) uint8 or uint16, ready for `refined`."""
    picture = grey(section)
    grey_levels = [shrunk(picture, FINEST_SIDE)]
    while max(grey_levels[0].shape) >= 2 * COARSEST_SIDE:
        grey_levels.insert(0, shrunk(grey_levels[0], max(grey_levels[0].shape) // 2))
    levels = [evened(level) for level in grey_levels]
    return View(picture.shape, tuple(filtered for filtered, _ in levels), grey_levels[-1], levels[-1][1])


def shrunk(image: Array, side: int) -> Array:
    """Return the image with its longer side at most ``side`` pixels."""
    scale = side / max(image.shape)
    if scale >= 1:
        return image
    height, width = (max(1, round(n * scale)) for n in image.shape)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def evened(picture: Array) -> tuple[Array, float]:
    """Return the band-pass with local contrast made equal, and the share of pixels whose neighbourhood shows any."""
    fine = cv2.GaussianBlur(picture, (0, 0), BLUR)
    band = fine - cv2.GaussianBlur(picture, (0, 0), BAND)
    small = cv2.resize(band * band, None, fx=1 / SPARSE, fy=1 / SPARSE, interpolation=cv2.INTER_AREA)
    contrast = np.sqrt(cv2.GaussianBlur(small, (0, 0), CONTRAST / SPARSE))
    typical = float(np.median(contrast))
    floor = max(FLATTEST * typical, 1e-3 * float(np.ptp(picture)), 1e-3)  # grey levels: less is rounding
    everywhere = cv2.resize(contrast + floor, picture.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return band / everywhere, float((contrast > floor).mean())


def between_sizes(matrix: Array, shape: tuple[int, ...], small: tuple[int, ...]) -> Array:
    """Return a map of pictures of ``shape`` as the map of the same pictures resized to ``small``."""
    factor_x, factor_y = small[1] / shape[1], small[0] / shape[0]
    resize = np.array([[factor_x, 0, (factor_x - 1) / 2], [0, factor_y, (factor_y - 1) / 2], [0, 0, 1]])
    return np.asarray(resize @ matrix @ np.linalg.inv(resize))


def refined(first: View, second: View, start: Array, model: Model, name: str = "given", levels: int = 1) -> Match:
    """Refine a map that is right to a few pixels of the coarsest of the ``levels`` finest pictures.

    Parameters
    ----------
    first, second : View
        Of the same shape.
    start : array (3, 3)
        From pixels of the first to those of the second.
    model : Model
        Maps allowed.
    name : str
        How the start was found.
    levels : int
        How many sizes of the pictures to go through.

    Returns
    -------
    Match
        `NO_MATCH` when the pictures stopped overlapping on the way.
    """
    matrix, fit = start, Fit(1.0, 0.0)
    for a, b in list(zip(first.levels, second.levels, strict=True))[-levels:]:
        enough = CONVERGED if a is first.levels[-1] else COARSELY
        found = level_refined(a, b, between_sizes(matrix, first.shape, a.shape), model, enough)
        if found is None:
            return NO_MATCH
        matrix, fit = between_sizes(found[0], a.shape, first.shape), found[1]
    finest = first.levels[-1]
    scale = max(first.shape) / max(finest.shape)
    return replace(fit.judged(matrix, finest, second.levels[-1]), error_px=fit.error_px * scale, start=name)


def level_refined(a: Array, b: Array, start: Array, model: Model, enough: float) -> tuple[Array, Fit] | None:
    """Refine a map in pixels on one pair of filtered pictures, until a step moves it by less than ``enough``."""
    matrix, fit = nearest(model, about_centre(start, a.shape)), Fit(1.0, 0.0)
    for _ in range(STEPS):
        step = one_step(a, b, matrix, fit, model)
        if step is None:
            return None
        matrix, fit, moved = step
        if moved < enough:
            break
    return in_pixels(matrix, a.shape), fit


@dataclass(frozen=True)
class Fit:
    """Gain and offset of the second picture, and how well it fitted."""

    gain: float
    offset: float
    correlation: float = 0.0
    error_px: float = float("inf")
    weight: float = 0.0
    pixels: int = 0

    def judged(self, matrix: Array, a: Array, b: Array) -> Match:
        """Return the match of two filtered pictures with this fit."""
        inliers = self.weight / max(self.pixels, 1)
        found = Match(matrix, self.correlation, self.error_px, inliers, self.pixels / a.size)
        if self.correlation < ALIKE:
            return found
        independent = self.weight * independent_share(a, b)
        sure = np.arctanh(min(self.correlation, 0.9999)) * np.sqrt(max(independent - 3, 0.0))
        return replace(found, beyond_chance=float(sure))


def independent_share(a: Array, b: Array) -> float:
    """Return how much a pixel counts where neighbours are alike: n for the variance of a correlation, over pixels.

    Bartlett's formula, var r = Σ ρ_a ρ_b / n with the autocorrelations ρ, by the power spectra of the middle.
    """
    powers = []
    for picture in (a, b):
        y, x = (max(n - SPECTRUM_SIDE, 0) // 2 for n in picture.shape)
        part = picture[y : y + SPECTRUM_SIDE, x : x + SPECTRUM_SIDE]
        window = np.outer(*(np.hanning(n) for n in part.shape)).astype(np.float32)
        power = np.abs(np.fft.fft2((part - part.mean()) * window)).astype(np.float32) ** 2
        powers.append(cv2.blur(power, (5, 5)))
    both = float((powers[0] * powers[1]).mean())
    return float(powers[0].mean() * powers[1].mean() / both) if both > 0 else 0.0


@dataclass(frozen=True)
class Equations:
    """Normal equations of one step: unknowns are the map's six, gain and offset.

    Attributes
    ----------
    left, right : array (8, 8), (8,) float64
        Weighted sums over all pixels both show.
    square : float
        Weighted sum of squares of the second picture.
    pixels : int
        How many pixels were looked at.
    """

    left: Array
    right: Array
    square: float
    pixels: int

    def correlation(self) -> float:
        """Weighted correlation coefficient of the two pictures."""
        aa, a1, n = self.left[6, 6], self.left[6, 7], self.left[7, 7]
        aw, w1 = self.right[6], self.right[7]
        spread = (aa - a1 * a1 / n) * (self.square - w1 * w1 / n) if n > 0 else 0.0
        return float((aw - a1 * w1 / n) / np.sqrt(spread)) if spread > 0 else 0.0


def one_step(a: Array, b: Array, matrix: Array, fit: Fit, model: Model) -> tuple[Array, Fit, float] | None:
    """One Gauss-Newton step on b(M x) = gain a(x) + offset; returns the movement in pixels, too.

    None when hardly a pixel is shown by both.
    """
    in_px = in_pixels(matrix, a.shape)
    warped = cv2.warpAffine(b, in_px[:2], (a.shape[1], a.shape[0]), flags=CUBIC, borderMode=cv2.BORDER_REPLICATE)
    residual = sampled_residuals(a, warped, in_px, fit.gain, fit.offset, STRIDE)
    if residual.size * STRIDE**2 < FEWEST * a.size / 2:
        return None
    limit = TUKEY * float(np.median(np.abs(residual))) + 1e-6
    left, right = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    given = np.array([fit.gain, fit.offset, 1 / limit])
    square, pixels = normal_equations(a, warped, in_px, given, left, right, np.zeros(SUMS))
    equations = Equations(np.triu(left) + np.triu(left, 1).T, right, square, pixels)
    return solved(equations, matrix, model, a.shape)


def solved(equations: Equations, matrix: Array, model: Model, shape: tuple[int, ...]) -> tuple[Array, Fit, float]:
    """Solve the normal equations within the model and move the map."""
    basis = tangent(model, matrix)
    directions = np.zeros((UNKNOWNS, basis.shape[1] + 2))
    directions[:6, :-2] = basis * (max(shape) / 2)  # gradients are per pixel, the map is in units of half a side
    directions[6:, -2:] = np.eye(2)
    inverse = np.linalg.pinv(directions.T @ equations.left @ directions, rcond=1e-9, hermitian=True)
    found = inverse @ (directions.T @ equations.right)
    step = np.eye(3)
    step[:2] -= (basis @ found[:-2]).reshape(2, 3)
    weight = equations.left[7, 7]
    left_over = max(equations.square - found @ (directions.T @ equations.right), 0.0) / max(weight, 1.0)
    covariance = left_over * CORRELATED_PX * inverse[:-2, :-2]
    fit = Fit(
        gain=float(found[-2]),
        offset=float(found[-1]),
        correlation=equations.correlation(),
        error_px=_mean_error(basis @ covariance @ basis.T, shape),
        weight=float(weight),
        pixels=equations.pixels,
    )
    return nearest(model, matrix @ step), fit, float(np.abs(step - np.eye(3)).max()) * max(shape) / 2


def _mean_error(covariance: Array, shape: tuple[int, ...]) -> float:
    """Root mean square displacement in pixels over the section, from the covariance (6, 6) of D."""
    points = applied(frame(shape), grid(shape))
    rows = np.column_stack([points, np.ones(len(points))])
    along_x, along_y = covariance[:3, :3], covariance[3:, 3:]
    square = np.einsum("ni,ij,nj->n", rows, along_x + along_y, rows).mean()
    return float(np.sqrt(max(square, 0.0)) * max(shape) / 2)
