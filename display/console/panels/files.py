"""Instrument and recipe files, edited as text."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from imgui_bundle import imgui

from devices.toml_write import toml_text
from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.model import Console

LEAST_EM, WORDS_EM = 8.0, 7.0


def draw(console: Console) -> None:
    """Draw the panel."""
    files = console.files
    files.path = w.text_field("file", files.path, 16)
    if w.button("Open", "" if files.path else "name a file"):
        files.open()
    imgui.same_line()
    if w.button("Check", "" if files.text else "there is no text"):
        files.check()
    imgui.same_line()
    why_not = "" if files.path and files.text else "name a file and write something"
    if w.button("Save", why_not or ("" if files.changed else "it is stored as it is"), "only what is good is written"):
        files.save()
    _recipe(console)
    _begin(console)
    room = imgui.get_content_region_avail().y / w.em(1).x
    _, files.text = imgui.input_text_multiline("##text", files.text, w.em(-0.1, max(LEAST_EM, room - WORDS_EM)))
    if files.words:
        w.words(files.words, w.BLUE if files.good else w.ORANGE)


def _recipe(console: Console) -> None:
    """Draw what a good recipe can be used for."""
    files = console.files
    why_not = "" if files.good and files.kind == "recipe" else "this is no good recipe"
    imgui.same_line()
    if w.button("Queue it", why_not):
        console.queue.add(Path(files.path).name or "recipe", files.text)
    imgui.same_line()
    if w.button("Into the form", why_not, "the stack panel then makes this run"):
        files.words = console.fill_form(files.text)


def _begin(console: Console) -> None:
    """Draw what a text can begin with."""
    if w.button("The form as a recipe"):
        console.files.begin("recipe.toml", console.form.recipe())
    imgui.same_line()
    rig = console.bench.rig
    if w.button("This instrument", "" if rig is not None else "no instrument is known") and rig is not None:
        console.files.begin(
            f"{rig.name}.toml", toml_text(rig.model_dump(mode="json", by_alias=True, exclude_none=True))
        )
