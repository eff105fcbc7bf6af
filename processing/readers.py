"""What every reader of a file format hands on, and how axes, units and picture types are understood alike in all."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

UM_PER_UNIT = {
    "pm": 1e-6, "picometer": 1e-6, "picometre": 1e-6,
    "å": 1e-4, "angstrom": 1e-4,
    "nm": 1e-3, "nanometer": 1e-3, "nanometre": 1e-3,
    "um": 1.0, "micron": 1.0, "microns": 1.0, "micrometer": 1.0, "micrometre": 1.0,
    "mm": 1e3, "millimeter": 1e3, "millimetre": 1e3,
    "cm": 1e4, "centimeter": 1e4, "centimetre": 1e4,
    "inch": 25400.0, "in": 25400.0,
    "m": 1e6, "meter": 1e6, "metre": 1e6,
}  # fmt: skip
# What libraries that read files were seen to raise on bytes that make no sense; SyntaxError is broken XML.
BROKEN = (
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, RuntimeError, SyntaxError),
    *(TypeError, ValueError, OSError, cv2.error, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
MICRO_SIGNS = {ord("µ"): "u", ord("μ"): "u"}


@dataclass(frozen=True)
class Choice:
    """Which part of a file with many channels and times is the stack; without a choice of time it is the first."""

    channel: int | None = None
    time: int | None = None


@dataclass(frozen=True)
class Recording:
    """What a file says about itself; nothing is judged yet.

    Attributes
    ----------
    count : int
        Number of planes.
    read : callable
        ``read(k)`` returns plane k, (height, width) or (height, width, bands), of any number type.
    z_um : array (planes,), optional
        Position of every plane where each is known.
    step_um, start_um : float, optional
        Signed distance of planes, where only that is known, and position of the first.
    places : array (planes,), optional
        Where the planes lie, in steps from the first one, if some between them are missing.
    pixel_um : float, optional
        Size of a pixel in the specimen.
    notes : tuple of str
        What was assumed, in words for the user.
    label : callable
        ``label(k)`` names plane k in messages.
    """

    count: int
    read: Callable[[int], Array]
    z_um: NDArray[np.float64] | None = None
    step_um: float | None = None
    start_um: float = 0.0
    places: NDArray[np.float64] | None = None
    pixel_um: float | None = None
    notes: tuple[str, ...] = ()
    label: Callable[[int], str] = "plane {}".format


@dataclass(frozen=True)
class Layout:
    """Where the planes lie in an array of many axes.

    Attributes
    ----------
    axes : str
        A letter for each axis, lower case.
    depth : str
        The axis the planes run along; empty for a single plane.
    fixed : dict
        Index taken on every other axis but y, x and s (samples of one pixel).
    count : int
        Number of planes.
    notes : tuple of str
        What was assumed.
    """

    axes: str
    depth: str
    fixed: dict[str, int]
    count: int
    notes: tuple[str, ...]

    def index(self, k: int) -> tuple[int | slice, ...]:
        """Return the index of plane ``k`` in the whole array."""
        at = {**self.fixed, self.depth: k}
        return tuple(slice(None) if a in "yxs" else at[a] for a in self.axes)

    def upright(self, plane: Array) -> Array:
        """Turn what `index` picks into (y, x) or (y, x, bands)."""
        left = [a for a in self.axes if a in "yxs"]
        return np.transpose(plane, [left.index(a) for a in "yxs" if a in left])


def lay_out(axes: str, shape: Sequence[int], choice: Choice, source: Path, channels: Sequence[str] = ()) -> Layout:
    """Find the planes of one channel and time in an array.

    Parameters
    ----------
    axes : str
        A letter for each axis: t, c, z, y, x, s (samples of one pixel); any other letter is a count of images.
    shape : sequence of int
        Length of each axis.
    choice : Choice
        What the user asked for.
    source : Path
        Named in messages.
    channels : sequence of str, optional
        Names of the channels, for the message that asks for a choice.

    Raises
    ------
    InputError
        No x and y, a channel or time that is not there or must be chosen, or more than one axis of planes.
    """
    axes = axes.lower()
    size = dict(zip(axes, shape, strict=True))
    if not {"y", "x"} <= set(axes):
        raise InputError(f"{source} holds no images: its axes are {axes}.", fix="give a stack with axes z, y and x.")
    depth = _depth_axis(size, source)
    fixed = {a: 0 for a in axes if a not in "yxs" and a != depth}
    channel = choose_channel(size.get("c", 1), choice, source, channels)
    if "c" in fixed:
        fixed["c"] = channel
    notes = []
    time = choose_time(1 if depth == "t" else size.get("t", 1), choice, source)
    if depth == "t":
        notes.append("the planes run along time; they are taken as focal planes.")
    elif size.get("t", 1) > 1:
        fixed["t"] = time
        notes.append(f"time point {fixed['t']} of 0 … {size['t'] - 1}; another one: --time N.")
    return Layout(axes, depth, fixed, size.get(depth, 1), tuple(notes))


def _depth_axis(size: dict[str, int], source: Path) -> str:
    if size.get("z", 1) > 1:
        return "z"
    others = [a for a, n in size.items() if a not in "tczyxs" and n > 1]
    if len(others) > 1:
        raise InputError(
            f"{source}: planes could run along {' or '.join(f'{a} ({size[a]})' for a in others)}.",
            fix="save it as one stack with axes z, y and x.",
            code="stack-axes",
        )
    if others:
        return others[0]
    return "t" if size.get("t", 1) > 1 else ("z" if "z" in size else "")


def choose_channel(count: int, choice: Choice, source: Path, names: Sequence[str] = ()) -> int:
    """Return the channel to take.

    Raises
    ------
    InputError
        There are several and none was chosen, or the chosen one is not there.
    """
    listed = ", ".join(f"{k} {name}" for k, name in enumerate(names)) if any(names) else f"0 … {count - 1}"
    if choice.channel is None and count > 1:
        raise InputError(
            f"{source} holds {count} channels: {listed}.",
            why="Focus is measured in one channel.",
            fix="choose one: --channel N",
            code="stack-channel",
        )
    channel = choice.channel or 0
    if not 0 <= channel < count:
        raise InputError(
            f"{source} has no channel {channel}; it has {listed if count > 1 else 'one, number 0'}.",
            fix="choose one of these: --channel N" if count > 1 else "leave out --channel",
            code="stack-channel",
        )
    return channel


def choose_time(count: int, choice: Choice, source: Path) -> int:
    """Return the time point to take, or raise `InputError` if there is no such one."""
    time = choice.time or 0
    if not 0 <= time < count:
        raise InputError(
            f"{source} has no time point {time}; it has {f'0 … {count - 1}' if count > 1 else 'one, number 0'}.",
            fix="choose one of these: --time N" if count > 1 else "leave out --time",
            code="stack-time",
        )
    return time


def to_um(value: float, unit: str) -> float | None:
    """Convert a length to µm; None when the unit is no known length."""
    word = unit.strip().replace("\\u00B5", "u").translate(MICRO_SIGNS).lower()
    return value * UM_PER_UNIT[word] if word in UM_PER_UNIT else None


@contextmanager
def reading(what: object) -> Iterator[None]:
    """Turn whatever a library makes of broken bytes into one clear `InputError` about ``what``."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(
            f"there is no {error.filename or what}.", fix="check the name.", code="input-missing"
        ) from None
    except PermissionError as error:
        raise InputError(f"{what} may not be read.", why=str(error), fix="ask for the right to read it.") from None
    except BROKEN as error:
        raise damaged(what, f"{type(error).__name__}: {error}") from None


def damaged(source: object, why: str) -> InputError:
    """Return the error for a file that is cut short or broken."""
    return InputError(
        f"{source} is damaged or incomplete.",
        why=why,
        fix="copy it again from where it came from, or leave it out of the stack.",
        code="input-damaged",
    )


def as_picture(pixels: Array) -> Array:
    """Return grey as (y, x) and colour as (y, x, 3), without an alpha band."""
    if pixels.ndim == 3 and pixels.shape[2] in {1, 2}:
        return pixels[:, :, 0]
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        return pixels[:, :, :3]
    return pixels
