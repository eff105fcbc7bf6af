"""Planes through a volume on the processor: the same pictures as ``shaders/planes.frag.glsl``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, over_rows
from display.cpu.cast import TINY, trilinear

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.rays import Rays

    Array = NDArray[Any]


def cut_planes(
    padded: Array,
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
    padded : array (z + 2, y + 2, x + 2)
        See `display.cpu.bricks`.
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
    over_rows(size[1], lambda first, last: cut_rows(padded, geometry, scale, planes, first, last, seen))
    return seen


@fast
def cut_rows(padded: Array, geometry: Array, scale: Array, planes: Array, first: int, last: int, seen: Array) -> None:
    """Cut the planes along the rays of some rows."""
    voxel, eye = geometry[5], geometry[4]
    ox, oy, oz = geometry[0]
    for j in range(first, last):
        for i in range(seen.shape[1]):
            x = ox + i * geometry[1, 0] + j * geometry[2, 0]
            y = oy + i * geometry[1, 1] + j * geometry[2, 1]
            z = oz + i * geometry[1, 2] + j * geometry[2, 2]
            dx, dy, dz = geometry[3, 0], geometry[3, 1], geometry[3, 2]
            if scale[3] > 0:
                dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
            reach = np.sqrt((dx * voxel[0]) ** 2 + (dy * voxel[1]) ** 2 + (dz * voxel[2]) ** 2)
            nearest = -1.0 if scale[3] > 0 else -1e18
            cut_ray(padded, geometry, scale, planes, (x, y, z), (dx, dy, dz), reach, nearest, seen[j, i])


@fast
def cut_ray(
    padded: Array,
    geometry: Array,
    scale: Array,
    planes: Array,
    start: tuple[float, float, float],
    way: tuple[float, float, float],
    reach: float,
    nearest: float,
    seen: Array,
) -> None:
    """Find the nearest plane along a ray that is not transparent there."""
    best = 1e18
    low, high = geometry[6], geometry[7]
    for k in range(planes.shape[0]):
        nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
        towards = nx * way[0] + ny * way[1] + nz * way[2]
        if abs(towards) < TINY:
            continue
        t = (planes[k, 3] - nx * start[0] - ny * start[1] - nz * start[2]) / towards
        x, y, z = (
            start[0] + t * way[0] + planes[k, 4],
            start[1] + t * way[1] + planes[k, 5],
            start[2] + t * way[2] + planes[k, 6],
        )
        if nearest < t < best and within(x, y, z, low, high):
            value = (value_at(padded, x + 1, y + 1, z + 1, scale[4]) - scale[0]) * scale[1]
            if value >= scale[2]:
                best = t
                seen[0], seen[1], seen[2], seen[3] = min(max(value, 0.0), 1.0), t * reach, 1.0, k


@fast
def within(x: float, y: float, z: float, low: Array, high: Array) -> bool:
    """Tell whether a point lies in what is shown; a hair's breadth outside still does."""
    hair = 1e-4
    inside_x = low[0] - hair <= x <= high[0] + hair
    return bool(inside_x and low[1] - hair <= y <= high[1] + hair and low[2] - hair <= z <= high[2] + hair)


@fast
def value_at(padded: Array, x: float, y: float, z: float, smooth: float) -> Any:
    """Return the value at a point in indices of ``padded``, interpolated or that of the voxel it lies in."""
    if smooth > 0:
        return trilinear(padded, x, y, z)
    depth, height, width = padded.shape
    i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
    return np.float32(padded[min(max(k, 1), depth - 2), min(max(j, 1), height - 2), min(max(i, 1), width - 2)])
