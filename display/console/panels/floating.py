"""What floats over the panels: the review before a start, the tour, alarms, the list of keys. None of it is modal."""

from __future__ import annotations

from itertools import zip_longest
from typing import TYPE_CHECKING

from imgui_bundle import imgui

from devices.errors import StereotomeError
from display.console.keys import ALSO, BINDINGS
from display.console.panels import sections, setup, stack
from display.console.panels import widgets as w
from display.console.tour import STEPS

if TYPE_CHECKING:
    from display.console.model import Console
    from display.console.tour import Tour


def draw(console: Console) -> None:
    """Draw all that is open."""
    if console.reviewing:
        before_start(console)
    if console.running and console.run is not None and console.run.question is not None:
        sections.ask(console, console.run.question)
    if console.setup is not None and not console.setup.done:
        setup.draw(console.setup)
    if console.tour is not None and console.tour.shown:
        tour_step(console.tour)
    if console.shows_alarms and console.alarms.unseen:
        alarms(console)
    if console.shows_keys:
        key_list(console)


def before_start(console: Console) -> None:
    """Draw what is about to be started; not modal, so that STOP stays within reach."""
    imgui.set_next_window_size(w.em(30, 0), imgui.Cond_.appearing)
    imgui.set_next_window_pos(imgui.get_main_viewport().get_center(), imgui.Cond_.appearing, imgui.ImVec2(0.5, 0.5))
    _, opened = imgui.begin("Review before the start", True)  # noqa: FBT003  the library's
    console.reviewing = bool(opened)
    for line in review_words(console):
        w.words(line)
    why_not = console.why_no_start()
    if w.button("Start now", why_not):
        console.start_run()
    imgui.same_line()
    if imgui.button("Back"):
        console.reviewing = False
    if why_not:
        w.words(f"! {why_not}", w.ORANGE)
    imgui.end()


def review_words(console: Console) -> list[str]:
    """Return everything that matters before a start, a line for each."""
    form, planned, state = console.form, console.planned, console.state
    lines = [f"name: {form.name}    operator: {form.operator or console.bench.actor}"]
    if planned is not None and not isinstance(planned, StereotomeError):
        lines += [
            f"from {planned.first_um:+.2f} to {planned.last_um:+.2f} µm, {form.direction}, then to {form.return_to}",
            *stack.cost_words(planned),
            f"data: {planned.folder}",
        ]
        if form.sections.wanted:
            lines.append(f"CUTS {planned.sections} sections of {form.sections.thickness} nm: this cannot be undone")
    if state is not None:
        lines.append(f"camera: {state.camera}, {form.exposure_ms or state.exposure_ms:g} ms")
    return [*lines, f"notes: {form.notes or '-'}"]


def tour_step(tour: Tour) -> None:
    """Draw a step of the demonstration, low in the middle, not in the way of anything."""
    screen = imgui.get_main_viewport().size
    imgui.set_next_window_pos(imgui.ImVec2(0.5 * screen.x, 0.7 * screen.y), imgui.Cond_.appearing, imgui.ImVec2(0.5, 0))
    imgui.set_next_window_size(w.em(30, 0), imgui.Cond_.appearing)
    _, opened = imgui.begin("Tour", True)  # noqa: FBT003  the library's
    title, words = STEPS[tour.step]
    imgui.text_colored(w.BLUE, f"{tour.step + 1}/{len(STEPS)}  {title}")
    w.words(words)
    if imgui.button("Next" if tour.step + 1 < len(STEPS) else "Close"):
        tour.forward()
    tour.shown = tour.shown and bool(opened)
    imgui.end()


def alarms(console: Console) -> None:
    """Draw what nobody has seen yet."""
    imgui.set_next_window_size(w.em(34, 0), imgui.Cond_.appearing)
    screen = imgui.get_main_viewport().size  # beside the position of the stage, above what a run asks
    imgui.set_next_window_pos(imgui.ImVec2(0.27 * screen.x, w.em(5).x), imgui.Cond_.appearing)
    _, opened = imgui.begin("Alarms", True)  # noqa: FBT003  the library's
    console.shows_alarms = bool(opened)
    for line in console.alarms.unseen:
        w.words(f"! {line}", w.ORANGE)
    if w.button("Seen", "", "F2"):
        console.alarms_seen()
    imgui.end()


def key_list(console: Console) -> None:
    """Draw what the keys do."""
    imgui.set_next_window_size(w.em(64, 0), imgui.Cond_.appearing)
    middle = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(middle, imgui.Cond_.appearing, imgui.ImVec2(0.5, 0.5))
    _, opened = imgui.begin("Keys", True)  # noqa: FBT003  the library's
    console.shows_keys = bool(opened)
    listed = [*((binding.shown, binding.words) for binding in BINDINGS), *ALSO]
    half = (len(listed) + 1) // 2
    if imgui.begin_table("keys", 4, imgui.TableFlags_.sizing_stretch_prop):
        for left, right in zip_longest(listed[:half], listed[half:], fillvalue=("", "")):
            for text in (*left, *right):
                imgui.table_next_column()
                w.words(text)
        imgui.end_table()
    imgui.end()
