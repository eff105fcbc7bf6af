"""The session: who works, notes kept with the data, and what the console remembers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imgui_bundle import imgui

from display.console.panels import widgets as w
from display.console.panels.sticks import StickPanel

if TYPE_CHECKING:
    from display.console.model import Console

ROWS_EM = 7.0


class SessionPanel:
    """Holds what belongs to the stick."""

    def __init__(self) -> None:
        self._sticks = StickPanel()

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        _notes(console)
        if imgui.tree_node("gamepad or 3-D mouse"):
            self._sticks.draw(console)
            imgui.tree_pop()


def _notes(console: Console) -> None:
    form = console.form
    form.operator = w.text_field("operator", form.operator, 10)
    imgui.text("notes kept with the next run")
    _, form.notes = imgui.input_text_multiline("##notes", form.notes, w.em(20, ROWS_EM))
    running = "" if console.running else "no run is under way"
    if w.button("Into the journal of this run", running, "adds these notes, with their time"):
        console.note(form.notes)
    console.settings.snapshots = w.text_field("snapshots go to", console.settings.snapshots, 10)
    _, console.settings.sound = imgui.checkbox("a sound at alarms", console.settings.sound)
    imgui.text("a command, run at the end and when a run asks")
    form.notify = w.text_field("##notify", form.notify, 20)
    why_not = "a run has the devices" if console.running else ""
    if w.button("Start the instrument anew", why_not, "its process, and with it all devices that were lost"):
        console.bench.start_anew()
    form.keep_free_gb = max(0.0, w.number("GB to keep free", form.keep_free_gb, 5)[1])
    if imgui.tree_node("the recipe this makes"):
        imgui.input_text_multiline("##recipe", form.recipe(), w.em(22, 14), imgui.InputTextFlags_.read_only)
        imgui.tree_pop()
    if not console.bench.commands:
        if w.button("Take command"):
            console.bench.take_command()
    elif w.button("Give command back", "", "let another console or script command"):
        console.bench.give_command()
