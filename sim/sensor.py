"""Frames: the light along the path of the axis during the exposure, then photon and read noise, then digits."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from devices.values import CameraCaps
from sim.optics import FARTHEST_UM, FULL_SCALE, LEVELS, Optics, blurred, level_distances_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.specimen import Sheet, Specimen

NOISE_TILE = 1024
SQUARES_PER_UM = (LEVELS - 1) ** 2 / FARTHEST_UM  # the level squared is proportional to the distance
FARTHEST_SQUARE = np.float32((LEVELS - 1) ** 2 - 1)
STRIP_ROWS = 128  # small enough for the processor's cache, large enough for two threads not to wait for each other
THREADS = 2
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
        noise = self._rng.standard_normal((NOISE_TILE, NOISE_TILE), np.float32)
        self._noise = np.pad(noise, [(0, side) for side in shape], mode="wrap")  # a frame's begins at any pixel
        self._bit_depth = bit_depth
        self._lamp = lamp
        self._threads = ThreadPoolExecutor(THREADS, "film")

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        height, width = self._shape
        dtype = "uint8" if self._bit_depth == 8 else "uint16"
        return CameraCaps("simulated camera", height, width, 1, dtype, self._bit_depth, timed=True)

    def develop(self, exposure_ms: float, out: np.ndarray, *, unit: float = 1.0) -> None:
        """Fill ``out`` with the frame of `light`, of which ``unit`` is 1."""
        gain = (WHITE_LEVEL - BLACK_LEVEL) / unit * exposure_ms / self._nominal_ms * self._lamp()
        top, left = self._rng.integers(0, NOISE_TILE, 2)
        noise = self._noise[top : top + self._shape[0], left : left + self._shape[1]]

        def digitize(strip: slice) -> None:
            out[strip] = self._digits(np.float32(gain) * self.light[strip], noise[strip])

        self.in_strips(digitize)

    def in_strips(self, work: Callable[[slice], None]) -> None:
        """Do something with all strips of the frame, some at a time."""
        rows = self._shape[0]
        strips = [slice(top, min(top + STRIP_ROWS, rows)) for top in range(0, rows, STRIP_ROWS)]
        list(self._threads.map(work, strips))

    def _digits(self, signal: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Turn light into digits; photon noise is normal, which it nearly is from some tens of electrons up."""
        digits = signal * np.float32(1 / FULL_WELL_E)
        digits += np.float32((READ_NOISE_E / FULL_WELL_E) ** 2)
        np.sqrt(digits, out=digits)
        digits *= noise
        digits += signal
        digits += np.float32(BLACK_LEVEL)
        digits *= np.float32(self._full)
        digits += np.float32(0.5)
        return np.clip(digits, 0, self._full, out=digits)


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
        self._sheets = [_BlurredSheet(sheet, optics) for sheet in specimen.sheets]
        shape = specimen.sheets[0].height_um.shape
        self._film = Film(shape, bit_depth=bit_depth, exposure_ms=exposure_ms, seed=seed, lamp=lamp)

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
        light = self._film.light
        light.fill(0)

        def shine(strip: slice) -> None:
            for sheet in self._sheets:
                for z_um in path_um:
                    sheet.add_light(strip, z_um, light)

        self._film.in_strips(shine)
        self._film.develop(exposure_ms, out, unit=FULL_SCALE * len(path_um))


class _BlurredSheet:
    """A sheet of the specimen, its texture blurred for every level of distance.

    Each level lies beside the next, so that one look-up gets both ends of an interpolation.
    """

    def __init__(self, sheet: Sheet, optics: Optics) -> None:
        levels = blurred(sheet.texture, optics, level_distances_um())
        self._tile_px = levels[0].size
        self._pairs = np.stack([levels[:-1], levels[1:]], axis=-1).view(np.uint32).reshape(-1)
        height, width = sheet.height_um.shape
        rows, columns = levels.shape[1:]
        in_tile = np.arange(height)[:, None] % rows * columns + np.arange(width) % columns
        self._in_tile = in_tile.astype(np.int32)
        self._height = sheet.height_um * SQUARES_PER_UM

    def add_light(self, strip: slice, z_um: float, light: np.ndarray) -> None:
        """Add, for every pixel of a strip, the texture blurred for its distance: between two levels, linearly.

        Level i is made for the distance ``FARTHEST_UM·(i/(LEVELS - 1))²``, which gives the closed form of ``part``.
        """
        square = self._height[strip] - np.float32(z_um * SQUARES_PER_UM)
        np.abs(square, out=square)
        np.minimum(square, FARTHEST_SQUARE, out=square)
        level = np.sqrt(square).astype(np.int32)
        whole = level.astype(np.float32)
        square -= whole * whole
        whole *= 2
        whole += 1
        part = np.divide(square, whole, out=square)
        level *= self._tile_px
        level += self._in_tile[strip]
        ends = self._pairs.take(level).view(np.uint16)
        near, far = ends[:, ::2].astype(np.float32), ends[:, 1::2].astype(np.float32)
        far -= near
        far *= part
        far += near
        light[strip] += far
