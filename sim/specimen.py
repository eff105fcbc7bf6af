"""What lies under the objective: seeded, deterministic, its truth known to the last µm.

A specimen is a pile of transparent sheets. Each has a height above the stage's zero for every pixel and a texture:
brightness in 0 … 1. A rough surface is one opaque sheet; structures in depth are several, mostly dark.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

Kind = Literal["relief", "depth"]

LARGEST_TILE_PX = 1024
DARK = 0.02
VISIBLE = 0.08


@dataclass(frozen=True)
class Sheet:
    """One surface.

    Attributes
    ----------
    height_um : ndarray
        (height, width) float32: stage position at which each pixel is in focus.
    texture : ndarray
        (tile, tile) float32 in 0 … 1, tile a power of two; repeats without a seam where the frame is larger.
    """

    height_um: np.ndarray
    texture: np.ndarray


@dataclass(frozen=True)
class Specimen:
    """Sheets, seen by pixels of ``pixel_um`` at the object."""

    kind: Kind
    sheets: tuple[Sheet, ...]
    pixel_um: float

    @property
    def range_um(self) -> tuple[float, float]:
        """Return the lowest and highest point."""
        heights = [sheet.height_um for sheet in self.sheets]
        return float(min(h.min() for h in heights)), float(max(h.max() for h in heights))

    def height_um(self) -> np.ndarray:
        """Return (height, width) float32: where each pixel is in focus; NaN where there is nothing to see.

        Where sheets lie over each other it is the brightest one's.
        """
        if self.kind == "relief":
            return self.sheets[0].height_um
        shape = self.sheets[0].height_um.shape
        brightness = np.stack([tiled(sheet.texture, shape) for sheet in self.sheets])
        brightest = brightness.argmax(axis=0)
        height_um = np.take_along_axis(np.stack([s.height_um for s in self.sheets]), brightest[None], axis=0)[0]
        return np.where(brightness.max(axis=0) > VISIBLE, height_um, np.float32(np.nan))

    def save_truth(self, path: Path) -> None:
        """Write ``truth.npz``: height_um (height, width) float32, pixel_um, kind."""
        np.savez_compressed(path, height_um=self.height_um(), pixel_um=self.pixel_um, kind=self.kind)


def make_specimen(
    kind: Kind, size_px: tuple[int, int], pixel_um: float, *, seed: int, centre_um: float = 0.0, reach_um: float = 20.0
) -> Specimen:
    """Grow a specimen.

    Parameters
    ----------
    kind : "relief" or "depth"
        A rough surface, or fluorescent filaments and beads over a dark ground.
    size_px : (int, int)
        Width and height of the frame.
    pixel_um : float
        Pixel at the object.
    seed : int
        The same seed gives the same specimen.
    centre_um, reach_um : float
        It extends from ``centre_um - reach_um`` to ``centre_um + reach_um``.
    """
    rng = np.random.default_rng(seed)
    sheets = _relief(size_px, rng) if kind == "relief" else _depth(size_px, rng)
    placed = tuple(Sheet(np.float32(centre_um) + np.float32(reach_um) * s.height_um, s.texture) for s in sheets)
    return Specimen(kind, placed, pixel_um)


def tiled(texture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a texture repeated over a frame of (height, width)."""
    tile = texture.shape[0]
    return texture[np.ix_(np.arange(shape[0]) % tile, np.arange(shape[1]) % tile)]


def tile_px(size_px: tuple[int, int]) -> int:
    """Return the side of the texture tile: the power of two that covers the frame, 1024 at most."""
    return int(min(1 << (max(size_px) - 1).bit_length(), LARGEST_TILE_PX))


def _relief(size_px: tuple[int, int], rng: np.random.Generator) -> list[Sheet]:
    x, y = _grid(size_px)
    ground = _hills(size_px, rng, bumps=4) + 0.35 * (x * rng.choice([-1, 1]) + 0.6 * y)
    surface = ground + _terraces(ground, x, y) + _pits(x, y, rng) + 0.03 * _hills(size_px, rng, bumps=40)
    height = _full_range(surface)
    return [Sheet(height, np.clip(_mineral(tile_px(size_px), rng) * _shading(height), 0, 1))]


def _depth(size_px: tuple[int, int], rng: np.random.Generator) -> list[Sheet]:
    tile = tile_px(size_px)
    textures = [np.maximum(_filaments(tile, rng), _beads(tile, rng)) for _ in range(2)]
    return [Sheet(_full_range(_hills(size_px, rng, bumps=3)), texture) for texture in textures]


def _grid(size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y from -1 to 1 over the frame, float32, to be broadcast."""
    width, height = size_px
    return np.linspace(-1, 1, width, dtype=np.float32)[None], np.linspace(-1, 1, height, dtype=np.float32)[:, None]


def _hills(size_px: tuple[int, int], rng: np.random.Generator, *, bumps: int) -> np.ndarray:
    """Return a smooth random field of about ±1 with ``bumps`` hills from edge to edge."""
    coarse = rng.standard_normal((bumps + 3, bumps + 3)).astype(np.float32)
    side = 16 * (bumps + 3)
    smooth = cv2.GaussianBlur(cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC), (0, 0), 8)
    field = cv2.resize(smooth[16:-16, 16:-16], size_px, interpolation=cv2.INTER_CUBIC)
    return np.asarray((field - field.mean()) / max(float(np.abs(field).max()), 1e-6))


def _terraces(ground: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return what turns one corner of the ground into steps with soft edges."""
    steps = 6 * ground
    softened = np.floor(steps) + 0.5 + 0.5 * np.tanh(8 * (steps - np.floor(steps) - 0.5))
    corner = 1 / (1 + np.exp(-12 * (x + y - 0.5)))
    return np.asarray(corner * (softened - steps) / 6)


def _pits(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    depth = np.zeros(np.broadcast_shapes(x.shape, y.shape), np.float32)
    for _ in range(4):
        (x0, y0), radius = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.1, 0.2)
        distance = np.hypot(x - x0, y - y0) / radius
        depth -= np.float32(rng.uniform(0.3, 0.5)) / (1 + np.exp(10 * (distance - 1)))
    return depth


def _full_range(surface: np.ndarray) -> np.ndarray:
    """Return the surface, float32, stretched to reach from -1 to 1."""
    low, high = float(surface.min()), float(surface.max())
    return ((surface - low) * (2 / max(high - low, 1e-6)) - 1).astype(np.float32)


def _mineral(tile: int, rng: np.random.Generator) -> np.ndarray:
    """Return a rock's face: grains of different brightness, dark seams between them, and fine detail everywhere."""
    octaves = [_grain(tile, size, rng) for size in (1, 1, 2, 2)]
    grains, seams = _grains(tile, tile // 16, rng)
    return np.asarray(np.clip(grains - 0.25 * seams + 0.135 * np.sum(octaves, axis=0), 0.05, 1), np.float32)


def _grains(tile: int, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the brightness of grains that grew from random seeds until they met, and 1 along their seams.

    The tile repeats without a cut: its grains are those in the middle of nine equal ones.
    """
    seeds = np.full((tile, tile), 255, np.uint8)
    y, x = rng.integers(0, tile, (2, count))
    seeds[y, x] = 0
    shades = np.zeros((tile, tile), np.float32)
    shades[y, x] = rng.uniform(0.4, 0.65, count)
    _, grain = cv2.distanceTransformWithLabels(np.tile(seeds, (3, 3)), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    shade_of = np.zeros(grain.max() + 1, np.float32)
    seeded = np.tile(seeds, (3, 3)) == 0
    shade_of[grain[seeded]] = np.tile(shades, (3, 3))[seeded]
    brightness = shade_of[grain][tile : 2 * tile, tile : 2 * tile]
    seams = cv2.morphologyEx(brightness, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    return brightness, cv2.GaussianBlur(seams.astype(np.float32), (0, 0), 0.7)


def _shading(height: np.ndarray) -> np.ndarray:
    """Return the light a matt relief of ±1 sends up when lit from the upper left; 1 everywhere if no tile covers it."""
    tile = tile_px(height.shape[::-1])
    if max(height.shape) > tile:
        return np.ones((tile, tile), np.float32)
    slope_y, slope_x = np.gradient(cv2.GaussianBlur(height, (0, 0), 2.0) * 60)
    lit = (1 + 0.4 * (slope_x + slope_y)) / np.sqrt(1 + slope_x**2 + slope_y**2)
    shade = np.ones((tile, tile), np.float32)
    shade[: height.shape[0], : height.shape[1]] = np.clip(lit, 0.75, 1.25)
    return shade


def _grain(tile: int, size: int, rng: np.random.Generator) -> np.ndarray:
    cells = tile // size
    return np.asarray(
        np.kron(rng.standard_normal((cells, cells)).astype(np.float32), np.ones((size, size), np.float32))
    )


def _filaments(tile: int, rng: np.random.Generator) -> np.ndarray:
    """Return thin bright winding lines on a dark ground."""
    canvas = np.zeros((tile, tile), np.float32)
    for _ in range(12):
        start, angle = rng.uniform(0, tile, 2), rng.uniform(0, 2 * np.pi)
        angles = angle + np.cumsum(rng.normal(0, 0.12, 200))
        path = start + np.cumsum(tile / 130 * np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0)
        points = np.round(path * 16).astype(np.int32)
        cv2.polylines(canvas, [points], isClosed=False, color=1.0, thickness=3, lineType=cv2.LINE_8, shift=4)
    return np.asarray(canvas * np.clip(0.7 + 0.25 * _grain(tile, 2, rng), DARK, 1) + DARK)


def _beads(tile: int, rng: np.random.Generator) -> np.ndarray:
    """Return small bright discs on a dark ground."""
    canvas = np.full((tile, tile), DARK, np.float32)
    for _ in range(60):
        x, y, radius = *rng.integers(0, tile, 2), rng.integers(2, 5)
        cv2.circle(canvas, (int(x), int(y)), int(radius), float(rng.uniform(0.6, 1)), thickness=-1)
    return canvas
