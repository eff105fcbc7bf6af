"""Area and volume of every feature from triangles of two sizes, slab by slab, so that no mesh need be held.

Triangles lie within what they stand for: they lose the square of their size where a surface is bent, and a strip of
their own width along each sharp edge. The same surface made of triangles twice as large loses four times, or twice, as
much; so the difference of both says how much the small ones lost (Richardson).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.facets import measure
from processing.neighbours import CUBIC, Spacing
from processing.planes import largest, slabs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from processing.planes import Planes

    Array = NDArray[Any]

AT_ONCE = 65_536  # triangles
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
    volume: Planes,
    level: float,
    labels: Planes,
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
    count = largest(labels) + 1
    areas, volumes, totals = np.zeros((2, count)), np.zeros((2, count)), np.zeros(2)
    size = np.array(spacing_um)
    last = np.array(volume.shape) - 1
    for start, part in slabs(volume, after=1):
        if len(part) < 2:  # the last plane ends the slab before
            continue
        grey = _odd(np.asarray(part, np.float32))
        numbers = _odd(labels[start : start + len(part)])
        for k, step in enumerate((1, 2)):
            for corners in _triangles(grey, level, step):
                owners = _owners(corners[:, 0], numbers, step)
                corners[:, :, 0] += start
                within = (corners.mean(axis=1) <= last).all(axis=1)
                area, volume_um3 = _measured(corners * size)
                areas[k] += np.bincount(owners, area, count)
                volumes[k] += np.bincount(owners, volume_um3, count)
                totals[k] += area[within].sum()
        if told:
            told(start + len(part))
    return FacetSums(areas, volumes, totals, float(np.prod(np.maximum(last, 1) * size)))


def _triangles(grey: Array, level: float, step: int) -> Iterator[Array]:
    """Yield the triangles of a slab, some at a time: corners, (n, 3, 3), in voxels of the slab."""
    seen = grey[::step, ::step, ::step]  # large triangles miss what lies between
    if not seen.min() < level < seen.max():
        return
    points, triangles, _, _ = measure.marching_cubes(grey, level, step_size=step)
    for k in range(0, len(triangles), AT_ONCE):
        yield points[triangles[k : k + AT_ONCE]].astype(np.float64)


def _odd(part: Array) -> Array:
    """Repeat the last voxel of each axis that has an even number of them."""
    return np.pad(part, [(0, 1 - n % 2) for n in part.shape], mode="edge")


def _owners(points: Array, labels: Array, step: int) -> Array:
    """Return to which label points belong: each lies between one voxel inside and one outside."""
    low, high = (np.asarray(end(points / step), np.intp) * step for end in (np.floor, np.ceil))
    return np.asarray(np.maximum(labels[tuple(low.T)], labels[tuple(high.T)]), np.intp)


def _measured(corners: Array) -> tuple[Array, Array]:
    """Return the area of each triangle, and the signed volume between it and the origin."""
    a, b, c = (corners[:, k] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.asarray(area), np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
