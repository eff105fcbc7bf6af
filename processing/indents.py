"""Depth from hardness indents: how deep a pyramid of known shape went, and how much of it was polished away.

Vickers (136° between opposite faces): depth = diagonal / (2 √2 tan 68°) = d / 7.0006. Knoop (172.5° along, 130°
across): depth = long diagonal / (2 tan 86.25°) = L / 30.51. ASTM E384. What polishing takes off shortens the diagonals
in the same ratio, whatever the face looked like before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from processing.indent_fit import found_indents

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.indent_fit import Fit

    Array = NDArray[Any]

Shape = Literal["vickers", "knoop"]

DEPTH_RATIO: dict[Shape, float] = {
    "vickers": 2 * math.sqrt(2) * math.tan(math.radians(68)),
    "knoop": 2 * math.tan(math.radians(86.25)),
}
MOST_UNEQUAL = 1.12  # ratio of the diagonals of a Vickers indent in a tilted or strained face
KNOOP_RATIOS = (5.0, 9.5)  # 7.11 when new; the short one recovers
TIP_SHARE = 0.008  # of a diagonal: three detectors' pictures of one indent disagree by that about its tips
REPEATABILITY = 0.03
SAME_PLACE = 0.5  # of a diagonal
DISAGREEMENT = 3.0  # standard errors
FEWEST_FOR_PLANE = 3


@dataclass(frozen=True)
class Indent:
    """One indent, measured.

    Attributes
    ----------
    shape : {"vickers", "knoop"}
        Told by the ratio of the diagonals.
    corners_px : array (4, 2)
        x, y in the order around.
    centre_um : (float, float)
        Where the diagonals cross.
    diagonals_um, diagonal_errors_um : (float, float)
        Longer and shorter one, with standard errors.
    depth_um, depth_error_um : float
        Depth below the face.
    notes : tuple of str
        What is odd about it.
    """

    shape: Shape
    corners_px: Array
    centre_um: tuple[float, float]
    diagonals_um: tuple[float, float]
    diagonal_errors_um: tuple[float, float]
    depth_um: float
    depth_error_um: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Removal:
    """What was taken off a face between two pictures of it.

    Attributes
    ----------
    pairs : tuple of (int, int)
        Indents before and after that are the same.
    removed_um, errors_um : array (pairs,)
        Depth removed at each, with standard errors.
    vanished : tuple of int
        Indents of the first picture that the second does not show.
    mean_um, mean_error_um : float
        Depth removed at the middle of the indents.
    slopes : (float, float), optional
        Tilt of the removed layer, µm per µm along x and y; needs three indents.
    residual_um : float, optional
        Rms of what the plane leaves: unevenness of the removal; needs four indents.
    blended_um, blended_error_um : float
        Together with the feed counter, if there was one: weights are inverse variances.
    notes : tuple of str
        What does not agree.
    """

    pairs: tuple[tuple[int, int], ...]
    removed_um: Array
    errors_um: Array
    vanished: tuple[int, ...]
    mean_um: float
    mean_error_um: float
    slopes: tuple[float, float] | None
    residual_um: float | None
    blended_um: float
    blended_error_um: float
    notes: tuple[str, ...]

    @property
    def tilt_deg(self) -> float | None:
        """Angle between the face before and after."""
        return None if self.slopes is None else math.degrees(math.atan(math.hypot(*self.slopes)))


def depth_um(diagonal_um: float, shape: Shape = "vickers") -> float:
    """Return the depth of a pyramid from its diagonal, of a Knoop pyramid from the long one."""
    return diagonal_um / DEPTH_RATIO[shape]


def measured_indents(image: Array, pixel_um: float) -> list[Indent]:
    """Find and measure all Vickers and Knoop indents of a picture, (height, width), from top to bottom."""
    found = [measured(fit, pixel_um) for fit in found_indents(image)]
    return [indent for indent in found if indent is not None]


def measured(fit: Fit, pixel_um: float) -> Indent | None:
    """Return the indent an outline is of; None when the diagonals are those of no pyramid."""
    lengths = sorted((fit.diagonal_px(k) for k in (0, 1)), reverse=True)
    (long, short), statistical = ([pair[k] * pixel_um for pair in lengths] for k in (0, 1))
    shape = told_shape(long / short)
    if shape is None:
        return None
    odd = shape == "vickers" and long - short > REPEATABILITY * short
    # A corner under a burr: one of the two is off by all of the difference, and nobody knows which.
    hidden = (long - short) / math.sqrt(2) if odd else 0.0
    errors = [math.hypot(s, TIP_SHARE * d, hidden) for s, d in zip(statistical, (long, short), strict=True)]
    across, error = (long, errors[0]) if shape == "knoop" else ((long + short) / 2, math.hypot(*errors) / 2)
    words = (f"the diagonals differ by {long / short - 1:.1%}, 3 % is usual: look at its corners.",) if odd else ()
    centre = (float(fit.centre_px[0] * pixel_um), float(fit.centre_px[1] * pixel_um))
    depth = (depth_um(across, shape), error / DEPTH_RATIO[shape])
    return Indent(shape, fit.corners_px, centre, (long, short), (errors[0], errors[1]), *depth, words)


def told_shape(ratio: float) -> Shape | None:
    """Tell the pyramid from the ratio of the diagonals."""
    if ratio <= MOST_UNEQUAL:
        return "vickers"
    return "knoop" if KNOOP_RATIOS[0] <= ratio <= KNOOP_RATIOS[1] else None


def removal(
    before: Sequence[Indent], after: Sequence[Indent], *, feed_um: float | None = None, feed_error_um: float = 0.1
) -> Removal | None:
    """Return what was removed between two pictures; None when no indent is seen in both.

    Parameters
    ----------
    before, after : sequence of Indent
        The same face; a shift between the pictures is found from the indents themselves.
    feed_um, feed_error_um : float
        What the feed counter says was removed, and its standard error.
    """
    pairs = same_indents(before, after)
    if not pairs:
        return None
    removed = np.array([before[a].depth_um - after[b].depth_um for a, b in pairs])
    errors = np.array([math.hypot(before[a].depth_error_um, after[b].depth_error_um) for a, b in pairs])
    places = np.array([before[a].centre_um for a, _ in pairs])
    mean, mean_error, slopes, residual = layer(places, removed, errors)
    blended = (mean, mean_error) if feed_um is None else blend((mean, mean_error), (feed_um, feed_error_um))
    vanished = tuple(k for k in range(len(before)) if k not in {a for a, _ in pairs})
    notes = _oddities(mean, mean_error, feed_um, feed_error_um, vanished)
    return Removal(tuple(pairs), removed, errors, vanished, mean, mean_error, slopes, residual, *blended, notes)


def _oddities(
    mean: float, error: float, feed_um: float | None, feed_error_um: float, vanished: tuple[int, ...]
) -> tuple[str, ...]:
    said = [f"indent {k} is not seen any more: press a new one before the last is gone." for k in vanished]
    if mean < -DISAGREEMENT * error:
        said.append("the indents are larger after than before: are the pictures swapped?")
    if feed_um is not None and abs(mean - feed_um) > DISAGREEMENT * math.hypot(error, feed_error_um):
        said.append(f"indents say {mean:.3g} ± {error:.2g} µm, the feed {feed_um:.3g} ± {feed_error_um:.2g} µm.")
    return tuple(said)


def same_indents(before: Sequence[Indent], after: Sequence[Indent]) -> list[tuple[int, int]]:
    """Pair the indents of two pictures: the shift under which most of them meet, then the nearest to each."""
    if not before or not after:
        return []
    first, second = (np.array([i.centre_um for i in indents]) for indents in (before, after))
    reach = SAME_PLACE * min(i.diagonals_um[0] for i in before)
    shifts = (second[np.newaxis] - first[:, np.newaxis]).reshape(-1, 2)
    met = [_met(first + shift, second, reach) for shift in shifts]
    best = max(met, key=lambda pairs: (len(pairs), -_stray(pairs, first, second)))
    alone = len(best) == 1 and _stray(best, first, second) > 2 * reach / SAME_PLACE
    return [] if alone else best  # one indent that went far may be another one


def _stray(pairs: list[tuple[int, int]], first: Array, second: Array) -> float:
    """Return how far the picture moved: of two shifts that fit alike the smaller one is believed."""
    return float(np.mean([np.hypot(*(second[b] - first[a])) for a, b in pairs])) if pairs else math.inf


def _met(first: Array, second: Array, reach: float) -> list[tuple[int, int]]:
    apart = np.hypot(*(first[:, np.newaxis] - second).transpose(2, 0, 1))
    nearest = apart.argmin(axis=1)
    return [(a, int(b)) for a, b in enumerate(nearest) if apart[a, b] <= reach and int(apart[:, b].argmin()) == a]


def layer(
    places: Array, removed: Array, errors: Array
) -> tuple[float, float, tuple[float, float] | None, float | None]:
    """Fit the plane removed = mean + slope · (place - middle) with weights 1 / error².

    Returns
    -------
    mean, error, slopes, residual
        Slopes need three places that lie on no line, the residual four.
    """
    weight = 1 / errors**2
    middle = np.average(places, axis=0, weights=weight)
    terms = np.column_stack([np.ones(len(places)), places - middle])
    mean, error = float(np.average(removed, weights=weight)), float(1 / math.sqrt(weight.sum()))
    spans = len(places) >= FEWEST_FOR_PLANE and np.linalg.matrix_rank(terms, tol=1e-6 * np.abs(terms).max()) == 3
    if not spans:
        return mean, error, None, None
    found = np.linalg.lstsq(terms / errors[:, np.newaxis], removed / errors, rcond=None)[0]
    off = removed - terms @ found
    rest = float(np.sqrt(np.mean(off**2))) if len(places) > FEWEST_FOR_PLANE else None
    return mean, error, (float(found[1]), float(found[2])), rest


def blend(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Return two measurements with their standard errors as one, weights being inverse variances."""
    weights = [1 / error**2 for _, error in (first, second)]
    value = (first[0] * weights[0] + second[0] * weights[1]) / sum(weights)
    return value, 1 / math.sqrt(sum(weights))
