"""The camera and its picture: live, snapshot, exposure, histogram with ends to drag, contrast, focus score."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from imgui_bundle import imgui

from display.console import contrast as grey
from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.eyes import Seen
    from display.console.model import Console

HEIGHT_EM = 5.0
HANDLE_EM = 0.8
LINEAR = False
ENDS: tuple[Literal["low", "high"], ...] = ("low", "high")


def draw(console: Console) -> None:
    """Draw the panel."""
    _frames(console)
    seen = console.eyes.seen
    if seen is None:
        w.words("no frame yet: Live, or Snap", w.GREY)
        return
    _histogram(console, seen)
    _contrast(console)
    if console.eyes.afar:
        w.words("previews from afar: saturation and focus cannot be judged by them", w.ORANGE)
        return
    _ends(seen)
    if console.top != console.told_top:
        bits = 8 * seen.pixels.itemsize
        w.words(f"frames of {bits} bits, but the instrument file has another camera.bit_depth: set it", w.ORANGE)
    _focus(console)


def _frames(console: Console) -> None:
    state = console.state
    live = state is not None and state.live
    why_not = console.why_no_motion()
    if w.button("Stop live" if live else "Live", why_not, "Space"):
        console.camera.live()
    imgui.same_line()
    if w.button("Snap", "" if live or console.running else why_not, "S: one frame, kept as a file"):
        console.camera.snap()
    imgui.same_line()
    kept = console.eyes.kept
    if w.button("Clip" if kept is None else f"End clip ({len(kept)})", "", "keep frames as they come, as a file"):
        console.camera.record()
    exposure_ms = state.exposure_ms if state is not None else console.camera.exposure_ms  # as it was known last
    if console.camera.exposure_ms is None:
        console.camera.exposure_ms = exposure_ms or 0.0
    entered, console.camera.exposure_ms = w.number("ms exposure", console.camera.exposure_ms, 5, "%.1f")
    if entered and console.camera.exposure_ms > 0:
        console.camera.set_exposure(console.camera.exposure_ms)
    elif not imgui.is_item_active():
        console.camera.exposure_ms = exposure_ms
    imgui.same_line()
    if w.button(
        "Whole frame", why_not, "W: deliver all of the frame again; Ctrl and drag in the picture chooses a part"
    ):
        console.camera.set_roi(None)
    _part(console, why_not)


def _part(console: Console, why_not: str) -> None:
    """Draw the part of the frame the camera delivers, to be typed."""
    if imgui.tree_node("part of the frame"):
        camera = console.camera
        imgui.set_next_item_width(w.em(11).x)
        x, y, width, height = imgui.input_int4("x y w h", list(camera.typed))[1]
        camera.typed = (x, y, width, height)
        imgui.same_line()
        if w.button("Take##part", why_not or ("" if min(width, height) > 0 else "it has no size")):
            camera.set_roi(camera.typed)
        imgui.tree_pop()


def _histogram(console: Console, seen: Seen) -> None:
    """Draw the histogram, logarithmic, and the two ends, each with a handle below."""
    width = imgui.get_content_region_avail().x
    height, handle = w.em(HEIGHT_EM).x, w.em(HANDLE_EM).x
    at = imgui.get_cursor_screen_pos()
    bars = seen.histogram.bars
    imgui.plot_histogram("##histogram", bars, scale_min=0.0, scale_max=1.0, graph_size=imgui.ImVec2(width, height))
    lines = imgui.get_window_draw_list()
    for end in ENDS:
        level = getattr(console.contrast, end)
        x = at.x + width * min(max(level / seen.histogram.top, 0.0), 1.0)
        imgui.set_cursor_screen_pos(imgui.ImVec2(x - handle, at.y + height))
        imgui.invisible_button(end, imgui.ImVec2(2 * handle, handle))
        if imgui.is_item_active():
            mouse = (imgui.get_io().mouse_pos.x - at.x) / width * seen.histogram.top
            console.contrast = grey.dragged(console.contrast, end, mouse, seen.histogram.top)
        colour = imgui.get_color_u32(w.ORANGE if imgui.is_item_hovered() or imgui.is_item_active() else w.BLUE)
        lines.add_line(imgui.ImVec2(x, at.y), imgui.ImVec2(x, at.y + height), colour, 2.0)
        foot = imgui.ImVec2(x, at.y + height)
        left, right = (imgui.ImVec2(x + side * 0.6 * handle, foot.y + handle) for side in (-1, 1))
        lines.add_triangle_filled(foot, right, left, colour)
    imgui.set_cursor_screen_pos(imgui.ImVec2(at.x, at.y + height + handle + 2))
    imgui.dummy(imgui.ImVec2(width, 1))


def _contrast(console: Console) -> None:
    if w.button("Fit", "", "A: fit the limits to this frame, once"):
        console.auto_contrast()
    imgui.same_line()
    changed, on = imgui.checkbox("always", console.contrast.auto == "continuous")
    if changed:
        console.contrast = replace(console.contrast, auto="continuous" if on else "off")
    imgui.same_line()
    _, ignored = w.number("% ignored", console.contrast.ignored_percent, 4)
    _levels(console)
    contrast = console.contrast
    imgui.set_next_item_width(w.em(6).x)
    _, gamma = imgui.slider_float("gamma", contrast.gamma, *grey.GAMMAS, "%.2f", imgui.SliderFlags_.logarithmic)
    imgui.same_line()
    table = w.choice("##table", grey.TABLES, contrast.table, 6)
    _, paint = imgui.checkbox("hatch the ends", contrast.paint)
    imgui.same_line()
    _, console.settings.crosshair = imgui.checkbox("cross", console.settings.crosshair)
    imgui.same_line()
    _, console.settings.scale_bar = imgui.checkbox("bar", console.settings.scale_bar)
    console.contrast = grey.chosen(contrast, gamma=gamma, table=table, paint=paint, ignored_percent=ignored)


def _levels(console: Console) -> None:
    """Draw the two ends of the contrast, to be typed."""
    for end in ENDS:
        typed, level = w.number(f"{end}##level", getattr(console.contrast, end), 4, "%.0f")
        if typed:
            console.contrast = grey.dragged(console.contrast, end, level, console.top)
        imgui.same_line()
    imgui.text(f"of {console.top}")


def _ends(seen: Seen) -> None:
    """Say what share of the whole frame lies at the ends of the scale."""
    colour = w.ORANGE if seen.over > 0.001 else w.GREY
    imgui.text_colored(colour, f"/// {100 * seen.over:.2f} % saturated")
    imgui.same_line()
    imgui.text_colored(w.BLUE if seen.under > 0.01 else w.GREY, f"\\\\\\ {100 * seen.under:.2f} % at zero")


def _focus(console: Console) -> None:
    trend = np.fromiter(console.eyes.trend.copy(), np.float32)  # the eyes may add to it meanwhile
    best, now = float(trend.max()), float(trend[-1])
    share = 100 * now / best if best else 0.0
    overlay = f"focus {share:.0f} % of the best seen lately"
    imgui.plot_lines(
        "##focus",
        trend,
        overlay_text=overlay,
        scale_min=0.0,
        scale_max=best * w.TALL or 1.0,
        graph_size=imgui.ImVec2(imgui.get_content_region_avail().x, w.em(3.5).x),
    )
