"""The stack to take: range, distance of planes, what it costs; and the run under way with pause, abort and its end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imgui_bundle import imgui

from acquire.replies import Planned
from acquire.state import FINAL
from acquire.words import took
from devices.errors import StereotomeError
from display.console.journal import words_of
from display.console.panels import widgets as w
from display.console.stack_form import RETURNS, SPACINGS

if TYPE_CHECKING:
    from acquire.replies import RunView
    from display.console.model import Console
    from display.console.run_queue import RunQueue

SPACING_WORDS = {
    "planes": "number of planes",
    "step": "distance in µm",
    "nyquist": "Nyquist, from the optics",
    "dof": "depth of field",
}
SCOPES = ("plane", "stack", "section", "before_cut")
SCOPE_WORDS = {
    "plane": "now",
    "stack": "after this stack",
    "section": "after this section",
    "before_cut": "before the cut",
}
GIGA = 1e9


def draw(console: Console) -> None:
    """Draw the panel."""
    if console.running and console.run is not None:
        _under_way(console, console.run)
        return
    _form(console)
    imgui.separator()
    _cost(console)
    why_not = console.why_no_start()
    if w.button("Review and start...", why_not, "Ctrl+R"):
        console.reviewing = True
    imgui.same_line()
    _queue_button(console)
    if why_not:
        w.words(f"! {why_not}", w.ORANGE)
    queue(console)
    if console.run is not None:
        imgui.separator()
        _last(console, console.run)


def _queue_button(console: Console) -> None:
    planned = isinstance(console.planned, Planned)
    if w.button("Queue", "" if planned else "it cannot be carried out as it is", "Ctrl+Q: wait for its turn"):
        console.queue_run()


def _form(console: Console) -> None:
    form = console.form
    form.name = w.text_field("name", form.name, 10)
    if form.marks.complete:
        bottom_um, top_um = form.marks.in_order()
        imgui.text(f"{bottom_um:+.2f} … {top_um:+.2f} µm: {top_um - bottom_um:.2f} µm, between the marks")
    else:
        _, form.around_um = w.number("µm around here (set marks)", form.around_um, 5)
        form.around_um = max(form.around_um, 0.01)
    labels = [SPACING_WORDS[spacing] for spacing in SPACINGS]
    form.spacing = SPACINGS[labels.index(w.choice("##spacing", labels, SPACING_WORDS[form.spacing], 12))]
    if form.spacing == "planes":
        form.planes = w.whole("planes", form.planes, 2, 100_000)
    elif form.spacing == "step":
        _, form.step_um = w.number("µm##step", form.step_um, 5)
        form.step_um = max(form.step_um, 0.001)
    _advice(console)
    form.direction = "up" if w.choice("direction", ("up", "down"), form.direction, 5) == "up" else "down"
    imgui.same_line()
    form.return_to = w.choice("then to", RETURNS, form.return_to, 5)
    _, form.focus = imgui.checkbox("extended focus and range", form.focus)
    imgui.same_line()
    _, form.stereo = imgui.checkbox("stereo pair", form.stereo)
    form.folder = w.text_field("folder", form.folder, 14)


def _advice(console: Console) -> None:
    told = console.advice
    if told is None:
        return
    imgui.text_colored(w.GREY, f"Nyquist {told.nyquist_um:.2f} µm · depth of field {told.depth_of_field_um:.2f} µm")
    if console.planned is not None and not isinstance(console.planned, StereotomeError):
        overlap = told.overlap_percent(console.planned.step_um)
        colour = w.GREY if overlap > 0 else w.ORANGE
        more = "" if overlap > 0 else " (extended focus will have gaps)"
        w.words(f"planes overlap by {overlap:.0f} % of it{more}", colour)


def _cost(console: Console) -> None:
    planned = console.planned
    if planned is None:
        imgui.text("planning...")
    elif isinstance(planned, StereotomeError):
        w.words(words_of(planned), w.ORANGE)
    else:
        for line in cost_words(planned):
            imgui.text(line)


def cost_words(planned: Planned) -> list[str]:
    """Return what a plan costs, a line for each thing."""
    sections = f"{planned.sections} × " if planned.sections > 1 else ""
    return [
        f"{sections}{planned.planes_each} planes, {abs(planned.step_um):.3g} µm apart",
        f"takes {took(planned.seconds)}, light on the specimen {took(planned.dose_s)}",
        f"needs {planned.needed_bytes / GIGA:.2f} GB with reserve, {planned.free_bytes / GIGA:.1f} GB free",
    ]


def _under_way(console: Console, run: RunView) -> None:
    still = run.state == "PAUSED" or run.state in FINAL
    imgui.text(f"{run.name}: {run.state}" + ("" if still else f", {run.phase}"))
    w.words(run.folder, w.GREY)
    if run.sections > 1:
        imgui.progress_bar(
            run.section / run.sections, overlay=f"section {run.section + 1} of {run.sections}", size_arg=w.em(-0.1, 0)
        )
    imgui.progress_bar(
        run.durable / max(run.planned, 1), overlay=f"{run.durable} of {run.planned} planes safe", size_arg=w.em(-0.1, 0)
    )
    imgui.text(f"taken {run.taken}" + (f", missed {run.missed}" if run.missed else ""))
    if run.state in FINAL:
        w.words("nothing more is taken; what is computed of it is being written", w.BLUE)
    else:
        imgui.text("time left " + ("?" if run.left_s is None else took(run.left_s)))
        transport(console, run)
    if run.pausing and run.state != "PAUSED":
        w.words(f"pauses {SCOPE_WORDS.get(run.pausing, run.pausing)}", w.BLUE)
    queue(console)
    if imgui.collapsing_header("the next run"):
        _form(console)
        _cost(console)
        _queue_button(console)


def queue(console: Console) -> None:
    """Draw the runs that wait."""
    waiting = console.queue
    if not waiting.waiting:
        return
    imgui.separator_text(f"{len(waiting.waiting)} waiting")
    if waiting.going:
        if w.button("Hold the queue", "", "the run under way goes on, none is started after it"):
            waiting.hold("held by hand")
    elif w.button("Start the queue", "", "one after the other, each when the one before has completed"):
        waiting.go(console)
    if waiting.held:
        w.words(f"! {waiting.held}", w.ORANGE)
    _waiting(waiting)


def _waiting(waiting: RunQueue) -> None:
    """Draw each run that waits, with what takes it out or brings it forward."""
    for place, each in enumerate(list(waiting.waiting)):
        imgui.push_id(place)
        if w.button("x", "", "take it out"):
            waiting.waiting.remove(each)
        imgui.same_line()
        if w.button("^", "" if place else "it is the next", "sooner"):
            waiting.move(place, -1)
        imgui.same_line()
        imgui.text(each.name)
        imgui.pop_id()


def transport(console: Console, run: RunView) -> None:
    """Draw pause, resume and abort."""
    why_not = "" if console.bench.commands else "this console does not command"
    if run.state == "PAUSED":
        if w.button("Resume", why_not, "Ctrl+R"):
            console.resume()
    else:
        labels = [SCOPE_WORDS[scope] for scope in SCOPES]
        console.pause_scope = SCOPES[labels.index(w.choice("##scope", labels, SCOPE_WORDS[console.pause_scope], 9))]
        imgui.same_line()
        if w.button("Pause", why_not, "Ctrl+R"):
            console.pause()
    imgui.same_line()
    if w.button("Abort", why_not, "ends after the exposure in work; what was taken is kept, the stage goes back"):
        console.abort()


def _last(console: Console, run: RunView) -> None:
    if run.state not in FINAL:
        return
    good = run.state == "COMPLETED"
    w.words(f"last run {run.state}: {run.durable} of {run.planned} planes", w.BLUE if good else w.ORANGE)
    w.words(run.folder, w.GREY)
    if run.error is not None:
        w.words(f"[{run.error.code}] {run.error.what}", w.ORANGE)
    for warning in run.warnings:
        w.words(f"! {warning}", w.ORANGE)
    if console.can_continue() and w.button("Take what is missing", console.why_no_motion()):
        console.continue_run(run.folder)
