"""The stage: where it is, how far it may go, steps, a target, and the marks of the stack."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imgui_bundle import imgui

from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.model import Console

OLD_S = 2.0


def draw(console: Console) -> None:
    """Draw the panel."""
    _place(console)
    why_not = console.why_no_motion()
    _steps(console, why_not)
    _target(console, why_not)
    imgui.separator_text("marks of the stack")
    for end in ("top", "bottom"):
        _mark(console, end, why_not)
    if console.notice:
        w.words(f"! {console.notice}", w.ORANGE)


def _place(console: Console) -> None:
    state, limits = console.state, console.limits_um
    known = state is not None and state.z_um is not None
    with w.larger(1.7):
        imgui.text(f"z {state.z_um:+9.2f} µm" if known and state is not None else "z      ?   µm")
    if state is None or limits is None:
        return
    if not console.bench.connected or (state.z_age_s > OLD_S and not console.running):
        w.words("this position is old: the instrument does not tell a newer one", w.ORANGE)
    _scale(console, limits)
    imgui.text_colored(w.GREY, f"{limits[0]:g} … {limits[1]:g} µm allowed")


def _scale(console: Console, limits: tuple[float, float]) -> None:
    """Draw the way of the stage with its place and the marks."""
    low, high = limits
    width, height = imgui.get_content_region_avail().x, w.em(0.8).x
    at = imgui.get_cursor_screen_pos()
    imgui.dummy(imgui.ImVec2(width, height))
    lines = imgui.get_window_draw_list()
    lines.add_rect_filled(at, imgui.ImVec2(at.x + width, at.y + height), imgui.get_color_u32(imgui.Col_.frame_bg))
    marks = console.form.marks
    z_um = None if console.state is None else console.state.z_um
    for value, colour, half in (
        (marks.bottom_um, w.BLUE, 1.0),
        (marks.top_um, w.BLUE, 1.0),
        (z_um, w.ORANGE, 2.0),
    ):
        if value is not None:
            x = at.x + width * (value - low) / (high - low)
            corner = imgui.ImVec2(x - half, at.y)
            lines.add_rect_filled(corner, imgui.ImVec2(x + half, at.y + height), imgui.get_color_u32(colour))


def _steps(console: Console, why_not: str) -> None:
    jogger = console.jogger
    names = [f"{name} {size_um:g} µm" for name, size_um in jogger.steps]
    jogger.chosen = names.index(w.choice("step", names, names[jogger.chosen], 10))
    for label, steps, faster, hint in (
        ("Up", 1, False, "PgUp, or the wheel over the picture"),
        ("Down", -1, False, "PgDn, or the wheel over the picture"),
        ("Up x10", 1, True, "Ctrl+PgUp"),
        ("Down x10", -1, True, "Ctrl+PgDn"),
    ):
        if w.button(label, why_not, hint):
            console.jog(steps, faster=faster)
        imgui.same_line()
    imgui.new_line()


def _target(console: Console, why_not: str) -> None:
    entered, console.target_um = w.number("µm", console.target_um, 6)
    imgui.same_line()
    by_enter = entered and imgui.is_key_pressed(imgui.Key.enter)
    if w.button("Go", why_not, "Enter in the field goes as well") or (by_enter and not why_not):
        console.go(console.target_um)
    imgui.same_line()
    if w.button("Zero here", why_not, "call this place 0 µm; the marks are forgotten"):
        console.zero()
    rig = console.bench.rig
    if rig is not None and rig.stage.z.park_um is not None:
        imgui.same_line()
        if w.button("Park", why_not, f"go to {rig.stage.z.park_um:+g} µm, out of the way"):
            console.park()


def _mark(console: Console, end: str, why_not: str) -> None:
    value = getattr(console.form.marks, f"{end}_um")
    imgui.push_id(end)
    if w.button("Set", "" if console.state is not None else "no position is known", f"{end} is here: {end[0].upper()}"):
        console.mark(end)
    imgui.same_line()
    if w.button("Visit", why_not or ("" if value is not None else f"{end} is not set"), f"Ctrl+{end[0].upper()}"):
        console.visit(end)
    imgui.same_line()
    typed, z_um = w.number(f"{end}, µm" + ("" if value is not None else ": not set") + "###z", value or 0.0, 6, "%+.2f")
    if typed:
        setattr(console.form.marks, f"{end}_um", round(z_um, 3))
    imgui.pop_id()
