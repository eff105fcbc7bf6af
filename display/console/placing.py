"""Where a picture lies in its panel, and which pixel is under the mouse. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

ZOOM_STEP = 1.25
ZOOMS = (1.0, 64.0)
BAR_SHARE = 0.25
NICE = (1, 2, 5)


@dataclass(frozen=True)
class Placing:
    """How far the picture is enlarged, 1 fits the panel, and which point of it, as shares, is in the middle."""

    zoom: float = 1.0
    x: float = 0.5
    y: float = 0.5


@dataclass(frozen=True)
class Fit:
    """A picture of (width, height) pixels in a panel: screen = left + scale · pixel."""

    left: float
    top: float
    scale: float
    picture: tuple[int, int]

    def pixel_at(self, x: float, y: float) -> tuple[int, int] | None:
        """Return the pixel (column, row) under a place of the panel; None beside the picture."""
        column, row = math.floor((x - self.left) / self.scale), math.floor((y - self.top) / self.scale)
        inside = 0 <= column < self.picture[0] and 0 <= row < self.picture[1]
        return (column, row) if inside else None

    def place_of(self, column: float, row: float) -> tuple[float, float]:
        """Return where the corner of a pixel lies in the panel."""
        return self.left + self.scale * column, self.top + self.scale * row


def fit(picture: tuple[int, int], panel: tuple[float, float], placing: Placing) -> Fit:
    """Return how a picture (width, height) lies in a panel."""
    scale = placing.zoom * min(panel[0] / picture[0], panel[1] / picture[1])
    left, top = (panel[axis] / 2 - scale * picture[axis] * middle for axis, middle in ((0, placing.x), (1, placing.y)))
    return Fit(left, top, scale, picture)


def zoomed(
    placing: Placing, steps: float, at: tuple[float, float], fitting: Fit, panel: tuple[float, float]
) -> Placing:
    """Return the placing enlarged by wheel steps so that the point under the mouse stays there."""
    zoom = min(max(placing.zoom * ZOOM_STEP**steps, ZOOMS[0]), ZOOMS[1])
    if zoom == ZOOMS[0]:
        return Placing()
    scale = fitting.scale * zoom / placing.zoom
    return clipped(replace(placing, zoom=zoom, **_middle(at, fitting, scale, panel)))


def enlarged(placing: Placing, steps: float) -> Placing:
    """Return the placing enlarged by steps so that the middle stays there."""
    zoom = min(max(placing.zoom * ZOOM_STEP**steps, ZOOMS[0]), ZOOMS[1])
    return Placing() if zoom == ZOOMS[0] else replace(placing, zoom=zoom)


def _middle(at: tuple[float, float], fitting: Fit, scale: float, panel: tuple[float, float]) -> dict[str, float]:
    width, height = fitting.picture
    column, row = (at[0] - fitting.left) / fitting.scale, (at[1] - fitting.top) / fitting.scale
    return {
        "x": (column + (panel[0] / 2 - at[0]) / scale) / width,
        "y": (row + (panel[1] / 2 - at[1]) / scale) / height,
    }


def moved(placing: Placing, right: float, down: float, fitting: Fit) -> Placing:
    """Return the placing after the picture was dragged by so many places of the panel."""
    width, height = (fitting.scale * side for side in fitting.picture)
    return clipped(replace(placing, x=placing.x - right / width, y=placing.y - down / height))


def clipped(placing: Placing) -> Placing:
    """Return the placing with a point of the picture in the middle."""
    return replace(placing, x=min(max(placing.x, 0.0), 1.0), y=min(max(placing.y, 0.0), 1.0))


def inside(
    frame: tuple[int, int, int, int], corner: tuple[int, int], other: tuple[int, int], least: int = 8
) -> tuple[int, int, int, int] | None:
    """Return the part (x, y, width, height) of a camera between two pixels of the frame it delivers, both included.

    The frame itself is the part ``frame`` of the camera. Sides are even, as many cameras want them; None for a part
    less than ``least`` pixels wide or high.
    """
    spans = []
    for axis in range(2):
        first, last = sorted((corner[axis], other[axis]))
        size = min(last - first + 1, frame[2 + axis]) // 2 * 2
        spans.append((frame[axis] + max(first, 0) // 2 * 2, size))
    (x, width), (y, height) = spans
    return None if min(width, height) < least else (x, y, width, height)


@lru_cache(maxsize=8)  # asked in every frame
def scale_bar(um_per_place: float, panel_width: float) -> tuple[float, float]:
    """Return a round length in µm, a 1, 2 or 5 with zeros, that fills up to a quarter of the panel, and its width."""
    most_um = um_per_place * panel_width * BAR_SHARE
    decade = 10.0 ** math.floor(math.log10(most_um))
    length_um = max((nice * decade for nice in NICE if nice * decade <= most_um), default=decade / 2)
    return length_um, length_um / um_per_place
