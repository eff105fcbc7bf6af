"""Sections: feed and knife as they stand and by hand, the sections a run is to cut, and what a run asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imgui_bundle import imgui

from display.console.panels import widgets as w
from display.console.stack_form import NM_PER_UM, ON_ERROR, ON_QUALITY

if TYPE_CHECKING:
    from acquire.replies import Question
    from display.console.model import Console


def draw(console: Console) -> None:
    """Draw the panel."""
    rig = console.bench.rig
    if rig is None or rig.microtome is None:
        w.words("This instrument has no feed: its file has no [microtome].", w.GREY)
        return
    _stands(console)
    imgui.separator_text("sections of the run to come")
    _form(console)
    imgui.separator_text("by hand")
    _by_hand(console)
    if console.knife.notice:
        w.words(f"! {console.knife.notice}", w.ORANGE)


def _stands(console: Console) -> None:
    feed = console.feed
    if feed is None:
        imgui.text("feed: not read yet")
        return
    imgui.text(f"feed {feed.depth_nm / NM_PER_UM:.3f} µm, {feed.state or 'ready'}")
    imgui.text_colored(w.BLUE if feed.knife == "clear" else w.ORANGE, f"knife {feed.knife}")
    imgui.same_line()
    imgui.text(f"strokes counted: {feed.cuts}")
    if console.running and console.run is not None:
        run = console.run
        w.words(f"run: section {run.section + 1} of {run.sections}, {run.phase}")


def _form(console: Console) -> None:
    form = console.form.sections
    _, form.wanted = imgui.checkbox("cut sections, a stack of each face", form.wanted)
    form.thickness = w.text_field("nm thick", form.thickness, 11)
    w.hint("one for all cuts, or ranges of cuts: 1-20: 100, 21-: 50")
    if form.by_depth:
        form.depth_um = max(0.001, w.number("µm in all", form.depth_um, 7, "%.3f")[1])
    else:
        form.count = w.whole("sections", form.count, 1, 1_000_000)
    imgui.same_line()
    _, form.by_depth = imgui.checkbox("by depth", form.by_depth)
    try:
        imgui.text_colored(w.GREY, f"{form.number} sections, {form.total_um:.2f} µm in all")
    except ValueError as wrong:
        w.words(f"! nm thick: {wrong}", w.ORANGE)
    _, form.cut_first = imgui.checkbox("cut before the first image", form.cut_first)
    form.sweeps = w.whole("wipes at debris (0 asks)", form.sweeps, 0, 10)
    form.autofocus_every = w.whole("between autofocus (0 never)", form.autofocus_every, 0, 1000)
    form.on_quality = w.choice("odd picture", ON_QUALITY, form.on_quality, 6)
    form.on_error = w.choice("something fails", ON_ERROR, form.on_error, 8)


def _by_hand(console: Console) -> None:
    why_not = console.why_no_motion()
    if w.button("Home feed", why_not, "search its reference: it may travel its whole length"):
        console.knife.home()
    imgui.same_line()
    if w.button("Retract knife", why_not, "bring the knife out, without a feed"):
        console.knife.retract()
    console.knife.depth_um = w.number("µm deep", console.knife.depth_um, 6, "%.3f")[1]
    imgui.same_line()
    if w.button("Approach", why_not, "go to this depth in one go; nothing is cut"):
        console.knife.approach(console.knife.depth_um)
    if w.button("Feed one", why_not, "forward by the thickness of the first cut"):
        console.knife.feed_once()
    imgui.same_line()
    if w.button("Arm knife", why_not, "allow one cut within the next 10 s"):
        console.knife.arm()
    imgui.same_line()
    left_s = console.knife.armed_left_s
    if w.button("Cut one", why_not or ("" if left_s else "arm the knife first"), "one stroke; cannot be undone"):
        console.knife.cut()
    if left_s:
        imgui.text_colored(w.ORANGE, f"armed for {left_s:.0f} s")


def ask(console: Console, question: Question) -> None:
    """Draw what a run on HOLD asks, over everything but not in the way of STOP."""
    imgui.set_next_window_size(w.em(34, 0), imgui.Cond_.appearing)
    screen = imgui.get_main_viewport().size  # low, so that what is asked about can be seen
    imgui.set_next_window_pos(
        imgui.ImVec2(0.5 * screen.x, 0.55 * screen.y), imgui.Cond_.appearing, imgui.ImVec2(0.5, 0)
    )
    imgui.begin("The run asks", None, imgui.WindowFlags_.no_collapse)
    imgui.text_colored(w.ORANGE, f"HOLD: {question.code}")
    w.words(question.words)
    why_not = "" if console.bench.commands else "this console does not command"
    for choice, does in question.answers.items():
        if w.button(choice, why_not, width=8):
            console.answer(choice)
        imgui.same_line()
        w.words(does)
    imgui.end()
