"""A volume made ready for the processor: a rim of one voxel, and the extremes of bricks so that rays leap over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, over_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

SIDE = 8
WORD = 4  # bytes


@dataclass(frozen=True, eq=False)
class Bricks:
    """A volume with a rim.

    Attributes
    ----------
    padded : array (z + 2, y + 2, x + 2)
        The outermost voxels are there twice, so that no sample inside the volume needs a look at its borders.
    low, high : array (bz, by, bx) float32
        Extremes of all values that samples in a brick of 8³ can touch; brick 0 begins at index 0 of ``padded``.
    """

    padded: Array
    low: Array
    high: Array

    @property
    def words(self) -> NDArray[np.uint32]:
        """What stands at each voxel and the next along x in one number, (voxels,); little end first, as it is kept."""
        size = self.padded.itemsize
        return np.ndarray((self.padded.size,), "<u4", self.padded.base, 0, (size,))


def make_bricks(values: Array) -> Bricks:
    """Copy a volume (z, y, x) into a rim, and find the extremes of its bricks."""
    padded = roomy(tuple(n + 2 for n in values.shape), values.dtype)
    padded[1:-1, 1:-1, 1:-1] = values
    for axis in range(3):
        for rim, inside in ((0, 1), (-1, -2)):
            at = [slice(None)] * 3
            at[axis] = rim  # type: ignore[call-overload]
            source = list(at)
            source[axis] = inside  # type: ignore[call-overload]
            padded[tuple(at)] = padded[tuple(source)]
    shape = tuple(-(-n // SIDE) for n in padded.shape)
    low, high = np.empty(shape, np.float32), np.empty(shape, np.float32)
    over_rows(shape[0], lambda first, last: extremes(padded, first, last, low, high))
    return Bricks(padded, low, high)


def roomy(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    """Return an array behind whose end a word may be read."""
    count = int(np.prod(shape))
    return np.empty(count * dtype.itemsize + WORD, np.uint8)[: count * dtype.itemsize].view(dtype).reshape(shape)


@fast
def extremes(padded: Array, first: int, last: int, low: Array, high: Array) -> None:
    """Find the extremes of layers of bricks, each with the one voxel beyond that interpolation touches."""
    depth, height, width = padded.shape
    for bz in range(first, last):
        low[bz] = np.inf
        high[bz] = -np.inf
        for z in range(bz * SIDE, min(bz * SIDE + SIDE + 1, depth)):
            for y in range(height):
                row = padded[z, y]
                by = y // SIDE
                for bx in range(low.shape[2]):
                    part = row[bx * SIDE : min(bx * SIDE + SIDE + 1, width)]
                    least, most = part[0], part[0]
                    for i in range(part.size):
                        least, most = min(least, part[i]), max(most, part[i])
                    low[bz, by, bx] = min(low[bz, by, bx], least)
                    high[bz, by, bx] = max(high[bz, by, bx], most)
                    if y % SIDE == 0 and by > 0:
                        low[bz, by - 1, bx] = min(low[bz, by - 1, bx], least)
                        high[bz, by - 1, bx] = max(high[bz, by - 1, bx], most)
