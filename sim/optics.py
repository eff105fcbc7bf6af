"""What the sensor sees: defocus by distance and aperture, diffraction.

A point at the distance d from the plane of focus becomes a disc of radius ``d·tan(asin(NA/n))``, convolved with a
Gaussian of ``σ = 0.21 λ/NA`` for diffraction (Zhang, Zerubia, Olivo-Marin 2007). All blurs of a texture are made
once; a frame then only picks, for every pixel, between the two of the nearest distances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

LEVELS = 40
FULL_SCALE = 60000.0
FARTHEST_UM = 80.0
DISC_TABLE_CYCLES = 32.0  # beyond, nothing of a disc is above 0.0006
DISC_NODES = 256


@dataclass(frozen=True)
class Optics:
    """An objective, in pixels at the object of ``pixel_um``."""

    na: float
    medium_index: float
    wavelength_um: float
    pixel_um: float

    def disc_radius_px(self, distance_um: float) -> float:
        """Return the radius of the geometric blur disc."""
        return abs(distance_um) * math.tan(math.asin(self.na / self.medium_index)) / self.pixel_um

    @property
    def core_sigma_px(self) -> float:
        """Return σ of the diffraction-limited core."""
        return 0.21 * self.wavelength_um / self.na / self.pixel_um


def level_distances_um(farthest_um: float = FARTHEST_UM, levels: int = LEVELS) -> np.ndarray:
    """Return the distances for which blurs are made: growing with the square, fine near focus."""
    return farthest_um * (np.arange(levels) / (levels - 1)) ** 2


def disc_transfer(cycles: np.ndarray) -> np.ndarray:
    """Return the transfer function of a uniform disc of radius 1 at spatial frequencies in cycles per radius.

    It is ``2 J1(2πf)/(2πf)``, the cosine transform of the disc's chords; taken from a table of that integral.
    """
    return np.asarray(np.interp(cycles, *_disc_table(), right=0.0))


@cache
def _disc_table() -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies and values, by Gauss-Chebyshev quadrature: exact for the chords' weight sqrt(1 - x²)."""
    cycles = np.linspace(0, DISC_TABLE_CYCLES, 8193)
    angles = np.arange(1, DISC_NODES + 1) * np.pi / (DISC_NODES + 1)
    weights = np.sin(angles) ** 2 * 2 / (DISC_NODES + 1)
    parts = [np.cos(2 * np.pi * part[:, None] * np.cos(angles)) @ weights for part in np.array_split(cycles, 16)]
    return cycles, np.concatenate(parts)


def blurred(texture: np.ndarray, optics: Optics, distances_um: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return (levels, tile, tile) uint16: the texture at each distance from focus, `FULL_SCALE` for 1.

    The texture is periodic, so it has no edges.
    """
    tile = texture.shape[0]
    spectrum = np.fft.rfft2(texture.astype(np.float32))
    frequency = np.hypot(np.fft.fftfreq(tile)[:, None], np.fft.rfftfreq(tile)[None]).astype(np.float32)
    spectrum *= np.exp(-2 * (np.pi * optics.core_sigma_px * frequency) ** 2)
    levels = np.empty((len(distances_um), tile, tile), np.uint16)
    for level, distance_um in enumerate(distances_um):
        transfer = disc_transfer(frequency * optics.disc_radius_px(distance_um)).astype(np.float32)
        picture = np.fft.irfft2(spectrum * transfer, s=texture.shape)
        levels[level] = np.clip(np.rint(picture * FULL_SCALE), 0, 65535)
    return levels
