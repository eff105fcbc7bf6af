"""Pictures by which a person sees whether shutter glasses are right: whose eye, how much leaks, where."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

import cv2
import numpy as np

from display.light import encoded

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from devices.glasses_timing import Eye

    Picture = NDArray[np.uint8]
    Size = tuple[int, int]

Pattern = Literal["eyes", "crosstalk", "depth"]
PATTERNS: tuple[str, ...] = get_args(Pattern)
LEAKS = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # of white light: the ladder a ghost is compared with
DIM = 0.03
TINTS: dict[Eye, tuple[int, int, int]] = {"left": (150, 60, 40), "right": (40, 90, 150)}
DOTS, DISC_SHARE = 0.5, 0.6
LETTERS = cv2.FONT_HERSHEY_SIMPLEX


def pattern(kind: Pattern, size: Size) -> tuple[Picture, Picture]:
    """Return a picture for each eye, (height, width, 3) uint8.

    ``eyes`` says LEFT to the left eye and RIGHT to the right one. ``crosstalk`` shows each eye patches that are white
    for the other alone, beside steps of known light: the step that looks like the ghost is the crosstalk; patches stand
    at the top, in the middle and at the bottom, for a wrong phase leaks at one end. ``depth`` is noise in which only
    two eyes together see a disc before the screen.
    """
    if kind == "eyes":
        return _named("left", size), _named("right", size)
    if kind == "depth":
        return _depth(size)
    return _ghosts("left", size), _ghosts("right", size)


def _named(eye: Eye, size: Size) -> Picture:
    width, height = size
    picture: Picture = np.full((height, width, 3), TINTS[eye], np.uint8)
    _write(picture, eye.upper(), (width / 2, height / 2), height / 6)
    x = round(width * (0.15 if eye == "left" else 0.85))
    cv2.circle(picture, (x, height // 2), max(height // 10, 1), (255, 255, 255), -1)
    return picture


def _ghosts(eye: Eye, size: Size) -> Picture:
    """Draw three rows: what is white for one eye alone, the ladder between, what is white for the other eye alone."""
    width, height = size
    picture: Picture = np.zeros((height, width, 3), np.uint8)
    columns = np.linspace(0, width, len(LEAKS) + 3).astype(int)
    for share in (0.12, 0.5, 0.88):
        rows = slice(int((share - 0.09) * height), int((share + 0.09) * height))
        mine, others = (0, -2) if eye == "left" else (-2, 0)
        picture[rows, columns[mine] : columns[mine + 1]] = 255
        picture[rows, columns[others] : columns[others + 1]] = 0
        for k, leak in enumerate(LEAKS, start=1):
            picture[rows, columns[k] : columns[k + 1]] = encoded(np.array(leak))
            middle = (columns[k] + columns[k + 1]) / 2
            _write(picture, f"{leak:.1%}", (middle, share * height), height / 40, grey=110 if leak < DIM else 200)
    _write(
        picture,
        f"{eye} eye: which step is as bright as the ghost of the white patch?",
        (width / 2, height * 0.31),
        height / 40,
        grey=110,
    )
    return picture


def _depth(size: Size) -> tuple[Picture, Picture]:
    width, height = size
    cell = max(height // 180, 1)
    rows, columns = -(-height // cell), -(-width // cell)
    dots = np.random.default_rng(1960).random((rows, columns)) < DOTS
    y, x = np.ogrid[:rows, :columns]
    disc = (y - rows / 2) ** 2 + (x - columns / 2) ** 2 < (DISC_SHARE * rows / 2) ** 2
    shift = 2
    views = [np.where(disc, np.roll(dots, side * shift, axis=1), dots) for side in (1, -1)]
    large = [np.kron(view, np.ones((cell, cell), bool))[:height, :width] for view in views]
    left, right = (np.repeat((255 * view[..., None]).astype(np.uint8), 3, axis=2) for view in large)
    return left, right


def _write(picture: Picture, words: str, middle: tuple[float, float], high_px: float, *, grey: int = 255) -> None:
    scale = max(high_px / 22, 0.2)
    (wide, high), _ = cv2.getTextSize(words, LETTERS, scale, 1)
    if wide > 0.98 * picture.shape[1]:
        scale *= 0.98 * picture.shape[1] / wide
        (wide, high), _ = cv2.getTextSize(words, LETTERS, scale, 1)
    place = (round(middle[0] - wide / 2), round(middle[1] + high / 2))
    cv2.putText(picture, words, place, LETTERS, scale, (grey,) * 3, max(round(scale), 1), cv2.LINE_AA)
