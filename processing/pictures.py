"""Pictures for the eye: previews, maps with a colour bar, captions. What is measured on is written elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from acquire.words import spanned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Picture = NDArray[np.uint8]

DOTS_PER_INCH = 100
MAP_SIDE_PX = 900  # longer side of a map; the numbers are in the TIFF beside it
LEAST_WIDTH_INCH = 3.5
LEFT_INCH, BELOW_INCH = 0.8, 0.6  # for the scales
RIGHT_INCH, ABOVE_INCH = 1.4, 0.45  # for the colour bar and the title
BAR_INCH, BESIDE_INCH = 0.18, 0.15
STRETCH_PERCENT = (0.1, 99.9)
LIMITS_PERCENT = (0.5, 99.5)
CAPTION_PX = 22
PALEST = 0.2
RANGE_COLOURS, CONFIDENCE_COLOURS = "viridis", "magma"  # both rise evenly in lightness


@dataclass(frozen=True)
class MapWords:
    """What is written on a map."""

    title: str
    bar: str


def preview(image: Array) -> Picture:
    """Return an 8-bit picture of the same size; 16 bit is stretched between its 0.1 and 99.9 percentiles."""
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    low, high = np.percentile(image, STRETCH_PERCENT)
    spread = (high - low) or 1.0 if image.dtype.kind == "f" else max(high - low, 1.0)
    stretched = (image.astype(np.float32) - low) * (255.0 / spread)
    return np.asarray(np.rint(np.clip(stretched, 0, 255)), np.uint8)


def shown_limits(values: Array, trusted: NDArray[np.bool_] | None = None) -> tuple[float, float]:
    """Return the values between which colours are spread, from the pixels that can be trusted where there are any."""
    known = np.isfinite(values)
    chosen = values[trusted & known] if trusted is not None and (trusted & known).any() else values[known]
    if not chosen.size:
        return -0.5, 0.5
    low, high = (float(v) for v in np.percentile(chosen, LIMITS_PERCENT))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def range_map(values: Array, confidence: Array, confident: float, unit: str, pixel_um: float | None) -> Picture:
    """Draw a range image with a colour bar; the less sure a pixel, the paler.

    Parameters
    ----------
    values, confidence : array (height, width) float32
        Range in ``unit`` and how sure it is.
    confident : float
        Confidence from which a pixel has a say in the limits of the colours.
    unit : {"um", "plane"}
        Unit of the range.
    pixel_um : float, optional
        Size of a pixel; the axes are in pixels without it.

    Returns
    -------
    array (h, w, 3) uint8
        RGB.
    """
    low, high = shown_limits(values, confidence >= confident)
    word = "µm" if unit == "um" else "planes counted from 0"
    share = float(np.mean(confidence >= confident))
    title = f"Range {spanned(low, high)} {'µm' if unit == 'um' else 'planes'}; sure in {share:.0%}, pale elsewhere"
    opaque = np.clip(confidence / confident, PALEST, 1.0)
    return draw_map(values, (low, high), MapWords(title, f"range, {word}"), RANGE_COLOURS, pixel_um, opaque)


def confidence_map(confidence: Array, confident: float, pixel_um: float | None) -> Picture:
    """Draw how sure a range image is; colours as in `range_map`."""
    high = max(float(np.percentile(confidence, LIMITS_PERCENT[1])), confident)
    words = MapWords(
        f"Confidence of the range; sure from {confident:g}", "confidence: height of the peak over the mean"
    )
    return draw_map(confidence, (0.0, high), words, CONFIDENCE_COLOURS, pixel_um)


def width_map(values: Array, confidence: Array, confident: float, unit: str, pixel_um: float | None) -> Picture:
    """Draw the width of the focus curve, 0 where it has none; arguments as in `range_map`."""
    _, high = shown_limits(values, (confidence >= confident) & (values > 0))
    word = "µm" if unit == "um" else "planes"
    words = MapWords("Width of the focus curve at half its height; 0 where it has none", f"width, {word}")
    return draw_map(values, (0.0, high), words, CONFIDENCE_COLOURS, pixel_um)


def draw_map(
    values: Array,
    limits: tuple[float, float],
    words: MapWords,
    colours: str,
    pixel_um: float | None,
    opaque: Array | float = 1.0,
) -> Picture:
    """Draw values as colours, with scales along the sides and a colour bar; returns RGB, (h, w, 3) uint8."""
    height, width = values.shape
    inches = MAP_SIDE_PX / DOTS_PER_INCH / max(height, width)
    across, down = max(width * inches, LEAST_WIDTH_INCH), height * inches
    size = (LEFT_INCH + across + RIGHT_INCH, BELOW_INCH + down + ABOVE_INCH)
    figure = _figure(size)
    axes = _axes(figure, size, (LEFT_INCH, BELOW_INCH, across, down))
    bar = _axes(figure, size, (LEFT_INCH + across + BESIDE_INCH, BELOW_INCH, BAR_INCH, down))
    pixel = pixel_um or 1.0
    extent = (0.0, width * pixel, height * pixel, 0.0)
    image = axes.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, alpha=opaque)
    _label(axes, "µm" if pixel_um else "pixels")
    figure.suptitle(words.title, fontsize=11, y=1 - 0.13 / size[1], va="top")
    figure.colorbar(image, bar, label=words.bar, extend="both")
    return _drawn(figure)


def _figure(size_inch: tuple[float, float], **options: Any) -> Figure:
    from matplotlib.figure import Figure  # noqa: PLC0415  a second that measuring does without

    return Figure(figsize=size_inch, dpi=DOTS_PER_INCH, **options)


def _axes(figure: Figure, size_inch: tuple[float, float], place_inch: tuple[float, float, float, float]) -> Axes:
    """Add axes at (left, bottom, width, height): to find the place by itself takes the library half the drawing."""
    across, down = size_inch
    left, bottom, width, height = place_inch
    return figure.add_axes((left / across, bottom / down, width / across, height / down))


def _label(axes: Axes, unit: str) -> None:
    axes.set_xlabel(f"x, {unit}")
    axes.set_ylabel(f"y, {unit}")


def _drawn(figure: Figure) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  as above

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def captioned(image: Picture, words: str) -> Picture:
    """Return the picture, (h, w[, 3]) uint8, as RGB with a line of white words on black below it."""
    colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    width = max(image.shape[1] / DOTS_PER_INCH, 0.5)
    figure = _figure((width, CAPTION_PX / DOTS_PER_INCH), facecolor="black")
    letters = min(8.0, 0.98 * image.shape[1] / max(len(words), 1) * 72 / DOTS_PER_INCH / 0.55)
    figure.text(0.005, 0.25, words, color="white", fontsize=letters)
    strip = cv2.resize(_drawn(figure), (image.shape[1], CAPTION_PX), interpolation=cv2.INTER_AREA)
    return np.vstack([colour, strip])


def nice_length(longest: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20 … that is not longer."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(n * power for n in (1, 2, 5) if n * power <= longest * (1 + 1e-9)))


def png_bytes(image: Array) -> bytes:
    """Encode grey (h, w) or RGB (h, w, 3), uint8 or uint16, as PNG."""
    encoded: Array = cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1]
    return encoded.tobytes()
