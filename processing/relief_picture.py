"""Pictures of range images: maps with a colour bar, and the relief in slanting light with its exaggeration stated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.words import spanned
from processing.pictures import RANGE_COLOURS, MapWords, captioned, draw_map, shown_limits

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

LIGHT = np.array([-1.0, -1.0, 1.2]) / np.sqrt(3.44)  # towards it: from the upper left
SMALLEST_SIDE_PX = 480
USUAL_SLOPE = 0.5  # that the steeper tenth of the surface is shown with
EXAGGERATIONS = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100])


def range_picture(values: Array, name: str, pixel_um: float | None) -> NDArray[np.uint8]:
    """Draw a map, (height, width); what is NaN stays white."""
    limits = shown_limits(values)
    return draw_map(values, limits, MapWords(f"{name} {spanned(*limits)}", name), RANGE_COLOURS, pixel_um)


def relief_picture(range_: Array, pixel_um: float | None) -> NDArray[np.uint8]:
    """Show a range image as a surface lit from the upper left, larger values higher, its exaggeration stated below.

    Parameters
    ----------
    range_ : array (height, width) float32
        NaN is shown black.
    pixel_um : float, optional
        Size of a pixel; the exaggeration is told in pixels for each unit of the range without it.
    """
    scale = 1.0 / (pixel_um or 1.0)
    factor = exaggeration(range_ * scale)
    shade = shaded(range_ * np.float32(scale * factor))
    times = -(-SMALLEST_SIDE_PX // shade.shape[1])  # or the words could not be read
    shade = shade.repeat(times, 0).repeat(times, 1)
    unit = "" if pixel_um else " pixels for each unit of the range"
    words = f"vertical exaggeration {factor:g}{unit}; light from the upper left"
    return captioned(shade, words)


def exaggeration(height_px: Array) -> float:
    """Return the round factor that gives the relief slopes easy to see."""
    slopes = np.abs(np.diff(height_px, axis=1))
    known = slopes[np.isfinite(slopes)]
    steep = float(np.percentile(known, 90)) if known.size else 0.0
    wanted = USUAL_SLOPE / steep if steep > 0 else 1.0
    return float(EXAGGERATIONS[np.argmin(np.abs(np.log(EXAGGERATIONS / wanted)))])


def shaded(height_px: Array) -> NDArray[np.uint8]:
    """Diffuse light on a surface, 8-bit grey: the cosine between its normal and the light."""
    if min(height_px.shape) < 2:
        return np.full(height_px.shape, 128, np.uint8)
    down, across = np.gradient(height_px.astype(np.float64))
    cosine = (-across * LIGHT[0] - down * LIGHT[1] + LIGHT[2]) / np.sqrt(across**2 + down**2 + 1)
    return np.where(np.isfinite(cosine), np.rint(255 * np.clip(cosine, 0, 1)), 0).astype(np.uint8)
