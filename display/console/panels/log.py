"""What happened, newest last."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, get_args

from imgui_bundle import imgui

from display.console.journal import Level
from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.journal import Line
    from display.console.model import Console

COLOURS = {"info": None, "warning": w.BLUE, "error": w.ORANGE}
LEVELS: tuple[Level, ...] = get_args(Level)
SHOWN = 200


class LogPanel:
    """Keeps to the end while nobody scrolls."""

    def __init__(self) -> None:
        self._state: tuple[int, str] = (-1, "")
        self._blocks: list[tuple[imgui.ImVec4 | None, str]] = []

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        settings = console.settings
        settings.log_level = LEVELS[LEVELS.index(w.choice("and worse", LEVELS, settings.log_level, 6))]
        imgui.same_line()
        if imgui.button("Copy"):
            imgui.set_clipboard_text("\n".join(map(str, console.journal.lines(settings.log_level))))
        imgui.begin_child("lines")
        state = (console.journal.version, settings.log_level)
        new = state != self._state
        if new:
            self._state, self._blocks = state, blocks(console.journal.lines(settings.log_level)[-SHOWN:])
        for colour, text in self._blocks:
            w.words(text, colour)
        if new:
            imgui.set_scroll_here_y(1.0)
        imgui.end_child()


def blocks(lines: list[Line]) -> list[tuple[imgui.ImVec4 | None, str]]:
    """Return lines with their colours, neighbours of one colour together: each is drawn in one go."""
    return [
        (COLOURS[level], "\n".join(map(str, alike))) for level, alike in groupby(lines, key=lambda line: line.level)
    ]
