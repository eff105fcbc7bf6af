"""The keyboard: one list that is both what keys do and what F1 shows. No unmodified letter moves hardware."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from display.console.placing import Placing

if TYPE_CHECKING:
    from collections.abc import Callable

    from display.console.model import Console

VIEW_WORDS = (
    "live",
    "extended focus",
    "range in colours",
    "relief",
    "planes that cross",
    "the brightest of the volume",
)

PANELS = ("Stage", "Camera", "Stack", "Sections", "Session", "Glasses", "Files", "Review", "Log", "Monitor")


@dataclass(frozen=True)
class Binding:
    """A key and what it does.

    Attributes
    ----------
    key : str
        Its name in Dear ImGui's ``Key``.
    shown : str
        As people write it.
    words : str
        What it does.
    do : callable
        Does it.
    ctrl : bool
        Together with Ctrl.
    repeats : bool
        Again and again while held.
    """

    key: str
    shown: str
    words: str
    do: Callable[[Console], None]
    ctrl: bool = False
    repeats: bool = False


def _far(steps: int) -> Callable[[Console], None]:
    return lambda console: console.jog(steps, faster=True)


def _placing(console: Console) -> None:
    console.placing = Placing()


def _depth(key: str) -> Callable[[Console], None]:
    return lambda console: console.viewing.press(key)


def _crosshair(console: Console) -> None:
    console.settings.crosshair = not console.settings.crosshair


def _view(number: int) -> Callable[[Console], None]:
    return lambda console: console.view(number)


def _panel(name: str) -> Callable[[Console], None]:
    def front(console: Console) -> None:
        console.front = name

    return front


def _full_screen(console: Console) -> None:
    console.full_screen = not console.full_screen


def _keys(console: Console) -> None:
    console.shows_keys = not console.shows_keys


BINDINGS = (
    Binding("escape", "Esc", "STOP: all motion now, latched", lambda console: console.stop()),
    Binding("page_up", "PgUp", "stage up by the step", lambda console: console.jog(1), repeats=True),
    Binding("page_down", "PgDn", "stage down by the step", lambda console: console.jog(-1), repeats=True),
    Binding("page_up", "Ctrl+PgUp", "stage up by ten steps", _far(1), ctrl=True, repeats=True),
    Binding("page_down", "Ctrl+PgDn", "stage down by ten steps", _far(-1), ctrl=True, repeats=True),
    Binding("left_bracket", "[", "a smaller step", lambda console: console.jogger.choose(-1)),
    Binding("right_bracket", "]", "a larger step", lambda console: console.jogger.choose(1)),
    Binding("space", "Space", "live view on and off", lambda console: console.camera.live()),
    Binding("s", "S", "save a snapshot", lambda console: console.camera.snap()),
    Binding("a", "A", "fit the contrast once", lambda console: console.auto_contrast()),
    Binding("t", "T", "top of the stack is here", lambda console: console.mark("top")),
    Binding("b", "B", "bottom of the stack is here", lambda console: console.mark("bottom")),
    Binding("t", "Ctrl+T", "go to the top", lambda console: console.visit("top"), ctrl=True),
    Binding("b", "Ctrl+B", "go to the bottom", lambda console: console.visit("bottom"), ctrl=True),
    Binding("r", "Ctrl+R", "review before a start; pause; go on", lambda console: console.run_or_pause(), ctrl=True),
    *(Binding(f"_{n}", str(n), f"view: {what}", _view(n)) for n, what in enumerate(VIEW_WORDS, start=1)),
    *(
        Binding(f"_{n % 10}", f"Ctrl+{n % 10}", f"to the panel {name}", _panel(name), ctrl=True)
        for n, name in enumerate(PANELS, start=1)
    ),
    Binding("x", "X", "exchange the eyes", lambda console: console.viewing.press("e")),
    Binding("comma", ",", "less depth: a smaller angle between the eyes", _depth("comma"), repeats=True),
    Binding("period", ".", "more depth", _depth("period"), repeats=True),
    Binding("equal", "=", "enlarge the picture in front", lambda console: console.nearer(1), repeats=True),
    Binding("minus", "-", "make it smaller", lambda console: console.nearer(-1), repeats=True),
    Binding("l", "L", "a line through the middle, measured along; again for none", lambda c: c.across()),
    Binding("f", "F", "fit the picture to its panel", _placing),
    Binding("h", "H", "crosshair on and off", _crosshair),
    Binding("w", "W", "the camera delivers its whole frame again", lambda console: console.camera.set_roi(None)),
    Binding("q", "Ctrl+Q", "what the stack panel says waits in the queue", lambda c: c.queue_run(), ctrl=True),
    Binding("f2", "F2", "show alarms; again: they are seen", lambda console: console.alarms_seen()),
    Binding("g", "G", "glasses: show each eye its name; again to end", lambda console: console.glasses_test()),
    Binding("f11", "F11", "the whole screen; again for a window", _full_screen),
    Binding("f1", "F1", "this list", _keys),
)

ALSO = (
    ("P, or Ctrl and click, in the review", "a point: lengths and angles along all of them, in µm"),
    ("Tab, arrows", "from field to field of a panel; Enter presses what is framed"),
    ("Alt", "to the bar at the top, and back"),
    ("wheel over the picture", "stage up and down by the step; with Shift ten steps"),
    ("Ctrl and wheel", "enlarge the picture where the mouse is"),
    ("drag the picture", "move it"),
    ("Shift and drag", "a line whose grey levels are plotted"),
    ("Ctrl and drag", "the part of the frame the camera is to deliver; W for the whole again"),
    ("drag an end of the histogram", "limits of the contrast"),
)
