"""What happened, newest last."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from imgui_bundle import imgui

from display.console.journal import Level
from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.model import Console

COLOURS = {"info": None, "warning": w.BLUE, "error": w.ORANGE}
LEVELS: tuple[Level, ...] = get_args(Level)
SHOWN = 200


class LogPanel:
    """Keeps to the end while nobody scrolls."""

    def __init__(self) -> None:
        self._version = -1

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        settings = console.settings
        settings.log_level = LEVELS[LEVELS.index(w.choice("and worse", LEVELS, settings.log_level, 6))]
        imgui.same_line()
        if imgui.button("Copy"):
            imgui.set_clipboard_text("\n".join(map(str, console.journal.lines(settings.log_level))))
        imgui.begin_child("lines")
        for line in console.journal.lines(settings.log_level)[-SHOWN:]:
            w.words(str(line), COLOURS[line.level])
        if console.journal.version != self._version:
            self._version = console.journal.version
            imgui.set_scroll_here_y(1.0)
        imgui.end_child()
