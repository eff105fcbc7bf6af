"""A volume and a camera in the terms of a ray caster: lengths in voxels, values between 0 and 1. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.resolve import Camera
    from display.scene import Volume

    Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays through a grid whose voxel (x, y, z) is the cube of side 1 around that point.

    Attributes
    ----------
    corner, right, down, along : array (3,)
        As in `Camera`, in voxels.
    eye : array (3,), optional
        Where rays meet.
    voxel_um : array (3,)
        Size of a voxel.
    """

    corner: Array
    right: Array
    down: Array
    along: Array
    eye: Array | None
    voxel_um: Array


def rays(camera: Camera, volume: Volume) -> Rays:
    """Return the rays of a camera in the voxels of a volume."""
    return in_voxels(camera.corner, camera.right, camera.down, camera.along, camera.eye, volume)


def in_voxels(corner: Array, right: Array, down: Array, along: Array, eye: Array | None, volume: Volume) -> Rays:
    """Return rays given in µm in the voxels of a volume."""
    voxel, middle = volume.voxel_um, (np.array(volume.shape[::-1]) - 1) / 2
    place = None if eye is None else eye / voxel + middle
    return Rays(corner / voxel + middle, right / voxel, down / voxel, along / voxel, place, voxel)


def thinned(seen_by: Rays, step: int) -> Rays:
    """Return rays through a grid of which only each ``step``-th voxel along every axis, the first included, is left."""
    corner, right, down, along = (part / step for part in (seen_by.corner, seen_by.right, seen_by.down, seen_by.along))
    eye = None if seen_by.eye is None else seen_by.eye / step
    return Rays(corner, right, down, along, eye, seen_by.voxel_um * step)


def bounds(volume: Volume, cut: tuple[tuple[float, float], ...]) -> tuple[Array, Array]:
    """Return the lowest and highest (x, y, z) that is shown, in voxels, of a cut in shares of the whole."""
    size = np.array(volume.shape[::-1], np.float64)
    shares = np.clip(np.array(cut, np.float64), 0, 1)
    return shares[:, 0] * size - 0.5, shares[:, 1] * size - 0.5
