"""What a whole volume adds up to in one pass over its planes: blocks by their filling, voxels inside, parts, cavities.

Nearly all follows from how often blocks of 2×2×2 voxels are filled in each of the 256 ways (Ohser and Mücklich 2000).
Those within the volume share its border with the blocks of neighbouring tiles, so that a voxel, line or plane of the
border counts half, on an edge a quarter, in a corner an eighth: what they add up to is the tile's own share of a larger
specimen (Odgaard and Gundersen 1993).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing import feature_kernels as kernels
from processing.blocks import crossed, euler_table, surface_table
from processing.parts import Parts
from processing.planes import slabs

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.neighbours import Rule, Spacing
    from processing.planes import Planes

    Array = NDArray[Any]
    Mask = NDArray[np.bool_]
    Place = tuple[int, int, int]

OUTSIDE_RULE: dict[int, Rule] = {6: 26, 18: 6, 26: 6}  # how what is not inside touches
BLOCKS_EACH = 4  # along each axis, at most, for the counting error
FEWEST_BLOCK_VOXELS = 4  # along each axis


class Fillings:
    """Blocks of 2×2×2 voxels of a mask, counted by their filling as its slabs come."""

    def __init__(self) -> None:
        self.counts = np.zeros((2, 256), np.int64)
        self._last: Array | None = None

    def add(self, mask: Mask) -> None:
        """Take the next slab."""
        for plane in mask:
            framed = np.pad(plane.view(np.uint8), 1)
            last = np.zeros_like(framed) if self._last is None else self._last
            kernels.count_fillings(last, framed, self._last is not None, self.counts)
            self._last = framed

    def total(self) -> Array:
        """Return how often each filling is there: in all blocks, with nothing beyond the border, and in those within.

        Returns
        -------
        array (2, 256) int64
        """
        if self._last is not None:
            kernels.count_fillings(self._last, np.zeros_like(self._last), False, self.counts)  # noqa: FBT003
        return np.stack([self.counts.sum(axis=0), self.counts[1]])


class Filled:
    """Voxels inside, counted for each plane of each axis, and for the parts of the planes, as slabs come."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.along = [np.zeros(n, np.int64) for n in shape]
        self._cuts = [np.linspace(0, n, _parts(n) + 1).astype(int)[:-1] for n in shape]
        self._parts: list[Array] = []

    def add(self, start: int, mask: Mask) -> None:
        """Take the slab that begins at plane ``start``."""
        inside = mask.view(np.uint8)
        rows = np.add.reduceat(inside, self._cuts[1], axis=1, dtype=np.uint32)
        self.along[0][start : start + len(mask)] = rows.sum(axis=(1, 2))
        self.along[1] += inside.sum(axis=(0, 2), dtype=np.int64)
        self.along[2] += rows.sum(axis=(0, 1), dtype=np.int64)
        self._parts.append(np.add.reduceat(rows, self._cuts[2], axis=2, dtype=np.int64))

    def shares(self, shape: tuple[int, ...]) -> Array:
        """Return which share of each block of the volume is inside."""
        filled = np.add.reduceat(np.concatenate(self._parts), self._cuts[0], axis=0)
        sizes = [np.diff([*cut, n]) for cut, n in zip(self._cuts, shape, strict=True)]
        return np.asarray(filled / (sizes[0][:, None, None] * sizes[1][:, None] * sizes[2]))


@dataclass(frozen=True, eq=False)
class Whole:
    """What a mask adds up to.

    Attributes
    ----------
    shape : tuple of int
        Of the volume.
    rule : 6, 18 or 26
        Which voxels touch.
    fillings : array (2, 256) int64
        How often blocks are filled in each way: of all, as if nothing were outside, and of those within the volume.
    flat : array (256,) int64
        Of those within, where an axis of one voxel counts as two equal ones.
    along : list of arrays
        Voxels inside in each plane of each axis.
    shares : array
        Of blocks of the volume, how much is inside.
    parts, cavities : int
        Connected parts; those of what is outside that the border does not touch.
    """

    shape: tuple[int, ...]
    rule: Rule
    fillings: Array
    flat: Array
    along: list[Array]
    shares: Array
    parts: int
    cavities: int

    @property
    def inside(self) -> int:
        """Voxels inside."""
        return int(self.along[0].sum())

    @property
    def size(self) -> int:
        """Voxels of the volume."""
        return int(np.prod(self.shape))

    @property
    def fullest(self) -> tuple[int, ...]:
        """The plane of each axis in which most is inside; the middle one where several are equal."""
        best = [np.flatnonzero(counts == counts.max()) for counts in self.along]
        return tuple(int(b[np.abs(b - len(n) // 2).argmin()]) for b, n in zip(best, self.along, strict=True))

    @property
    def euler(self) -> int:
        """Euler number, as if nothing were outside."""
        return round(float(self.fillings[0] @ euler_table(self.rule)) / 8)

    @property
    def euler_share(self) -> float:
        """Euler number without what the border adds: what the volume adds to that of a larger specimen."""
        return float(self.fillings[1] @ euler_table(self.rule)) / 8

    def surface_um2(self, spacing_um: Spacing) -> float:
        """Surface by Crofton's formula, without the cuts at the border."""
        return float(self.fillings[1] @ surface_table(spacing_um))

    def crossings(self, step: Place) -> float:
        """Share of the steps of a direction that cross the surface, between the middles of the outermost voxels."""
        return float(self.flat @ crossed(step)) / max(int(self.flat.sum()), 1)


def whole(labels: Planes, rule: Rule = 26, told: Callable[[int], None] | None = None) -> Whole:
    """Go through a mask, or labels, once, and add up what is to be known of the whole.

    Parameters
    ----------
    labels : volume (z, y, x)
        0 outside.
    rule : 6, 18 or 26
        Which voxels touch; what is outside touches by the opposite rule.
    told : callable, optional
        Told how many planes are done.
    """
    shape = labels.shape
    fillings, filled = Fillings(), Filled(shape)
    flat = Fillings() if 1 in shape else fillings
    parts, outside = Parts(rule), Parts(OUTSIDE_RULE[rule])
    for start, slab in slabs(labels):
        mask = slab > 0
        fillings.add(mask)
        if flat is not fillings:
            flat.add(_doubled(mask, shape))
        filled.add(start, mask)
        parts.add(mask)
        outside.add(~mask)
        if told:
            told(start + len(mask))
    counts = fillings.total()
    inner = counts[1] if flat is fillings else flat.counts[1]
    found = parts.total()[0], outside.total()[1]
    return Whole(shape, rule, counts, inner, filled.along, filled.shares(shape), *found)


def _doubled(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """Return a mask whose axes of one voxel have two equal ones."""
    for axis in (axis for axis, n in enumerate(shape) if n == 1):
        mask = np.repeat(mask, 2, axis=axis)
    return mask


def _parts(length: int) -> int:
    return int(np.clip(length // FEWEST_BLOCK_VOXELS, 1, BLOCKS_EACH))
