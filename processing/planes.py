"""Volumes taken a slab of whole planes at a time, whether they lie in memory or are read as they are needed.

An array is such a volume as it is. What adds up over planes goes through `slabs` once, so that it gives the same from
both, and holds no more than a slab.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Shape = tuple[int, ...]

SIDE = 8  # planes of a slab where nobody says; even, so that blocks of two planes fit


class Planes(Protocol):
    """A volume of which slabs of planes can be had."""

    @property
    def shape(self) -> Shape:
        """Of the volume, (z, y, x)."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of its values."""

    def __len__(self) -> int:
        """How many planes there are."""

    def __getitem__(self, z: slice, /) -> Any:
        """Return some of the planes as an array."""


@dataclass(frozen=True, eq=False)
class Lazy:
    """Planes that are made when they are asked for.

    Attributes
    ----------
    shape : tuple of int
        (z, y, x).
    dtype : numpy.dtype
    read : callable
        Takes a slice of planes, within the volume, and returns them.
    side : int
        How many are taken at once; even.
    """

    shape: Shape
    dtype: np.dtype[Any]
    read: Callable[[slice], Array]
    side: int = SIDE

    def __len__(self) -> int:
        """How many planes there are."""
        return self.shape[0]

    def __getitem__(self, z: slice, /) -> Array:
        """Return some of the planes."""
        start, stop, _ = z.indices(len(self))
        return self.read(slice(start, stop))


def side_of(volume: Planes) -> int:
    """Return how many planes of a volume are taken at once."""
    side: int = getattr(volume, "side", SIDE)
    return side


def slabs(volume: Planes, after: int = 0) -> Iterator[tuple[int, Array]]:
    """Yield the number of its first plane, and a slab; ``after`` planes of the next one are at its end."""
    side = side_of(volume)
    for start in range(0, len(volume), side):
        yield start, volume[start : start + side + after]


def changed(volume: Planes, change: Callable[[Array], Array], dtype: Any = None) -> Lazy:
    """Return a volume whose slabs are changed voxel by voxel."""
    made = np.dtype(volume.dtype if dtype is None else dtype)
    return Lazy(volume.shape, made, lambda z: change(volume[z]), side_of(volume))


def surrounded(volume: Planes, change: Callable[[Array], Array], halo: int, dtype: Any) -> Lazy:
    """Return a volume whose slabs are changed by what looks ``halo`` planes up and down."""

    def read(z: slice) -> Array:
        low = max(0, z.start - halo)
        return change(volume[low : z.stop + halo])[z.start - low : z.stop - low]

    return Lazy(volume.shape, np.dtype(dtype), read, side_of(volume))


def cut(volume: Planes, place: int, axis: int) -> Array:
    """Return the section at a place of an axis."""
    if axis == 0:
        return np.asarray(volume[place : place + 1][0])
    return np.concatenate([np.take(slab, place, axis=axis) for _, slab in slabs(volume)])


def largest(labels: Planes) -> int:
    """Return the largest label."""
    return max(int(slab.max()) for _, slab in slabs(labels))
