"""Hardness indents in pictures: found, and their four corners fitted.

A pyramid pressed into a flat face shows four facets of different tone that meet at the crossing of the diagonals. The
fit makes a picture of five tones, four facets and the face around, from eight unknowns, the corners, and brings it into
agreement with the image by least squares; the tones follow from the corners. All edges have a say at once, also the
ridges between facets, so that a side of the tone of the face costs little.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

COARSE_SIDE_PX = 512
COARSE_BLUR_PX = 2.0
SIGMAS = 5.0
SMALLEST_COARSE_PX = 40
NORMAL_MAD = 1.4826
SURROUND = 0.35  # of the indent's size, to every side: the face around it
BLURS = (0.06, 0.02)  # of the mean diagonal: first from afar, then from near
SHORTEST_BLUR_PX = 1.0
MOST_PIXELS = 200_000  # of a patch; larger ones are halved
ROUNDS, DONE_PX = 25, 0.02
ROBUST = 2.5  # standard deviations at which a pixel counts half
STEP_PX = 0.25
BLOCKS = 12  # along a side of the patch: misfits are alike within a block
LEAST_EXPLAINED = 0.25  # of the smoothed patch's variance
MOST_LEAN_DEG = 12.0  # of the angle between the diagonals from 90°
MOST_BOW = 0.07  # of a side; a round pit has 0.2
LEAST_HALF = 0.3  # share of a diagonal on either side of the crossing


@dataclass(frozen=True)
class Fit:
    """An outline of four corners joined by arcs, and how sure it is.

    Attributes
    ----------
    corners_px : array (4, 2) float64
        x, y in the order around.
    bow_px : float
        How far each side bulges outwards in its middle: barrel positive, pincushion negative.
    covariance_px : array (8, 8) float64
        Of the corners x0, y0, x1, …; it takes misfit as well as noise into account.
    explained : float
        Share of the variance around the indent that the five tones explain, noise smoothed away.
    """

    corners_px: NDArray[np.float64]
    bow_px: float
    covariance_px: NDArray[np.float64]
    explained: float

    @property
    def centre_px(self) -> Array:
        """Where the diagonals cross."""
        return crossing(self.corners_px)

    def diagonal_px(self, which: int) -> tuple[float, float]:
        """Return the length of diagonal 0 or 1 and its standard error."""
        a, b = which, which + 2
        between = self.corners_px[b] - self.corners_px[a]
        length = float(np.hypot(*between))
        slope = np.zeros(8)
        slope[2 * a : 2 * a + 2], slope[2 * b : 2 * b + 2] = -between / length, between / length
        return length, float(np.sqrt(slope @ self.covariance_px @ slope))


def found_indents(image: Array) -> list[Fit]:
    """Find the indents of a picture and fit each of them.

    Parameters
    ----------
    image : array (height, width), any number type
        One face; indents lie wholly within it.

    Returns
    -------
    list of Fit
        From top to bottom; empty when there is none. What explains too little, or has no crossed diagonals at right
        angles, is no indent.
    """
    grey = image.astype(np.float32)
    outlines = [fitted(grey, corners) for corners in candidates(grey)]
    good = [outline for outline in outlines if outline is not None and is_indent(outline)]
    return sorted(good, key=lambda outline: (outline.centre_px[1], outline.centre_px[0]))


def candidates(grey: Array) -> list[Array]:
    """Return four rough corners, (4, 2), of everything that stands out of the face."""
    shrink = max(1.0, max(grey.shape) / COARSE_SIDE_PX)
    size = (round(grey.shape[1] / shrink), round(grey.shape[0] / shrink))
    small = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), COARSE_BLUR_PX)
    away = np.abs(small - np.median(small))
    outstanding = (away > SIGMAS * NORMAL_MAD * np.median(away)).astype(np.uint8)
    joined = cv2.morphologyEx(outstanding, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    shapes, _ = cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [shape for shape in shapes if cv2.contourArea(shape) >= SMALLEST_COARSE_PX]
    scale = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    return [(quadrilateral(shape) + 0.5) * scale - 0.5 for shape in large]


def quadrilateral(shape: Array) -> Array:
    """Return four corners, (4, 2) float64, that a shape's hull comes down to."""
    hull = cv2.convexHull(shape)
    four = cv2.approxPolyN(hull, 4, None, -1.0, True) if len(hull) > 4 else hull  # noqa: FBT003  OpenCV's own
    corners = np.asarray(four, np.float64).reshape(-1, 2)
    return corners if len(corners) == 4 else cv2.boxPoints(cv2.minAreaRect(shape)).astype(np.float64)


def fitted(grey: Array, corners: Array) -> Fit | None:
    """Fit the corners to the picture around them; None where they run away."""
    corners = longer_first(corners)
    found = None
    for share in BLURS:
        found = Patch.around(grey, corners, share).fit(corners)
        if not _plausible(found.corners_px, grey.shape):
            return None
        corners = found.corners_px
    return found


def _plausible(corners: Array, shape: tuple[int, ...]) -> bool:
    x, y = corners.T
    within = x.min() >= 0 and y.min() >= 0 and x.max() <= shape[1] - 1 and y.max() <= shape[0] - 1
    return bool(within and cv2.isContourConvex(corners.astype(np.float32).reshape(-1, 1, 2)))


def longer_first(corners: Array) -> Array:
    """Put corners in order around, clockwise on the screen, the first at the left or top end of the longer diagonal."""
    middle = corners.mean(axis=0)
    around = corners[np.argsort(np.arctan2(*(corners - middle).T[::-1]))]
    lengths = [np.hypot(*(around[k + 2] - around[k])) for k in (0, 1)]
    start = int(np.argmax(lengths))
    if around[start + 2] @ (1, 1e-3) < around[start] @ (1, 1e-3):
        start += 2
    return np.asarray(np.roll(around, -start, axis=0))


def crossing(corners: Array) -> Array:
    """Return where the diagonals cross."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    matrix = np.stack([first, -second], axis=1)
    share = np.linalg.solve(matrix, corners[1] - corners[0])[0]
    return np.asarray(corners[0] + share * first)


def is_indent(outline: Fit) -> bool:
    """Return whether five tones explain what is seen, and the diagonals cross as those of a pyramid do."""
    corners = outline.corners_px
    angles = [np.arctan2(*(corners[k + 2] - corners[k])[::-1]) for k in (0, 1)]
    lean = abs(np.degrees(angles[1] - angles[0]) % 180 - 90)
    ends = np.hypot(*(corners - outline.centre_px).T)
    shares = [min(ends[k], ends[k + 2]) / (ends[k] + ends[k + 2]) for k in (0, 1)]
    straight = abs(outline.bow_px) <= MOST_BOW * float(np.hypot(*(corners[1] - corners[0])))
    crossed = lean <= MOST_LEAN_DEG and min(shares) >= LEAST_HALF
    return bool(outline.explained >= LEAST_EXPLAINED and straight and crossed)


@dataclass(frozen=True)
class Patch:
    """An indent and some of the face around it.

    Attributes
    ----------
    pixels : array (height, width) float32
        Smoothed.
    offset : array (2,)
        x, y of the first pixel in the picture.
    scale : float
        Pixels of the picture in one of the patch.
    blur : float
        Width of an edge, in pixels of the patch.
    """

    pixels: Array
    offset: Array
    scale: float
    blur: float

    @classmethod
    def around(cls, grey: Array, corners: Array, share: float) -> Patch:
        """Cut the patch out of a picture; edges are smoothed over ``share`` of the mean diagonal."""
        longest = float(np.hypot(*(corners[2] - corners[0])))
        margin = SURROUND * longest
        low = np.maximum(np.floor(corners.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(corners.max(axis=0) + margin), np.array(grey.shape[::-1]) - 1).astype(int) + 1
        shortest = float(np.hypot(*(corners[3] - corners[1])))
        sigma = max(share * float(np.sqrt(longest * shortest)), SHORTEST_BLUR_PX)
        pixels = cv2.GaussianBlur(grey[low[1] : high[1], low[0] : high[0]], (0, 0), sigma)
        scale = max(1.0, float(np.sqrt(pixels.size / MOST_PIXELS)), sigma / 2)
        size = tuple(max(8, round(n / scale)) for n in pixels.shape[::-1])
        exact = pixels.shape[1] / size[0]
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        return cls(small, low + (exact - 1) / 2, exact, sigma / exact)

    def fit(self, corners: Array) -> Fit:
        """Return the outline of least squared misfit (Levenberg 1944, Marquardt 1963).

        Pixels far off their tone, burrs and dirt, have little say: weights 1 / (1 + (r / c)²) after every round.
        """
        unknown = np.concatenate([((corners - self.offset) / self.scale).ravel(), np.zeros(1)])
        damping = 1e-3
        weight = np.ones(self.pixels.size)
        for _ in range(ROUNDS):
            misfit, slopes = self._misfit(unknown, weight), self._slopes(unknown, weight)
            normal = slopes @ slopes.T
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -slopes @ misfit)
            tried = self._misfit(unknown + step, weight)
            better = bool(tried @ tried < misfit @ misfit)
            damping = damping / 5 if better else damping * 10
            if better:
                unknown = unknown + step
                weight = _weights(tried / np.sqrt(weight))
            if np.abs(step).max() < DONE_PX:
                break
        return self._described(unknown, weight)

    def _described(self, unknown: Array, weight: Array) -> Fit:
        """Work out the errors of a fit.

        Misfits of neighbouring pixels are alike: burrs, bent sides and scratches count as a whole. So they are summed
        over blocks before they are squared (Liang and Zeger 1986: sandwich estimate with clusters).
        """
        slopes, misfit = self._slopes(unknown, weight), self._misfit(unknown, weight)
        height, width = self.pixels.shape
        rows, columns = (np.arange(n) * BLOCKS // n for n in (height, width))
        block = (rows[:, np.newaxis] * BLOCKS + columns).ravel()
        pulls = np.stack([np.bincount(block, slope * misfit) for slope in slopes])
        inverse = np.linalg.pinv(slopes @ slopes.T)
        covariance = inverse @ (pulls @ pulls.T) @ inverse * self.scale**2
        spread = weight * (self.pixels.ravel() - np.average(self.pixels.ravel(), weights=weight)) ** 2
        explained = 1 - float(misfit @ misfit) / max(float(spread.sum()), 1e-12)
        corners = unknown[:8].reshape(4, 2) * self.scale + self.offset
        return Fit(corners, float(unknown[8]) * self.scale, covariance[:8, :8], explained)

    def _misfit(self, unknown: Array, weight: Array) -> Array:
        """Return model less image, (pixels,), with the tones that suit this outline best, times the root of weight."""
        shares = facet_shares(unknown[:8].reshape(4, 2), float(unknown[8]), self.pixels.shape, self.blur)
        flat, image = shares.reshape(len(shares), -1), self.pixels.ravel().astype(np.float64)
        weighted = flat * weight
        tones = np.linalg.lstsq(weighted @ flat.T, weighted @ image, rcond=None)[0]
        return np.asarray((tones @ flat - image) * np.sqrt(weight))

    def _slopes(self, unknown: Array, weight: Array) -> Array:
        """Return the derivative of the misfit to each unknown, (9, pixels), by differences."""
        return np.stack([_difference(lambda u: self._misfit(u, weight), unknown, k) for k in range(unknown.size)])


def _weights(misfit: Array) -> Array:
    width = ROBUST * NORMAL_MAD * float(np.median(np.abs(misfit)))
    return np.asarray(1 / (1 + (misfit / max(width, 1e-12)) ** 2))


def _difference(function: Callable[[Array], Array], at: Array, k: int) -> Array:
    step = np.zeros_like(at)
    step[k] = STEP_PX
    return np.asarray((function(at + step) - function(at - step)) / (2 * STEP_PX))


def facet_shares(corners: Array, bow: float, shape: tuple[int, int], blur: float) -> Array:
    """Return how much of each pixel belongs to the face and to the four facets, (5, height, width)."""
    sides = [_beyond(corners[k], corners[(k + 1) % 4], bow, shape, blur) for k in range(4)]
    within = np.prod(sides, axis=0)
    first, second = (_beyond(corners[k], corners[k + 2], 0.0, shape, blur) for k in (0, 1))
    quarters = ((1 - first, second), (1 - first, 1 - second), (first, 1 - second), (first, second))
    return np.stack([1 - within, *(within * a * b for a, b in quarters)])


def _beyond(a: Array, b: Array, bow: float, shape: tuple[int, int], blur: float) -> Array:
    """Return which pixels lie to the right of the arc from a to b, smoothly across its width.

    The arc leaves the straight line by ``bow`` in its middle, to the left of it where that is positive.
    """
    length = float(np.hypot(*(b - a)))
    along = (b - a) / length
    y, x = np.ogrid[: shape[0], : shape[1]]
    distance = along[0] * (y - a[1]) - along[1] * (x - a[0])
    if bow:
        share = np.clip((along[0] * (x - a[0]) + along[1] * (y - a[1])) / length, 0, 1)
        distance = distance + 4 * bow * share * (1 - share)
    steps = np.float32(0.8 / blur) * distance.astype(np.float32)  # its tanh takes a fifth of the time of float64
    return np.asarray(0.5 + 0.5 * np.tanh(steps))  # within 0.01 of a blurred step
