"""A range image as a surface in space: its facets, normals and lines. Plain values and pure functions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from display.scene import Light

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.heights import Heights

    Array = NDArray[Any]

Shading = Literal["flat", "gouraud", "phong"]
Paint = Literal["plain", "heights", "cycles", "image"]
MOST_SIDE = 640  # points along a side; more cannot be told apart in a picture
GRID_LINES = 48


class Facets(NamedTuple):
    """Points of a grid and how they hang together.

    Attributes
    ----------
    position, normal : array (n, 3) float32
        In (x, y, z); the normal is of length 1 and looks to the viewer of the planes, -z.
    tone : array (n, 4) float32
        Where a draped image lies, (u, v), the height as a share of the whole, and 0.
    triangles, lines : array uint32
        Corners of facets, and ends of the lines of a grid, without those at unknown heights.
    """

    position: Array
    normal: Array
    tone: Array
    triangles: Array
    lines: Array


@dataclass(frozen=True, eq=False)
class Relief:
    """A range image as it is drawn.

    Attributes
    ----------
    heights : Heights
        What was measured.
    exaggeration : float
        By how much heights are stretched.
    image : array (y, x, 3) uint8, optional
        What is draped over it, of any size.
    """

    heights: Heights
    exaggeration: float = 1.0
    image: Array | None = None
    facets: Facets = field(init=False)
    depth: str = "z"

    def __post_init__(self) -> None:
        object.__setattr__(self, "facets", facets(self.heights, self.exaggeration))

    @property
    def unit(self) -> str:
        """Of lengths."""
        return self.heights.unit

    @property
    def size_um(self) -> Array:
        """Size along (x, y, z)."""
        (down, across), (low, high) = self.heights.pixel, self.heights.limits
        rows, columns = self.heights.values.shape
        return np.array([(columns - 1) * across, (rows - 1) * down, (high - low) * self.exaggeration])

    @property
    def stride(self) -> int:
        """Every how many pixels a point is drawn."""
        return stride_of(self.heights.values.shape)


@dataclass(frozen=True)
class ReliefLook:
    """How a relief is drawn.

    Attributes
    ----------
    shading : {"phong", "gouraud", "flat"}
        Light worked out for each pixel, for each point, or for each facet.
    paint : {"plain", "heights", "cycles", "image"}
        One grey; a colour table from the lowest to the highest; the table over and over; the draped image.
    colours : str
        Name of the table.
    cycles : float
        How often the table is run through.
    contours : float
        Distance of lines of equal height drawn on the surface, 0 for none.
    light : Light
    """

    shading: Shading = "phong"
    paint: Paint = "plain"
    colours: str = "viridis"
    cycles: float = 8.0
    contours: float = 0.0
    light: Light = field(default_factory=Light)


def stride_of(shape: tuple[int, ...]) -> int:
    """Return every how many pixels of an image a point is drawn."""
    return max(-(-(max(shape) - 1) // (MOST_SIDE - 1)), 1)


def facets(heights: Heights, exaggeration: float = 1.0) -> Facets:
    """Return the surface of a range image around the origin: x to the right, y down, heights towards -z, the viewer."""
    rows, columns = heights.values.shape
    stride = stride_of(heights.values.shape)
    i, j = (np.unique(np.append(np.arange(0, n, stride), n - 1)) for n in (rows, columns))
    (down, across), (low, high) = heights.pixel, heights.limits
    height = heights.values[np.ix_(i, j)].astype(np.float64)
    x, y = np.meshgrid((j - (columns - 1) / 2) * across, (i - (rows - 1) / 2) * down)
    z = -(height - (low + high) / 2) * exaggeration
    u, v = np.meshgrid((j + 0.5) / columns, (i + 0.5) / rows)
    tone = [u, v, (height - low) / (high - low), np.zeros_like(u)]
    normal = normals(heights.values, heights.pixel, exaggeration)[np.ix_(i, j)]
    known = np.isfinite(height)
    return Facets(
        _flat(np.nan_to_num(np.stack([x, y, z], axis=-1))),
        _flat(normal),
        _flat(np.nan_to_num(np.stack(tone, axis=-1))),
        _triangles(known),
        _lines(known),
    )


def normals(values: Array, pixel: tuple[float, float], exaggeration: float = 1.0) -> NDArray[np.float32]:
    """Return the unit normals, (y, x, 3), by central differences; beside unknown heights they look at the viewer."""
    along_y, along_x = np.gradient(values.astype(np.float64) * exaggeration, *pixel)
    slopes = np.nan_to_num(np.stack([-along_x, -along_y, np.full(values.shape, -1.0)], axis=-1))
    return np.asarray(slopes / np.linalg.norm(slopes, axis=-1, keepdims=True), np.float32)


def _flat(points: Array) -> Array:
    return np.ascontiguousarray(points.reshape(-1, points.shape[-1]), np.float32)


def _triangles(known: Array) -> Array:
    """Return two facets for each square of a grid; those with an unknown corner are left out."""
    numbers = np.arange(known.size, dtype=np.uint32).reshape(known.shape)
    a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
    both = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=2).reshape(-1, 3)
    return np.ascontiguousarray(both[known.reshape(-1)[both].all(axis=1)])


def _lines(known: Array) -> Array:
    """Return the pieces of about 48 lines each way."""
    numbers = np.arange(known.size, dtype=np.uint32).reshape(known.shape)
    every = max(round(max(known.shape) / GRID_LINES), 1)
    rows, columns = (np.unique(np.append(np.arange(0, n, every), n - 1)) for n in known.shape)
    across = np.stack([numbers[rows, :-1], numbers[rows, 1:]], axis=-1).reshape(-1, 2)
    down = np.stack([numbers[:-1][:, columns], numbers[1:][:, columns]], axis=-1).reshape(-1, 2)
    both = np.concatenate([across, down])
    return np.ascontiguousarray(both[known.reshape(-1)[both].all(axis=1)])
