"""What has to be said on a picture: scale bar, orientation, colour bars with units, and words. Pure functions.

All of it is one transparent picture that is laid over each eye's view, so that it stands in the screen plane in stereo.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from display.light import linear
from processing.pictures import nice_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.modes import Bar, Legend
    from display.resolve import Camera

    Light = NDArray[np.float32]

LETTERS_SHARE = 1 / 34  # height of letters in pictures
LEAST_LETTERS_PX = 9
WHITE, SHADOW = (255, 255, 255, 255), (0, 0, 0, 230)
KILO = 1000.0
WHOLE = (1e4, 1e7)  # numbers that are written in full
UNITS = ((1e6, "m"), (1e4, "cm"), (1e3, "mm"), (1.0, "µm"), (1e-3, "nm"))
AXIS_COLOURS = {"x": (255, 110, 110, 255), "y": (110, 230, 110, 255), "z": (120, 160, 255, 255)}


def over(light: Light, overlay: NDArray[np.uint8]) -> Light:
    """Lay an overlay, RGBA of sRGB levels, over linear light, (height, width, 3)."""
    written = overlay[..., 3] > 0  # a few hundredths of a picture
    ink = overlay[written]
    share = ink[:, 3:].astype(np.float32) / 255
    laid = np.array(light, np.float32)
    laid[written] = laid[written] * (1 - share) + linear(ink[:, :3]) * share
    return laid


def overlay(legend: Legend, camera: Camera, *, unit: str = "µm", depth: str = "z") -> NDArray[np.uint8]:
    """Return what is said about a picture as an overlay, (height, width, 4) uint8, RGBA.

    Parameters
    ----------
    legend : Legend
        Colour bars and words.
    camera : Camera
        For the scale bar and the directions of the axes.
    unit : str
        Of lengths.
    depth : str
        Name of the axis along the planes.
    """
    sheet = Image.new("RGBA", camera.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(sheet)
    letters = max(round(min(camera.size) * LETTERS_SHARE), LEAST_LETTERS_PX)
    _scale_bar(draw, camera, letters, unit)
    _tripod(draw, camera, letters, depth)
    for k, bar in enumerate(legend.bars):
        _colour_bar(sheet, draw, bar, k, len(legend.bars), letters)
    lines = [line for words in legend.words for line in _broken(words, camera.size[0] - letters * 1.2, letters)]
    for k, line in enumerate(lines):
        _write(draw, (letters * 0.6, letters * (0.5 + 1.25 * k)), line, letters, "la")
    return np.asarray(sheet)


def _broken(words: str, wide: float, letters: int) -> list[str]:
    """Return words in lines that are not wider than that, unless one word is."""
    lines: list[str] = []
    for word in words.split(" "):
        if lines and font(letters).getlength(f"{lines[-1]} {word}") <= wide:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def length_words(length: float, unit: str) -> str:
    """Return a length with a unit that suits it; lengths in voxels stay in voxels."""
    if unit == "m" and abs(length) >= KILO:
        return f"{number(length / KILO)} km"
    if unit != "µm":
        return f"{number(length)} {unit}"
    size, name = next(((size, name) for size, name in UNITS if length >= size * (1 - 1e-9)), UNITS[-1])
    return f"{number(length / size)} {name}"


def number(value: float) -> str:
    """Return a number as on a scale."""
    return f"{value:.0f}" if WHOLE[0] <= abs(value) < WHOLE[1] else f"{value:.4g}"


@cache
def font(letters: int) -> Any:
    """Return the font that comes with matplotlib, which knows the signs we write."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), letters)


def _write(draw: ImageDraw.ImageDraw, at: tuple[float, float], words: str, letters: int, anchor: str) -> None:
    draw.text(at, words, WHITE, font(letters), anchor=anchor, stroke_width=max(letters // 8, 1), stroke_fill=SHADOW)


def _scale_bar(draw: ImageDraw.ImageDraw, camera: Camera, letters: int, unit: str) -> None:
    width, height = camera.size
    length = nice_length(camera.pixel_um * width / 4)
    pixels = length / camera.pixel_um
    x, y = width * 0.5 - pixels / 2, height - letters * 0.9
    thick = max(letters / 5, 2)
    draw.rectangle((x - 1, y - 1, x + pixels + 1, y + thick + 1), SHADOW)
    draw.rectangle((x, y, x + pixels, y + thick), WHITE)
    _write(draw, (x + pixels / 2, y - letters * 0.25), length_words(length, unit), letters, "md")


def _tripod(draw: ImageDraw.ImageDraw, camera: Camera, letters: int, depth: str) -> None:
    """Draw where x, y and z go; the one that comes towards the viewer last."""
    reach, middle = letters * 2.2, np.array([letters * 3.4, camera.size[1] - letters * 3.6])
    right, down = camera.right / camera.pixel_um, camera.down / camera.pixel_um
    for k in sorted(range(3), key=lambda k: -camera.axis[k]):
        name = "xyz"[k]
        way = np.array([right[k], down[k]])
        tip = middle + reach * way
        draw.line([*middle, *tip], AXIS_COLOURS[name], width=max(letters // 6, 2))
        place = middle + (reach + letters * 0.75) * way if np.linalg.norm(way) > 0.2 else middle + letters * 0.7
        label = depth if name == "z" else name
        draw.text(
            tuple(place), label, AXIS_COLOURS[name], font(letters), anchor="mm", stroke_width=1, stroke_fill=SHADOW
        )


def _colour_bar(sheet: Any, draw: ImageDraw.ImageDraw, bar: Bar, place: int, count: int, letters: int) -> None:
    """Draw an upright bar at the right side, several above each other, with limits, middle and label."""
    width, height = sheet.size
    share = 0.8 / count
    top, tall = height * (0.1 + share * place), height * share - letters * 2.5
    if tall < letters * 2:
        return
    left, thick = width - letters * 1.6, letters * 0.8
    rows = np.linspace(len(bar.colours) - 1, 0, max(round(tall), 2)).round().astype(int)
    levels = (np.asarray(bar.colours)[rows] * 255).round().astype(np.uint8)
    strip = Image.fromarray(np.repeat(levels[:, None], max(round(thick), 1), axis=1))
    draw.rectangle((left - 1, top - 1, left + strip.width, top + strip.height), outline=WHITE)
    sheet.paste(strip, (round(left), round(top)))
    low, high = bar.limits
    for part in (0.0, 0.5, 1.0):
        y = top + (1 - part) * (strip.height - 1)
        _write(draw, (left - letters * 0.4, y), number(low + part * (high - low)), round(letters * 0.8), "rm")
    _write(draw, (width - letters * 0.6, top + strip.height + letters * 0.5), bar.label, round(letters * 0.8), "ra")
