"""How far it is from every voxel of a mask to the nearest voxel outside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import edt
import numpy as np

from devices.errors import InputError
from processing.compiled import compiled
from processing.masks import as_mask
from processing.neighbours import CUBIC, Spacing, checked_spacing
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


FAR = np.float32(1e18)  # further than anything, and its square still a number
THICK = 24  # voxels of mean distance along rows, beyond which a library that sorts parabolas is faster
PIECE = 256  # voxels of a row that are lowered together: they and their neighbours fit into the fast memory
LOOKS = 4  # steps after which is looked how much there is left to lower


@operator("distance.map", gives=[Layer("volume", "volume", "float32")])
def distance(
    volume: Array, spacing_um: Spacing | None = None, *, outside: bool = False, signed: bool = False
) -> NDArray[np.float32]:
    """Distance from every voxel inside a mask to the nearest one outside, in µm (voxels without a spacing).

    Parameters
    ----------
    volume : array (z, y, x)
        A mask. What lies beyond the border of the volume is not known and counts as nothing.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x); any, since distances need no neighbours.
    outside : bool
        The reverse: from every voxel outside to the nearest one inside.
    signed : bool
        Both: positive inside, negative outside.

    Returns
    -------
    array (z, y, x) float32
        Euclidean distances between middles of voxels, exact but for rounding.

    Raises
    ------
    InputError
        ``mask-full``: nothing to measure to, the mask fills the volume, or is empty with ``outside``;
        ``mask-needed``, ``spacing``; ``volume-shape``, ``volume-nan``.
    """
    inside = as_mask(volume)
    spacing = checked_spacing(spacing_um or CUBIC)
    if signed:
        return np.asarray(to_nearest(inside, spacing) - to_nearest(~inside, spacing), np.float32)
    return to_nearest(~inside if outside else inside, spacing)


def to_nearest(inside: NDArray[np.bool_], spacing: Spacing) -> NDArray[np.float32]:
    """Return the distance from every voxel inside to the nearest one outside; raises `InputError` ``mask-full``."""
    if inside.all():
        raise InputError(
            "the mask fills the whole volume or, seen from outside, nothing of it: no distance has an end.",
            fix="choose another threshold.",
            code="mask-full",
        )
    dz, dy, dx = (np.float32(s) for s in spacing)
    planes = len(inside)
    rows, squared = np.empty(inside.shape, np.float32), np.empty(inside.shape, np.float32)
    if along_rows(inside, dx, rows) > THICK:
        return np.asarray(edt.edt(inside, anisotropy=spacing, black_border=False, parallel=1), np.float32)
    across_rows(rows, dy, squared)
    across_rows(squared.reshape(1, planes, -1), dz, rows.reshape(1, planes, -1))
    return np.sqrt(rows, out=rows)


@compiled
def along_rows(inside: Array, step: Any, out: Array) -> Any:
    """Put the squared distance to the nearest voxel outside in the same row into ``out``; FAR where there is none.

    Returns the mean distance in voxels inside, that of rows without an end being their length.
    """
    nz, ny, nx = inside.shape
    total, count = 0.0, 1
    for z in range(nz):
        for y in range(ny):
            row, line = inside[z, y], out[z, y]
            away = FAR
            for x in range(nx):
                away = away + step if row[x] else np.float32(0)
                line[x] = away
            away = FAR
            for x in range(nx - 1, -1, -1):
                away = away + step if row[x] else np.float32(0)
                nearest = min(away, line[x])
                line[x] = nearest * nearest
                total += min(nearest, step * np.float32(nx))
                count += row[x]
    return total / count / step


@compiled
def across_rows(near: Array, step: Any, out: Array) -> None:
    """Take the rows before and behind into account, (outer, rows, x): least of their squares plus that of the way."""
    outer, count, width = near.shape
    for o in range(outer):
        for begin in range(0, width, PIECE):
            end = min(begin + PIECE, width)
            rows, lines = near[o, :, begin:end], out[o, :, begin:end]
            for i in range(count):
                lower_to_all(lines[i], rows, i, step)


@compiled
def lower_to_all(line: Array, rows: Array, i: int, step: Any) -> None:
    """Make a line of row ``i`` and lower it to all others, until the way alone is longer than what is left to lower.

    Parabolas as of Felzenszwalb and Huttenlocher (2012), without their sorting: a piece of a row at a time.
    """
    count = len(rows)
    lower(line, rows[i], np.float32(0), True)  # noqa: FBT003  compiled code
    most = line.max()
    for k in range(1, max(i, count - 1 - i) + 1):
        way = (step * np.float32(k)) ** 2
        if way >= most:
            break
        if i >= k:
            lower(line, rows[i - k], way, False)  # noqa: FBT003
        if i + k < count:
            lower(line, rows[i + k], way, False)  # noqa: FBT003
        if k % LOOKS == 0:
            most = line.max()


@compiled
def lower(line: Array, row: Array, way: Any, first: bool) -> None:  # noqa: FBT001
    """Lower a line to a row that lies further away, or begin it with one."""
    if first:
        for x in range(line.size):
            line[x] = row[x]
    else:
        for x in range(line.size):
            line[x] = min(row[x] + way, line[x])
