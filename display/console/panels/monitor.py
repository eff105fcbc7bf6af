"""The monitor of a run: a slice across its planes or sections as they come, mean and spread of each, and limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from imgui_bundle import imgui

from display.console.contrast import colours
from display.console.monitor import MEASURES, WORDS
from display.console.panels import widgets as w
from display.gl.live_picture import LivePicture

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.console.model import Console
    from display.console.monitor import Monitor
    from display.gl.canvas import Canvas

CURVE_EM, ROW_EM = 4.0, 1.8
LEAST_PX = 8.0


class MonitorPanel:
    """Holds the texture of the slice."""

    def __init__(self, canvas: Canvas) -> None:
        self._picture = LivePicture(canvas)
        self._sliced: tuple[object, NDArray[Any]] | None = None

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        monitor = console.monitor
        if not monitor.steps:
            w.words("nothing yet. In a run: the middle row of each plane or section as it comes, and its grey levels.")
        else:
            imgui.text_colored(w.GREY, slice_words(monitor))
            self._slice(console, monitor)
            for measure in MEASURES:
                _curve(monitor, measure)
        _limits(monitor)

    def _slice(self, console: Console, monitor: Monitor) -> None:
        """Draw what lies along the middle row, in the colours of the live picture."""
        room = imgui.get_content_region_avail()
        below = w.em(len(MEASURES) * (CURVE_EM + ROW_EM) + (1 + len(monitor.limits)) * ROW_EM).x
        width, height = int(room.x), int(max(room.y - below, w.em(4).x))
        if width < LEAST_PX:
            return
        state = (monitor.version, width, height)
        if self._sliced is None or self._sliced[0] != state:
            self._sliced = (state, monitor.reslice(width, height))
        contrast = console.contrast
        self._picture.draw(
            self._sliced[1],
            monitor.version,
            size=(width, height),
            place=(0.0, 0.0, 1.0),
            table=colours(contrast.table),
            levels=(contrast.low, contrast.high, contrast.gamma, float(console.top), False),
        )
        imgui.image(imgui.ImTextureRef(self._picture.name), imgui.ImVec2(width, height))


def slice_words(monitor: Monitor) -> str:
    """Return what the slice shows, from its top to its bottom."""
    (first, last), count = monitor.places()[[0, -1]], len(monitor.steps)
    if monitor.of_sections:
        return f"middle row, section {first + 1:.0f} … {last + 1:.0f} downwards: {count} seen, sharpest planes"
    return f"middle row, z {first:+.2f} … {last:+.2f} µm downwards: {count} planes seen, the nearest shown"


def _curve(monitor: Monitor, measure: str) -> None:
    """Plot a measure of all steps; limits in words beside it."""
    values = monitor.curve(measure)
    low, high = monitor.limits.get(measure, (None, None))
    limits = "" if low is None else f", limits {low:g} … {high:g}"
    imgui.text(f"{WORDS[measure]} {values.min():.0f} … {values.max():.0f}, now {values[-1]:.0f}{limits}")
    at, size = imgui.get_cursor_screen_pos(), imgui.ImVec2(imgui.get_content_region_avail().x, w.em(CURVE_EM).x)
    imgui.dummy(size)
    lines = imgui.get_window_draw_list()
    end = imgui.ImVec2(at.x + size.x, at.y + size.y)
    lines.add_rect_filled(at, end, imgui.get_color_u32(imgui.Col_.frame_bg))
    if len(values) > 1:
        w.curve(lines, values, imgui.ImVec2(at.x + 2, at.y + 3), imgui.ImVec2(end.x - 2, end.y - 3))


def _limits(monitor: Monitor) -> None:
    """Draw the limits outside of which a picture is told, and what else is done then."""
    why_not = "" if monitor.steps else "nothing was seen yet"
    if w.button("Limits around these", why_not, "a fifth below and above the median of what was seen"):
        monitor.watch_around()
    imgui.same_line()
    if w.button("No limits", "" if monitor.limits else "there are none"):
        monitor.limits = {}
    imgui.same_line()
    _, monitor.pauses = imgui.checkbox("pause then", monitor.pauses)
    for measure, (low, high) in list(monitor.limits.items()):
        least = w.number(f"…##low {measure}", low, 5, "%.0f")[1]
        imgui.same_line()
        most = w.number(f"{WORDS[measure]}##high", high, 5, "%.0f")[1]
        monitor.limits[measure] = (least, max(least, most))
