"""Frames: the light along the path of the axis during the exposure, then photon and read noise, then digits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from devices.values import CameraCaps
from sim.optics import FARTHEST_UM, FULL_SCALE, LEVELS, Optics, blurred, level_distances_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.specimen import Specimen

NOISE_TILE = 1024
FULL_WELL_E = 12000.0
READ_NOISE_E = 4.0
BLACK_LEVEL = 0.01
WHITE_LEVEL = 0.85


class Film:
    """Turns light into frames.

    Parameters
    ----------
    shape : (int, int)
        Height and width.
    bit_depth : int
        8 gives uint8 frames, more gives uint16.
    exposure_ms : float
        Exposure for which light of 1 comes near full scale.
    seed : int
        Of the noise: the same seed and the same exposures give the same frames.
    lamp : callable, optional
        Asked at each exposure for the brightness of the lamp, 1 as a rule.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        bit_depth: int,
        exposure_ms: float,
        seed: int,
        lamp: Callable[[], float] = lambda: 1.0,
    ) -> None:
        self.light = np.empty(shape, np.float32)
        self._shape = shape
        self._full = float((1 << bit_depth) - 1)
        self._nominal_ms = exposure_ms
        self._rng = np.random.default_rng(seed)
        self._noise = self._rng.standard_normal((NOISE_TILE, NOISE_TILE), np.float32)
        self._bit_depth = bit_depth
        self._lamp = lamp

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        height, width = self._shape
        dtype = "uint8" if self._bit_depth == 8 else "uint16"
        return CameraCaps("simulated camera", height, width, 1, dtype, self._bit_depth, timed=True)

    def develop(self, exposure_ms: float, out: np.ndarray, *, unit: float = 1.0) -> None:
        """Fill ``out`` with the frame of `light`, of which ``unit`` is 1."""
        gain = (WHITE_LEVEL - BLACK_LEVEL) / unit * exposure_ms / self._nominal_ms * self._lamp()
        _develop(self.light, self._noise, self._rng.integers(0, NOISE_TILE, 2), np.float32(gain), self._full, out)


class Sensor:
    """Takes pictures of a specimen through an objective.

    Parameters
    ----------
    specimen : Specimen
        What is seen.
    optics : Optics
        Through what.
    bit_depth, exposure_ms, seed, lamp
        As in `Film`.
    """

    def __init__(
        self,
        specimen: Specimen,
        optics: Optics,
        *,
        bit_depth: int,
        exposure_ms: float,
        seed: int,
        lamp: Callable[[], float] = lambda: 1.0,
    ) -> None:
        distances_um = level_distances_um()
        self._sheets = [(s.height_um, blurred(s.texture, optics, distances_um)) for s in specimen.sheets]
        shape = specimen.sheets[0].height_um.shape
        self._film = Film(shape, bit_depth=bit_depth, exposure_ms=exposure_ms, seed=seed, lamp=lamp)
        self.expose(np.zeros(1), exposure_ms, np.empty(shape, self.caps().dtype))  # compiles, once for all

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        return self._film.caps()

    def expose(self, path_um: np.ndarray, exposure_ms: float, out: np.ndarray) -> None:
        """Fill ``out`` with the picture of one exposure.

        Parameters
        ----------
        path_um : ndarray
            (n,) positions of the axis, equally long at each.
        exposure_ms : float
            How long in all.
        out : ndarray
            (height, width), of the type in `caps`.
        """
        self._film.light.fill(0)
        for height_um, levels in self._sheets:
            _add_light(self._film.light, height_um, levels, path_um.astype(np.float32))
        self._film.develop(exposure_ms, out, unit=FULL_SCALE * len(path_um))


@njit(nogil=True, fastmath=True, cache=True)
def _add_light(light: np.ndarray, height_um: np.ndarray, levels: np.ndarray, path_um: np.ndarray) -> None:
    """Add, for every pixel and position, the texture blurred for their distance: between two levels, linearly.

    Level i is made for the distance ``FARTHEST_UM·(i/(LEVELS - 1))²``, which gives the closed form of ``part``. Where
    to look is computed for a whole row before anything is looked up: the first is done in vectors, the second cannot.
    """
    rows, columns = light.shape
    wrap, plane = np.int32(levels.shape[1] - 1), np.int32(levels.shape[1] * levels.shape[2])
    scale, last = np.float32((LEVELS - 1) ** 2 / FARTHEST_UM), np.float32((LEVELS - 1) ** 2 - 1)
    flat = levels.reshape(-1)
    near, part = np.empty(columns, np.int32), np.empty(columns, np.float32)
    for y in range(rows):
        row = np.int32(y & wrap) * np.int32(levels.shape[2])
        for z_um in path_um:
            for x in range(columns):
                square = min(abs(z_um - height_um[y, x]) * scale, last)
                level = np.int32(np.sqrt(square))
                part[x] = (square - np.float32(level * level)) / np.float32(2 * level + 1)
                near[x] = level * plane + row + (np.int32(x) & wrap)
            for x in range(columns):
                nearer = np.float32(flat[near[x]])
                light[y, x] += nearer + part[x] * (np.float32(flat[near[x] + plane]) - nearer)


@njit(nogil=True, fastmath=True, cache=True)
def _develop(
    light: np.ndarray, noise: np.ndarray, offset: np.ndarray, gain: np.float32, full: float, out: np.ndarray
) -> None:
    """Turn light into digits; photon noise is normal, which it nearly is from some tens of electrons up."""
    rows, columns = light.shape
    wrap = noise.shape[0] - 1
    shot, read = np.float32(1 / FULL_WELL_E), np.float32((READ_NOISE_E / FULL_WELL_E) ** 2)
    top = np.float32(full)
    for y in range(rows):
        for x in range(columns):
            signal = gain * light[y, x]
            noisy = signal + np.sqrt(signal * shot + read) * noise[(y + offset[0]) & wrap, (x + offset[1]) & wrap]
            out[y, x] = min(max((noisy + np.float32(BLACK_LEVEL)) * top + np.float32(0.5), np.float32(0)), top)
