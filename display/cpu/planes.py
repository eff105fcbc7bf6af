"""Planes through a volume on the processor: the same pictures as ``shaders/planes.frag.glsl``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, inlined, over_rows
from display.cpu.sampling import RUN, TINY, Grid, Room, draw, grid, room, trilinear, voxel_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.bricks import Bricks
    from display.rays import Rays

    Array = NDArray[Any]

HAIR = 1e-4  # voxels outside that still count as inside
LOW, PER_VALUE, TRANSPARENT, PERSPECTIVE, SMOOTH = range(5)  # places of the numbers of a cut


def cut_planes(
    bricks: Bricks,
    rays: Rays,
    box: tuple[Array, Array],
    size: tuple[int, int],
    planes: Array,
    *,
    limits: tuple[float, float],
    transparent: float,
    smooth: bool,
) -> NDArray[np.float32]:
    """Return what each ray sees of some planes, the nearest first.

    Parameters
    ----------
    bricks : Bricks
        The volume.
    planes : array (planes, 7)
        Normal and distance, n · p = d in voxels, and what is added to a point to find its value.
    transparent : float
        Share between the limits below which a plane is not there.

    Returns
    -------
    array (height, width, 4) float32
        Value, distance in µm, 1 where a plane is seen, number of the plane.
    """
    seen = np.zeros((size[1], size[0], 4), np.float32)
    eye = np.zeros(3) if rays.eye is None else rays.eye
    geometry = np.stack([rays.corner, rays.right, rays.down, rays.along, eye, rays.voxel_um, *box])
    scale = np.array([limits[0], 1 / (limits[1] - limits[0]), transparent, rays.eye is not None, smooth], np.float64)
    drawn = grid(bricks)
    over_rows(size[1], lambda *rows: cut_rows(drawn, room(bricks), geometry, scale, planes, rows, seen))
    return seen


@fast
def cut_rows(
    grid: Grid, room: Room, geometry: Array, scale: Array, planes: Array, rows: tuple[int, ...], seen: Array
) -> None:
    """Cut the planes along the rays of some rows."""
    for j in range(rows[0], rows[1]):
        for k in range(planes.shape[0]):
            if scale[PERSPECTIVE] > 0:
                cut_fan(grid, geometry, scale, planes, k, j, seen)
            else:
                cut_row(grid, room, geometry, scale, planes, k, j, seen)


@fast
def cut_row(
    grid: Grid, room: Room, geometry: Array, scale: Array, planes: Array, number: int, j: int, seen: Array
) -> None:
    """Lay one plane into one row of parallel rays: the points where they meet it lie on a line, at equal distances."""
    normal, along, right = planes[number], geometry[3], geometry[1]
    towards = inner(normal, along)
    if abs(towards) < TINY:
        return
    dt = -inner(normal, right) / towards
    t = (normal[3] - inner(normal, geometry[0]) - j * inner(normal, geometry[2])) / towards
    x, y, z = meeting(geometry, normal, t, j, 0), meeting(geometry, normal, t, j, 1), meeting(geometry, normal, t, j, 2)
    dx, dy, dz = right[0] + dt * along[0], right[1] + dt * along[1], right[2] + dt * along[2]
    begin, end = 0.0, float(seen.shape[1] - 1)
    for a, (start, step) in enumerate(((x, dx), (y, dy), (z, dz))):
        begin, end = inside(start, step, geometry[6, a] + 1 - HAIR, geometry[7, a] + 1 + HAIR, begin, end)
    reach = length_um(along, geometry[5])
    beyond = int(np.floor(end)) + 1
    for first in range(int(np.ceil(begin)), beyond, RUN):
        count = min(beyond - first, RUN)
        if scale[SMOOTH] > 0:
            # from a place within the volume: of a plane seen edge-on the row begins too far away for 32 bits
            place = (x + first * dx, y + first * dy, z + first * dz)
            draw(grid, room, (0.0, 0.0, 0.0, *place, dx, dy, dz, 0.0, 0.0, 0.0), 0, count)
        else:
            for s in range(count):
                i = first + s
                room.found[s] = nearest(grid, x + i * dx, y + i * dy, z + i * dz)
        for s in range(count):
            show(room.found[s], (t + (first + s) * dt) * reach, number, scale, seen[j, first + s])


@fast
def inner(one: Array, two: Array) -> Any:
    """Return the inner product of two vectors of the space."""
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]


@fast
def meeting(geometry: Array, normal: Array, t: float, j: int, axis: int) -> Any:
    """Return where the first ray of a row meets a plane, as an index of the volume with its rim."""
    return geometry[0, axis] + j * geometry[2, axis] + t * geometry[3, axis] + normal[4 + axis] + 1


@fast
def inside(start: float, step: float, low: float, high: float, begin: float, end: float) -> tuple[float, float]:
    """Return between which steps, from ``begin`` to ``end``, a coordinate stays within its limits."""
    if abs(step) < TINY:
        return (begin, end) if low <= start <= high else (1.0, 0.0)
    one, two = (low - start) / step, (high - start) / step
    return max(begin, min(one, two)), min(end, max(one, two))


@fast
def length_um(way: Array, voxel_um: Array) -> Any:
    """Return the length of a way given in voxels."""
    return np.sqrt((way[0] * voxel_um[0]) ** 2 + (way[1] * voxel_um[1]) ** 2 + (way[2] * voxel_um[2]) ** 2)


@inlined
def show(value: Any, way_um: float, number: int, scale: Array, seen: Array) -> None:
    """Write what is seen of a plane if it is not transparent, nor behind another."""
    share = (value - scale[LOW]) * scale[PER_VALUE]
    if share >= scale[TRANSPARENT] and (seen[2] == 0 or way_um < seen[1]):
        seen[0], seen[1], seen[2], seen[3] = min(max(share, 0.0), 1.0), way_um, 1.0, number


@fast
def cut_fan(grid: Grid, geometry: Array, scale: Array, planes: Array, number: int, j: int, seen: Array) -> None:
    """Lay one plane into one row of rays that meet in the eye."""
    normal, eye, voxel_um = planes[number], geometry[4], geometry[5]
    for i in range(seen.shape[1]):
        x = geometry[0, 0] + j * geometry[2, 0] + i * geometry[1, 0]
        y = geometry[0, 1] + j * geometry[2, 1] + i * geometry[1, 1]
        z = geometry[0, 2] + j * geometry[2, 2] + i * geometry[1, 2]
        dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
        towards = normal[0] * dx + normal[1] * dy + normal[2] * dz
        if abs(towards) < TINY:
            continue
        t = (normal[3] - normal[0] * x - normal[1] * y - normal[2] * z) / towards
        reach = np.sqrt((dx * voxel_um[0]) ** 2 + (dy * voxel_um[1]) ** 2 + (dz * voxel_um[2]) ** 2)
        x, y, z = x + t * dx + normal[4] + 1, y + t * dy + normal[5] + 1, z + t * dz + normal[6] + 1
        if t > -1 and within(x, geometry, 0) and within(y, geometry, 1) and within(z, geometry, 2):
            smooth = scale[SMOOTH] > 0
            value = trilinear(grid, np.float32(x), np.float32(y), np.float32(z)) if smooth else nearest(grid, x, y, z)
            show(value, t * reach, number, scale, seen[j, i])


@fast
def within(place: float, geometry: Array, axis: int) -> bool:
    """Tell whether a place is shown."""
    return bool(geometry[6, axis] + 1 - HAIR <= place <= geometry[7, axis] + 1 + HAIR)


@fast
def nearest(grid: Grid, x: float, y: float, z: float) -> Any:
    """Return the value of the voxel that holds a point."""
    i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
    return voxel_at(
        grid, min(max(i, 1), grid.width - 2), min(max(j, 1), grid.height - 2), min(max(k, 1), grid.depth - 2)
    )
