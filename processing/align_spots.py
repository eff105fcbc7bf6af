"""Round spots in pictures of sections: found, fitted to a few hundredths of a pixel, found again in the next section.

A spot is a disc with a soft rim on an inclined ground: a hole, a thread cut across, a dot. The fit gives no say to
pixels that are not of the spot, so that dirt or a cell beside it does not pull at it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

SIGMAS_PX = (2.0, 3.0, 4.5, 7.0)
CANDIDATES = 40
STANDS_OUT = 4.5  # times the usual response of the spot filter
REACH_SIGMAS = 2.5  # of the window a spot is fitted in: at its rim the spot is gone
FIT_STEPS = 15
CONVERGED_PX = 0.05  # of the disc: its rim is looked at after it
TUKEY = 3 * 1.4826  # times the median absolute residual
ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False)
RIM_SIGMAS = 1.29  # of a disc with radius σ: where it has half its contrast
NEAREST_RIM, FURTHEST_RIM = 0.5, 1.6  # of that radius: where the rim is looked for
RIM_STEP_PX, RIM_BLUR_PX = 0.25, 0.75
RIM_TERMS = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.ones(48), np.cos(2 * ANGLES), np.sin(2 * ANGLES)])
RIM_ROUNDS, TUKEY_ROUNDS = 2, 3
ROUGH_PX = 0.3  # a rim is never smoother
LEAST_RIM = 0.4  # of the rays must agree, by their weights
SAME_CONTRAST, SAME_SIZE = 2.0, 1.5  # ratios within which a spot may be the same one in the next section
LIKELY_CONTRAST, LIKELY_SIZE = 0.2, 0.15  # usual changes of their logarithms
TRIED = 4  # places in the search window
SURELY, UNLIKELY = 1.0, 4.0  # no other place is tried; none is taken


@dataclass(frozen=True)
class Spot:
    """A round mark: place in pixels, contrast against its surroundings (negative when dark), radius (σ)."""

    x: float
    y: float
    contrast: float
    sigma: float

    def like(self, other: Spot) -> bool:
        """Whether two spots may be of one kind: of the same sign, about as strong and as large."""
        return bool(np.isfinite(self.unlike(other)))

    def unlike(self, other: Spot) -> float:
        """How different two spots look: 1 for what one spot may change; infinite for different ones."""
        contrast = other.contrast / self.contrast
        size = other.sigma / self.sigma
        if not (1 / SAME_CONTRAST < contrast < SAME_CONTRAST and 1 / SAME_SIZE < size < SAME_SIZE):
            return float("inf")
        return float(np.hypot(np.log(contrast) / LIKELY_CONTRAST, np.log(size) / LIKELY_SIZE))


def fit_spot(picture: Array, x: float, y: float, sigma: float) -> Spot | None:
    """Fit a round spot, a disc first, then its rim; None when it runs away or has no rim. As `fit_disc`."""
    disc = fit_disc(picture, x, y, sigma)
    return disc and by_its_rim(picture, disc)


def fit_disc(picture: Array, x: float, y: float, sigma: float) -> Spot | None:
    """Fit a disc with a soft rim on an inclined ground; None when it runs away.

    Parameters
    ----------
    picture : array (h, w) float32
        Grey.
    x, y, sigma : float
        Roughly where it is and how large, in pixels.
    """
    reach = int(np.ceil(REACH_SIGMAS * sigma))
    x0, y0 = round(x) - reach, round(y) - reach
    side = 2 * reach + 1
    part = picture[max(y0, 0) : y0 + side, max(x0, 0) : x0 + side]
    if part.shape != (side, side):
        return None
    yy, xx = (c.ravel().astype(np.float64) for c in np.mgrid[y0 : y0 + side, x0 : x0 + side])
    grey, found, contrast = part.ravel().astype(np.float64), np.array([x, y, sigma]), 0.0
    for _ in range(FIT_STEPS):
        step, contrast = _disc_step(grey, xx - found[0], yy - found[1], found[2], contrast)
        found += np.clip(step, -1, 1)
        if np.abs(found[:2] - (x, y)).max() > reach or not 0.5 < found[2] < 2 * sigma or not contrast:
            return None
        if np.abs(step).max() < CONVERGED_PX:
            break
    return Spot(float(found[0]), float(found[1]), contrast, float(found[2]))


def _disc_step(grey: Array, dx: Array, dy: Array, sigma: float, contrast: float) -> tuple[Array, float]:
    """One Gauss-Newton step of place and size; contrast and ground are linear, the contrast of a first step unknown."""
    squared = (dx**2 + dy**2) / (2 * sigma**2)
    shape = np.exp(-(squared**2))  # a disc with a soft rim
    ground = np.stack([shape, np.ones_like(dx), dx, dy])
    contrast = contrast or float(_least_squares(ground, grey)[0])
    slope = contrast * shape * 2 * squared / sigma**2
    linear = _least_squares(np.concatenate([ground, [slope * dx, slope * dy, slope * 2 * squared * sigma]]), grey)
    return linear[4:], float(linear[0])


def _least_squares(columns: Array, values: Array) -> Array:
    left = columns @ columns.T
    left[np.diag_indices(len(left))] += 1e-9 * left.trace() / len(left) + 1e-12
    return np.asarray(np.linalg.solve(left, columns @ values))


def by_its_rim(picture: Array, spot: Spot) -> Spot | None:
    """Return a spot by its rim, seen along rays; None when hardly half of it is an ellipse.

    Where dirt or a cell touches the spot, its rim is displaced or gone: such rays have no say (Tukey's weights).
    """
    for _ in range(RIM_ROUNDS):
        seen, along = _rays(picture, spot)
        radius, there = _steepest(seen * -np.sign(spot.contrast), along)
        (right, down, size), weight = _ellipse(radius, there)
        if weight.mean() < LEAST_RIM or max(abs(right), abs(down)) > spot.sigma or not along[0] < size < along[-1]:
            return None
        contrast = float(np.median(seen[:, 0]) - np.median(seen[weight > 0, -1]))
        spot = Spot(spot.x + right, spot.y + down, contrast, size / RIM_SIGMAS)
    return spot


def _ellipse(radius: Array, there: Array) -> tuple[tuple[float, ...], Array]:
    """Fit r = R + dx cos + dy sin + an ellipse's two terms; returns (dx, dy, R) and the say of each ray."""
    weight, linear = there.astype(np.float64), np.zeros(5)
    for _ in range(TUKEY_ROUNDS):
        root = np.sqrt(weight)
        linear = _least_squares(RIM_TERMS * root, radius * root)
        rest = radius - linear @ RIM_TERMS
        limit = max(TUKEY * float(np.median(np.abs(rest))), ROUGH_PX)
        weight = there * np.clip(1 - (rest / limit) ** 2, 0, None) ** 2
    return tuple(float(c) for c in linear[:3]), weight


def _rays(picture: Array, spot: Spot) -> tuple[Array, Array]:
    """Return the picture along rays from the spot's middle, (rays, steps), and the distances of the steps."""
    radius = RIM_SIGMAS * spot.sigma
    along = np.arange(NEAREST_RIM * radius, FURTHEST_RIM * radius, RIM_STEP_PX)
    x = (spot.x + np.cos(ANGLES)[:, None] * along).astype(np.float32)
    y = (spot.y + np.sin(ANGLES)[:, None] * along).astype(np.float32)
    return cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), along


def _steepest(rising: Array, along: Array) -> tuple[Array, Array]:
    """Distance of the steepest rise along each ray, and whether there is one between the ends."""
    slope = np.gradient(cv2.GaussianBlur(rising, (0, 0), sigmaX=RIM_BLUR_PX / RIM_STEP_PX, sigmaY=0.5), axis=1)
    best = slope[:, 1:-1].argmax(axis=1) + 1
    rays = np.arange(len(ANGLES))
    left, top, right = (slope[rays, best + k] for k in (-1, 0, 1))
    curved = left - 2 * top + right
    between = np.where(curved < 0, 0.5 * (left - right) / np.minimum(curved, -1e-12), 0.0)
    return along[best] + np.clip(between, -1, 1) * RIM_STEP_PX, (curved < 0) & (top > 0)


def spots(picture: Array) -> list[Spot]:
    """Find round spots that stand out from everything else in a grey picture, strongest first."""
    found: list[Spot] = []
    for sigma in SIGMAS_PX:
        response = cv2.GaussianBlur(picture, (0, 0), sigma) - cv2.GaussianBlur(picture, (0, 0), 1.6 * sigma)
        strength = np.abs(response)
        usual = 1.4826 * float(np.median(strength)) + 1e-9
        peaks = (strength == cv2.dilate(strength, np.ones((9, 9)))) & (strength > STANDS_OUT * usual)
        fits = (fit_disc(picture, float(x), float(y), 1.3 * sigma) for y, x in np.argwhere(peaks))
        found += [spot for spot in fits if spot is not None]
    kept = _separate(sorted(found, key=lambda spot: -abs(spot.contrast)))
    return [spot for disc in kept if (spot := by_its_rim(picture, disc)) is not None]


def _separate(found: Sequence[Spot]) -> list[Spot]:
    kept: list[Spot] = []
    for spot in found:
        if all(np.hypot(spot.x - k.x, spot.y - k.y) > 2 * k.sigma for k in kept):
            kept.append(spot)
    return kept[:CANDIDATES]


def found_again(picture: Array, spot: Spot, expected: Array, search_px: int, usual_px: float) -> Spot | None:
    """Find a spot near its expected place (x, y): of the likely places there, the one that looks like it.

    None when nothing near looks like it and is about as near as ``usual_px``, or the search would leave the picture.
    """
    x0, y0 = (round(float(c)) - search_px for c in expected)
    side = 2 * search_px + 1
    if min(x0, y0) < 0 or x0 + side > picture.shape[1] or y0 + side > picture.shape[0]:
        return None
    margin = int(np.ceil(2 * spot.sigma))
    part = picture[max(y0 - margin, 0) : y0 + side + margin, max(x0 - margin, 0) : x0 + side + margin]
    blurred = cv2.GaussianBlur(part, (0, 0), spot.sigma / 1.5)[min(margin, y0) :, min(margin, x0) :][:side, :side]
    places = _extremes(blurred * np.sign(spot.contrast))
    least, best = UNLIKELY, None
    for y, x in places:
        fit = by_its_rim(picture, replace(spot, x=float(x0 + x), y=float(y0 + y)))
        if fit is not None and (cost := _unlikely(spot, fit, expected, usual_px)) < least:
            least, best = cost, fit
        if least < SURELY:
            break
    return best


def _extremes(blurred: Array) -> Array:
    """Local maxima as (row, column), highest first."""
    places = np.argwhere(blurred == cv2.dilate(blurred, np.ones((5, 5))))
    order = np.argsort(-blurred[places[:, 0], places[:, 1]])
    return np.asarray(places[order[:TRIED]])


def _unlikely(spot: Spot, fit: Spot, expected: Array, usual_px: float) -> float:
    return spot.unlike(fit) + float(np.hypot(fit.x - expected[0], fit.y - expected[1])) / usual_px
