"""Pseudo-rotation: planes shifted over each other in whole or part voxels, and the brightest of them kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, over_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


HALF = 0.5


def shifted_maximum(values: Array, slope: tuple[float, float], *, whole: bool) -> tuple[Array, tuple[int, int]]:
    """Return the brightest value over all planes of a volume, each shifted.

    Parameters
    ----------
    values : array (z, y, x)
    slope : (float, float)
        Voxels (x, y) by which a plane is shifted for each plane behind the middle one.
    whole : bool
        Round shifts to whole voxels; otherwise interpolate between neighbours.

    Returns
    -------
    found : array (y + rim, x + rim)
        float32, or of the volume's type for whole shifts; 0 where there is no plane.
    origin : (int, int)
        Voxel (x, y) of its first value.
    """
    depth, height, width = values.shape
    offsets = (np.arange(depth) - (depth - 1) / 2)[:, None] * np.array(slope)
    rim = np.ceil(np.abs(offsets).max(axis=0)).astype(int) + 1
    shape = (height + 2 * int(rim[1]), width + 2 * int(rim[0]))
    if whole:
        found = np.zeros(shape, values.dtype)
        starts = np.floor(offsets + 0.5).astype(int) + rim
        over_rows(shape[0], lambda first, last: keep_brightest(values, starts, found, first, last))
    else:
        found = np.zeros(shape, np.float32)
        moved = offsets + rim
        over_rows(
            shape[0],
            lambda first, last: blend_brightest(values, moved, found, first, last, np.empty(width, np.float32)),
        )
    return found, (-int(rim[0]), -int(rim[1]))


@fast
def keep_brightest(values: Array, starts: Array, found: Array, first: int, last: int) -> None:
    """Keep the brightest of all planes in some rows of the result."""
    depth, height, width = values.shape
    for k in range(depth):
        x, y = starts[k, 0], starts[k, 1]
        for j in range(max(first, y), min(last, y + height)):
            row, line = values[k, j - y], found[j, x : x + width]
            for i in range(width):
                line[i] = max(line[i], row[i])


@fast
def blend_brightest(values: Array, moved: Array, found: Array, first: int, last: int, row: Array) -> None:
    """Keep the brightest of all planes, interpolated, in some rows of the result; ``row`` is room for one."""
    depth, height, width = values.shape
    for k in range(depth):
        x, y = int(np.floor(moved[k, 0])), int(np.floor(moved[k, 1]))
        fx, fy = np.float32(moved[k, 0] - x), np.float32(moved[k, 1] - y)
        top, bottom = y + int(fy >= HALF), y + height + int(fy > HALF)  # pixels whose middle the plane covers
        for j in range(max(first, top), min(last, bottom)):
            above, below = values[k, max(j - y - 1, 0)], values[k, min(j - y, height - 1)]
            for i in range(width):
                row[i] = below[i] + fy * (np.float32(above[i]) - np.float32(below[i]))
            line = found[j, x : x + width + 1]
            if fx < HALF:
                line[0] = max(line[0], row[0])
            for i in range(1, width):
                line[i] = max(line[i], row[i] + fx * (row[i - 1] - row[i]))
            if fx > HALF:
                line[width] = max(line[width], row[width - 1])
