"""Smooth drift and twist through an aligned stack: what neighbours alone cannot tell from the specimen's own shape.

Laying neighbours over each other makes an oblique fibre upright and a twisted prism straight. Where nothing absolute is
known, the steady part of the motion is therefore reported, and can be given back to the specimen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from processing.align_models import about_centre, in_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

Trend = Literal["remove", "keep", "model"]
SMOOTH_SECTIONS = 12.0  # standard deviation of the Gaussian that separates drift from jitter
CERTAIN = 4.0  # times its standard error, from which a steady drift is called one
NOTICED_PX = 1.0  # over the whole stack


@dataclass(frozen=True)
class Drift:
    """Steady motion from section to section.

    Attributes
    ----------
    x_px, y_px, turn_deg : float
        For each section.
    seen : bool
        Larger than chance and than a pixel over the stack.
    """

    x_px: float
    y_px: float
    turn_deg: float
    seen: bool

    def words(self, count: int) -> str:
        """Return the warning."""
        found = (
            f"a steady drift of ({self.x_px:+.2f}, {self.y_px:+.2f}) px and {self.turn_deg:+.3f}° a section stands out"
            if self.seen
            else f"no steady drift stands out in these {count} sections"
        )
        return (
            f"the solution is not unique: without fiducial marks, an oblique or twisted specimen cannot be told from "
            f"drifting sections; {found}. Give marks (--fiducials), or choose --trend keep or --trend model."
        )


def motion(matrices: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Shift of the middle in half sides, and rotation in radians, of every section: (n, 3)."""
    found = [about_centre(matrix, shape) for matrix in matrices]
    turns = np.unwrap([np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1]) for m in found])
    return np.column_stack([[m[0, 2] for m in found], [m[1, 2] for m in found], turns])


def drift(matrices: Sequence[Array], shape: tuple[int, ...]) -> Drift:
    """Measure the steady part of the motion by a straight line through all sections."""
    moved = motion(matrices, shape)
    n = len(moved)
    if n < 3:
        return Drift(0.0, 0.0, 0.0, seen=False)
    place = np.arange(n) - (n - 1) / 2
    slope = place @ moved / (place @ place)
    rest = moved - moved.mean(axis=0) - place[:, None] * slope
    error = np.sqrt((rest**2).sum(axis=0) / (n - 2) / (place @ place))
    half = max(shape[:2]) / 2
    seen = (np.abs(slope) > CERTAIN * error) & (np.abs(slope) * half * n > NOTICED_PX)
    return Drift(float(slope[0] * half), float(slope[1] * half), float(np.degrees(slope[2])), seen=bool(seen.any()))


def with_trend(matrices: Sequence[Array], shape: tuple[int, ...], trend: Trend, reference: int) -> list[Array]:
    """Give the specimen what runs smoothly through the stack.

    Parameters
    ----------
    matrices : sequence of array (3, 3)
        From output to section, neighbours laid over each other.
    shape : tuple of int
        Height and width.
    trend : {"remove", "keep", "model"}
        remove: all motion is the sections'; keep: what is smooth over a dozen sections is the specimen's; model: a
        steady shift and twist is the specimen's.
    reference : int
        The section that stays.
    """
    if trend == "remove" or len(matrices) < 3:
        return list(matrices)
    moved = motion(matrices, shape)
    smooth = _straight(moved) if trend == "model" else _smoothed(moved)
    smooth = smooth - smooth[reference]
    return [m @ np.linalg.inv(in_pixels(_turn(*part), shape)) for m, part in zip(matrices, smooth, strict=True)]


def _turn(x: float, y: float, angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, x], [sine, cosine, y], [0, 0, 1]])


def _straight(moved: Array) -> Array:
    place = np.arange(len(moved)) - (len(moved) - 1) / 2
    return np.asarray(np.outer(place, place @ moved / (place @ place)))


def _smoothed(moved: Array) -> Array:
    """Local straight lines, Gaussian weights: as good at the ends as in the middle."""
    place = np.arange(len(moved), dtype=np.float64)
    out = np.empty_like(moved)
    for k in range(len(moved)):
        weight = np.exp(-0.5 * ((place - k) / SMOOTH_SECTIONS) ** 2)
        columns = np.column_stack([np.ones_like(place), place - k]) * np.sqrt(weight)[:, None]
        out[k] = np.linalg.lstsq(columns, moved * np.sqrt(weight)[:, None], rcond=None)[0][0]
    return out
