"""Outlines of sections: closed polygons between voxels, with area and centroid, in physical units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.facets import between_values, measure
from processing.neighbours import CUBIC, Spacing, checked_spacing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

FEWEST_POINTS = 3


@dataclass(frozen=True, eq=False)
class Outline:
    """One closed polygon of a section.

    Attributes
    ----------
    points : array (n, 2) float64
        In (x, y), µm, the first not repeated; what is inside lies to the left of the way along them, so that holes run
        the other way round and have areas below zero.
    z_um : float
        Where the section is.
    section : int
        Its number, counted from 0.
    """

    points: Array
    z_um: float
    section: int

    @property
    def area_um2(self) -> float:
        """Area, below zero for a hole."""
        return float(_crosses(self.points).sum() / 2)

    @property
    def centroid_um(self) -> tuple[float, float]:
        """Centroid (x, y) of what it encloses."""
        crosses, following = _crosses(self.points), np.roll(self.points, -1, axis=0)
        x, y = ((self.points + following) * crosses[:, None]).sum(axis=0) / (3 * crosses.sum())
        return float(x), float(y)

    @property
    def length_um(self) -> float:
        """Length all around."""
        return float(np.linalg.norm(np.roll(self.points, -1, axis=0) - self.points, axis=1).sum())


def _crosses(points: Array) -> Array:
    following = np.roll(points, -1, axis=0)
    return np.asarray(points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0])


def outlines(
    volume: Array,
    threshold: float,
    spacing_um: Spacing | None = None,
    *,
    start_um: float = 0.0,
    places_um: Sequence[float] | None = None,
) -> list[Outline]:
    """Return the outlines of what is brighter than a threshold, section by section.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    threshold : float
        Inside is what is greater.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    start_um : float
        Where the first section is.
    places_um : sequence of float, optional
        Where each section is, if they are not evenly spaced.

    Returns
    -------
    list of Outline
        Closed along the border of the section.
    """
    dz, dy, dx = checked_spacing(spacing_um or CUBIC)
    level = between_values(volume, threshold)
    found = []
    for k, plane in enumerate(volume):
        z_um = start_um + k * dz if places_um is None else float(places_um[k])
        framed = np.pad(np.asarray(plane, np.float64), 1, constant_values=min(float(plane.min()), level - 1))
        for line in measure.find_contours(framed, level, positive_orientation="low"):
            points = line[:-1] - 1  # the last is the first again
            if len(points) >= FEWEST_POINTS:
                found.append(Outline(points[:, ::-1] * (dx, dy), z_um, k))
    return found
