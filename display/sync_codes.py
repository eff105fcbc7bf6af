"""Marks in a corner or on the last rows of a picture by which shutter glasses know whose it is. Pure functions.

White and blue line: StereoGraphics' blue-line code, which the projector's or monitor's emitter reads from the last row;
drawn three rows high, for some drivers hide the last one. DLP 3-D Ready: a row across the whole picture, green for a
first pair and magenta for the next one. Trigger boxes: two squares before two photodiodes, the lit one is the eye's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    from devices.glasses_timing import Eye

    Colour = tuple[float, float, float]
    Size = tuple[int, int]

Code = Literal["none", "white-line", "blue-line", "dlp-ready", "trigger-boxes"]
CODES: tuple[str, ...] = get_args(Code)

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)
BLUE: Colour = (0.0, 0.0, 1.0)
GREEN: Colour = (0.0, 1.0, 0.0)
MAGENTA: Colour = (1.0, 0.0, 1.0)
LINE_ROWS = 3
LIT_SHARE: dict[Eye, float] = {"left": 0.25, "right": 0.75}
BOX_SHARE = 1 / 16  # of the picture's height
PAIRS_PER_CYCLE = 2


@dataclass(frozen=True)
class Mark:
    """A rectangle of one colour; ``x``, ``y`` is its upper left pixel, row 0 the top of the picture."""

    x: int
    y: int
    width: int
    height: int
    colour: Colour


def marks(code: Code, eye: Eye, number: int, size: Size) -> tuple[Mark, ...]:
    """Return what has to be drawn over one eye's picture.

    Parameters
    ----------
    code : str
        One of `CODES`.
    eye : {"left", "right"}
        Whose picture it is.
    number : int
        Of the refresh.
    size : (int, int)
        Width and height of the picture in pixels.
    """
    if code == "none" or min(size) < LINE_ROWS:
        return ()
    if code == "dlp-ready":
        width, height = size
        return (Mark(0, height - 1, width, 1, _of_pair(eye, number)),)
    if code == "trigger-boxes":
        return _boxes(eye, size)
    return _line(WHITE if code == "white-line" else BLUE, LIT_SHARE[eye], size)


def _line(colour: Colour, share: float, size: Size) -> tuple[Mark, ...]:
    width, height = size
    lit, top = round(share * width), height - LINE_ROWS
    return (Mark(0, top, lit, LINE_ROWS, colour), Mark(lit, top, width - lit, LINE_ROWS, BLACK))


def _of_pair(eye: Eye, number: int) -> Colour:
    """Return the colour of the pair a picture belongs to; a pair begins with the left eye."""
    begins = number - (eye == "right")
    return GREEN if begins // 2 % PAIRS_PER_CYCLE == 0 else MAGENTA


def _boxes(eye: Eye, size: Size) -> tuple[Mark, ...]:
    width, height = size
    side = max(round(BOX_SHARE * height), 1)
    x, y = width - 5 * side, height - 3 * side
    lit = x + side if eye == "left" else x + 3 * side
    return (Mark(x, y, 5 * side, 3 * side, BLACK), Mark(lit, y + side, side, side, WHITE))
