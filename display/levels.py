"""A camera frame with its contrast by the processor: the picture of ``shaders/live.frag.glsl``, looked up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Levels = tuple[float, float, float, float, bool]

OVER, UNDER, BESIDE = (1.0, 0.35, 0.0), (0.0, 0.45, 1.0), (0.06, 0.06, 0.06)
HATCH = 8  # pixels from line to line


def packed(colours: Array) -> NDArray[np.uint32]:
    """Return colours (n, 3), 0 to 1, as the numbers that four bytes of a picture make."""
    rgba = np.ones((len(colours), 4))
    rgba[:, :3] = colours
    return np.rint(rgba * 255).astype(np.uint8).view(np.uint32)[:, 0]


def colours_of_levels(table: Array, levels: Levels, dtype: np.dtype[Any]) -> NDArray[np.uint32]:
    """Return the colour of every grey level a camera can give.

    Parameters
    ----------
    table : array (1, n, 3)
        Colours from the lower limit to the upper one, interpolated between.
    levels : (low, high, gamma, top, paint)
        As of `display.gl.live_picture.LivePicture.draw`.
    dtype : uint8 or uint16
        Of the camera.
    """
    low, high, gamma, _, _ = levels
    shares = np.clip((np.arange(np.iinfo(dtype).max + 1) - low) / (high - low), 0, 1) ** (1 / gamma)
    places = np.linspace(0, 1, table.shape[1])
    return packed(np.stack([np.interp(shares, places, column) for column in table[0].T], axis=1))


def seen(
    pixels: Array, size: tuple[int, int], place: tuple[float, float, float], colours: Array, levels: Levels
) -> NDArray[np.uint32]:
    """Return a panel of (width, height) in which a frame (rows, columns) lies at (left, top, scale)."""
    picture = np.full(size[::-1], packed(np.array([BESIDE]))[0])
    columns, rows = (np.floor((np.arange(n) + 0.5 - place[k]) / place[2]).astype(np.intp) for k, n in enumerate(size))
    inside = tuple(within(steps, n) for steps, n in ((rows, pixels.shape[0]), (columns, pixels.shape[1])))
    part = pixels.take(rows[inside[0]], axis=0).take(columns[inside[1]], axis=1)
    shown = colours.take(part)
    if levels[4]:
        y, x = np.ogrid[inside]
        hatch(shown, part >= levels[3] - 0.5, x + y + 1, OVER)
        hatch(shown, part == 0, x - y, UNDER)
    picture[inside] = shown
    return picture


def within(steps: Array, count: int) -> slice:
    """Return which of some rising steps lie from 0 to below a count."""
    begin, end = np.searchsorted(steps, (0, count))
    return slice(int(begin), int(end))


def hatch(shown: Array, where: Array, line: Array, colour: tuple[float, float, float]) -> None:
    """Paint slanting stripes where something is."""
    shown[where & (line % HATCH < HATCH // 2)] = packed(np.array([colour]))[0]
