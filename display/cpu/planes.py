"""Planes through a volume on the processor: the same pictures as ``shaders/planes.frag.glsl``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, over_rows
from display.cpu.sampling import TINY, Grid, grid, trilinear, voxel_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.bricks import Bricks
    from display.rays import Rays

    Array = NDArray[Any]

HAIR = 1e-4  # voxels outside that still count as inside


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
    over_rows(size[1], lambda first, last: cut_rows(drawn, geometry, scale, planes, first, last, seen))
    return seen


@fast
def cut_rows(drawn: Grid, geometry: Array, scale: Array, planes: Array, first: int, last: int, seen: Array) -> None:
    """Cut the planes along the rays of some rows."""
    for j in range(first, last):
        for k in range(planes.shape[0]):
            cut_row(drawn, geometry, scale, planes, k, j, seen)


@fast
def cut_row(drawn: Grid, geometry: Array, scale: Array, planes: Array, number: int, j: int, seen: Array) -> None:
    """Lay one plane into one row, where it is nearer than what is there and not transparent.

    All numbers are read before the loop: in it the compiler must suppose that what is written changes them.
    """
    nx, ny, nz, distance = planes[number, 0], planes[number, 1], planes[number, 2], planes[number, 3]
    mx, my, mz = planes[number, 4] + 1, planes[number, 5] + 1, planes[number, 6] + 1
    vx, vy, vz = geometry[5, 0], geometry[5, 1], geometry[5, 2]
    ox, oy, oz = (
        geometry[0, 0] + j * geometry[2, 0],
        geometry[0, 1] + j * geometry[2, 1],
        geometry[0, 2] + j * geometry[2, 2],
    )
    rx, ry, rz, ex, ey, ez = (
        geometry[1, 0],
        geometry[1, 1],
        geometry[1, 2],
        geometry[4, 0],
        geometry[4, 1],
        geometry[4, 2],
    )
    ax, ay, az = geometry[6, 0] + 1 - HAIR, geometry[6, 1] + 1 - HAIR, geometry[6, 2] + 1 - HAIR
    bx, by, bz = geometry[7, 0] + 1 + HAIR, geometry[7, 1] + 1 + HAIR, geometry[7, 2] + 1 + HAIR
    low, per_value, transparent = scale[0], scale[1], scale[2]
    perspective, smooth = scale[3] > 0, scale[4] > 0
    dx, dy, dz = geometry[3, 0], geometry[3, 1], geometry[3, 2]
    reach = np.sqrt((dx * vx) ** 2 + (dy * vy) ** 2 + (dz * vz) ** 2)
    towards = nx * dx + ny * dy + nz * dz
    for i in range(seen.shape[1]):
        x, y, z = ox + i * rx, oy + i * ry, oz + i * rz
        if perspective:
            dx, dy, dz = x - ex, y - ey, z - ez
            reach = np.sqrt((dx * vx) ** 2 + (dy * vy) ** 2 + (dz * vz) ** 2)
            towards = nx * dx + ny * dy + nz * dz
        if abs(towards) < TINY:
            continue
        t = (distance - nx * x - ny * y - nz * z) / towards
        way = t * reach
        x, y, z = x + t * dx + mx, y + t * dy + my, z + t * dz + mz
        if not (ax <= x <= bx and ay <= y <= by and az <= z <= bz):
            continue
        if (perspective and t <= -1) or (seen[j, i, 2] > 0 and way >= seen[j, i, 1]):
            continue
        value = (value_at(drawn, x, y, z, smooth) - low) * per_value
        if value >= transparent:
            seen[j, i, 0], seen[j, i, 1] = min(max(value, 0.0), 1.0), way
            seen[j, i, 2], seen[j, i, 3] = 1.0, number


@fast
def value_at(drawn: Grid, x: float, y: float, z: float, smooth: bool) -> Any:  # noqa: FBT001
    """Return the value at a point in indices of ``drawn``, interpolated or that of the voxel it lies in."""
    if smooth:
        return trilinear(drawn, np.float32(x), np.float32(y), np.float32(z))
    i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
    i, j, k = min(max(i, 1), drawn.width - 2), min(max(j, 1), drawn.height - 2), min(max(k, 1), drawn.depth - 2)
    return voxel_at(drawn, i, j, k)
