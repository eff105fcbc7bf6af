"""Beads and tubes in a volume, as a widefield microscope sees them, with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.fft import irfftn, rfftn

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Shape = tuple[int, int, int]


@dataclass(frozen=True)
class Volume:
    """What is there, and what is seen.

    Attributes
    ----------
    seen : array (planes, rows, columns) uint16
        Blurred, with the noise of light and camera.
    truth : array (planes, rows, columns) float32
        The light of every voxel, grey levels.
    places : array (beads, 3) float64
        Middles of the beads in voxels: plane, row, column.
    noise : float
        Camera noise (rms), grey levels.
    background : float
        Grey level of no light.
    """

    seen: NDArray[np.uint16]
    truth: NDArray[np.float32]
    places: NDArray[np.float64]
    noise: float
    background: float


def beads(seed: int, psf: Array, shape: Shape, *, count: int = 12, level: float = 4000.0, noise: float = 2.0) -> Volume:
    """Point-like beads at any place between voxels, apart from each other as far as there is room.

    Parameters
    ----------
    seed : int
    psf : array
        Odd sides, sum 1.
    shape : (planes, rows, columns)
    count : int
        Beads that are tried to be placed.
    level : float
        Light of a bead, all voxels together, over the largest value of the point spread function.
    noise : float
        Of the camera (rms), grey levels.
    """
    rng = np.random.default_rng(seed)
    half = np.array(psf.shape) // 2
    places: list[Array] = []
    for _ in range(50 * count):
        place = half + rng.random(3) * (np.array(shape) - 1 - 2 * half)
        if len(places) < count and all((np.abs(place - other) > 2 * half).any() for other in places):
            places.append(place)
    truth = np.zeros(shape, np.float32)
    for place in places:
        splat(truth, place, level / float(psf.max()))
    return _photographed(rng, truth, psf, np.array(places), noise)


def splat(truth: Array, place: Array, light: float) -> None:
    """Share the light of a point among its eight voxels."""
    low = np.floor(place).astype(int)
    part = place - low
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part))
        truth[tuple(low + corner)] += light * weight


def cells(seed: int, psf: Array, shape: Shape, *, level: float = 60.0, noise: float = 2.0) -> Volume:
    """Shells, tubes and small beads of uneven brightness: what a fluorescence stack looks like.

    Parameters
    ----------
    seed, psf, shape, noise
        As in `beads`.
    level : float
        Mean light of what shines.
    """
    rng = np.random.default_rng(seed)
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape), indexing="ij")
    truth = np.zeros(shape, np.float32)
    side = min(shape[1:])
    for cz, cy, cx, size, light in rng.random((10, 5)):
        radius = side * (0.05 + 0.08 * size)
        away = np.sqrt(((z - cz * shape[0]) * 2) ** 2 + (y - cy * shape[1]) ** 2 + (x - cx * shape[2]) ** 2)
        truth += (0.5 + light) * level * np.exp(-(((away - radius) / 1.5) ** 2))
    for cz, cy, angle, light, lean in rng.random((8, 5)):
        along = y - cy * shape[1] - np.tan(2 * (angle - 0.5)) * (x - shape[2] / 2)
        depth = z - cz * shape[0] - (lean - 0.5) * 0.2 * x
        truth += (0.5 + light) * 2 * level * np.exp(-(along**2 + (2 * depth) ** 2) / 4)
    places = rng.random((20, 3)) * (np.array(shape) - 2)
    for place in places:
        splat(truth, place, 30 * level)
    return _photographed(rng, truth, psf, places, noise)


def _photographed(rng: np.random.Generator, truth: Array, psf: Array, places: Array, noise: float) -> Volume:
    background = 100.0
    light = np.maximum(blurred(truth, psf), 0)
    seen = rng.poisson(light) + background + noise * rng.normal(size=truth.shape)
    return Volume(np.clip(np.rint(seen), 0, 65535).astype(np.uint16), truth, places, noise, background)


def blurred(truth: Array, psf: Array) -> NDArray[np.float32]:
    """Convolve, darkness all around."""
    shape = [n + k for n, k in zip(truth.shape, psf.shape, strict=True)]
    spectrum = rfftn(truth, shape) * rfftn(psf, shape)
    start = [k // 2 for k in psf.shape]
    whole = irfftn(spectrum, shape)
    return np.asarray(whole[tuple(slice(s, s + n) for s, n in zip(start, truth.shape, strict=True))], np.float32)
