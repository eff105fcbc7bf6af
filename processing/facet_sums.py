"""Area and volume of every feature from triangles of two sizes, slab by slab, so that no mesh need be held.

Triangles lie within what they stand for: they lose the square of their size where a surface is bent, and a strip of
their own width along each sharp edge. The same surface made of triangles twice as large loses four times, or twice, as
much; so the difference of both says how much the small ones lost (Richardson).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.facets import measure, triangle_areas
from processing.neighbours import CUBIC, Spacing

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

SLAB = 32  # planes that are made to triangles at a time; even, so that large triangles fit
AREA_LOST = 0.75  # of the difference: a third where all is bent, all of it where all is edges
VOLUME_LOST = 1 / 3  # of the difference: volume is lost where the surface is bent
SMOOTH = (0.05, 0.15)  # of area and volume: where both differ by more, it is too small, or rough, and left as it is


@dataclass(frozen=True, eq=False)
class FacetSums:
    """What triangles add up to.

    Attributes
    ----------
    areas, volumes : array (2, n)
        Of each label, from small and from large triangles, in µm² and µm³; a volume is right for features that the
        border does not cut.
    totals_um2 : array (2,)
        Area of all, without what large triangles have beyond the border.
    seen_um3 : float
        Volume between the middles of the outermost voxels.
    """

    areas: Array
    volumes: Array
    totals_um2: Array
    seen_um3: float

    @property
    def area_um2(self) -> Array:
        """Area of each label."""
        return _improved(self.areas, AREA_LOST, SMOOTH[0])

    @property
    def volume_um3(self) -> Array:
        """Volume of each label."""
        return _improved(np.abs(self.volumes), VOLUME_LOST, SMOOTH[1])

    @property
    def density_per_um(self) -> tuple[float, float]:
        """Area per volume of all, and how uncertain it is."""
        small, large = self.totals_um2 / self.seen_um3
        better = float(_improved(np.array([[small], [large]]), AREA_LOST, SMOOTH[0])[0])
        return better, AREA_LOST / 2 * abs(float(small - large))


def _improved(pair: Array, lost: float, smooth: float) -> Array:
    small, large = pair
    more = np.where(np.abs(small - large) < smooth * small, lost * (small - large), 0.0)
    return np.asarray(small + more)


def facet_sums(
    volume: Array,
    level: float,
    labels: Array,
    spacing_um: Spacing = CUBIC,
    told: Callable[[int], None] | None = None,
) -> FacetSums:
    """Make the surface at a level of triangles and add them up for each label.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    level : float
        No voxel has it.
    labels : array (z, y, x)
        Numbers of what is on the brighter, or on the darker, side of the level; 0 on the other.
    spacing_um : tuple of float
        Distance of voxels along (z, y, x).
    told : callable, optional
        Told how many planes are done.
    """
    count = int(labels.max()) + 1
    areas, volumes, totals = np.zeros((2, count)), np.zeros((2, count)), np.zeros(2)
    size = np.array(spacing_um)
    last = np.array(volume.shape) - 1
    for start in range(0, max(len(volume) - 1, 0), SLAB):
        grey = _odd(np.asarray(volume[start : start + SLAB + 1], np.float32))
        numbers = _odd(labels[start : start + SLAB + 1])
        for k, step in enumerate((1, 2)):
            if grey.min() < level < grey.max():
                points, triangles, _, _ = measure.marching_cubes(grey, level, step_size=step)
                owners = _owners(points[triangles[:, 0]], numbers, step)
                points[:, 0] += start
                each = triangle_areas(points * size, triangles)
                areas[k] += np.bincount(owners, each, count)
                volumes[k] += np.bincount(owners, _pyramids(points * size, triangles), count)
                totals[k] += each[(points[triangles].mean(axis=1) <= last).all(axis=1)].sum()
        if told:
            told(min(start + SLAB, len(volume)))
    return FacetSums(areas, volumes, totals, float(np.prod(np.maximum(last, 1) * size)))


def _odd(part: Array) -> Array:
    """Repeat the last voxel of each axis that has an even number of them."""
    return np.pad(part, [(0, 1 - n % 2) for n in part.shape], mode="edge")


def _owners(points: Array, labels: Array, step: int) -> Array:
    """Return to which label points belong: each lies between one voxel inside and one outside."""
    low, high = (np.asarray(end(points / step), np.intp) * step for end in (np.floor, np.ceil))
    return np.asarray(np.maximum(labels[tuple(low.T)], labels[tuple(high.T)]), np.intp)


def _pyramids(points: Array, triangles: Array) -> Array:
    """Return the signed volume between each triangle and the origin."""
    a, b, c = (points[triangles[:, k]].astype(np.float64) for k in range(3))
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
