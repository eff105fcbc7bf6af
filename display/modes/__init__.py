"""The kinds of picture. One module and its shader files for each family; a mode is registered in one line.

A mode draws with a canvas (`display.gl.canvas`) and never with OpenGL itself.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from devices.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable

    from display.gl.canvas import Canvas
    from display.resolve import Drawing

MODES: dict[str, Mode] = {}


@dataclass(frozen=True)
class Bar:
    """A colour bar: sRGB colours (n, 3), 0 to 1, from the lower to the upper limit, and what they mean."""

    colours: Any
    limits: tuple[float, float]
    label: str


@dataclass(frozen=True)
class Legend:
    """What has to be said on a picture: colour bars, and words on how it was made."""

    bars: tuple[Bar, ...] = ()
    words: tuple[str, ...] = ()


class Mode(Protocol):
    """One kind of picture."""

    data: type
    "What it draws."
    look: type
    "Its options, made without arguments when a layer has none."

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw into the bound target: linear light, premultiplied by alpha, over what is there."""
        ...

    def legend(self, drawing: Drawing) -> Legend:
        """Return what has to be said on the picture."""
        ...


def mode(name: str) -> Callable[[type], type]:
    """Register a class of modes under a name; the first line of its docstring says what it shows."""

    def register(kind: type) -> type:
        MODES[name] = kind()
        return kind

    return register


def all_modes() -> dict[str, Mode]:
    """Return every mode by name; imports their modules."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return dict(sorted(MODES.items()))


def find_mode(name: str) -> Mode:
    """Return the mode of that name; raises `InputError` (``mode-unknown``) when there is none."""
    if name not in MODES and name not in all_modes():
        raise InputError(
            f"no mode is called {name!r}{did_you_mean(name, sorted(MODES))}.",
            fix="list them: stereotome render --list",
            code="mode-unknown",
        )
    return MODES[name]


def summary(found: Mode) -> str:
    """Return the line that says what a mode shows."""
    return (type(found).__doc__ or "").splitlines()[0]
