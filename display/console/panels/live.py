"""The live picture: the frame with its contrast, wheel for the focus, scale bar, crosshair, grey level at the mouse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import imgui

from display.console import placing
from display.console.contrast import colours
from display.console.panels import widgets as w
from display.console.viewing import LIVE
from display.gl.live_picture import LivePicture

if TYPE_CHECKING:
    from display.console.eyes import Seen
    from display.console.model import Console
    from display.console.placing import Fit
    from display.gl.canvas import Canvas

BLACK = 0xFF000000
LINE_EM = 5.0
Line = tuple[tuple[int, int], tuple[int, int]]


class LivePanel:
    """Holds what lives from frame to frame: the texture, and a line whose grey levels are plotted."""

    def __init__(self, canvas: Canvas) -> None:
        self._picture = LivePicture(canvas)
        self._from: tuple[int, int] | None = None
        self._part: Line | None = None

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        console.shows = LIVE
        seen = console.eyes.seen
        room = imgui.get_content_region_avail()
        if seen is None or room.x < 8 or room.y < 8:
            w.words("no frame yet. Press Live in the camera panel, or Space." if seen is None else "")
            return
        at = imgui.get_cursor_screen_pos()
        panel = (float(int(room.x)), float(int(room.y)))
        height, width = seen.pixels.shape[:2]
        fit = placing.fit((width, height), panel, console.placing)
        self._paint(console, seen, fit, panel)
        imgui.image(imgui.ImTextureRef(self._picture.name), imgui.ImVec2(*panel))
        hovered = imgui.is_item_hovered()
        imgui.set_cursor_screen_pos(at)
        imgui.invisible_button("picture", imgui.ImVec2(*panel))
        if hovered or imgui.is_item_active() or self._part is not None:
            self._hands(console, fit, at, panel)
        self._over(console, seen, fit, at, panel)

    def _paint(self, console: Console, seen: Seen, fit: Fit, panel: tuple[float, float]) -> None:
        contrast = console.contrast
        paint = contrast.paint and (seen.over > 0 or seen.under > 0)
        self._picture.draw(
            seen.pixels,
            seen.number,
            size=(int(panel[0]), int(panel[1])),
            place=(fit.left, fit.top, fit.scale),
            table=colours(contrast.table),
            levels=(contrast.low, contrast.high, contrast.gamma, float(console.top), paint),
        )

    def _hands(self, console: Console, fit: Fit, at: imgui.ImVec2, panel: tuple[float, float]) -> None:
        """Let wheel and mouse act: focus, enlarge, move, draw a line."""
        io = imgui.get_io()
        mouse = (io.mouse_pos.x - at.x, io.mouse_pos.y - at.y)
        if io.mouse_wheel and io.key_ctrl:
            console.placing = placing.zoomed(console.placing, io.mouse_wheel, mouse, fit, panel)
        elif io.mouse_wheel:
            console.jog(io.mouse_wheel, faster=io.key_shift)
        pixel = fit.pixel_at(*mouse)
        if imgui.is_mouse_clicked(imgui.MouseButton_.left):
            self._part = (pixel, pixel) if io.key_ctrl and pixel is not None else None
            self._from = pixel if io.key_shift else None
            console.line = None if io.key_shift else console.line
        if self._part is not None:
            self._choose(console, pixel)
        elif imgui.is_mouse_dragging(imgui.MouseButton_.left):
            if self._from is not None and pixel is not None:
                console.line = (self._from, pixel)
            elif self._from is None:
                console.placing = placing.moved(console.placing, io.mouse_delta.x, io.mouse_delta.y, fit)

    def _choose(self, console: Console, pixel: tuple[int, int] | None) -> None:
        """Follow a part of the frame that is being chosen; with the button let go it is."""
        assert self._part is not None
        if pixel is not None:
            self._part = (self._part[0], pixel)
        if imgui.is_mouse_released(imgui.MouseButton_.left):
            part, self._part = self._part, None
            console.camera.choose_part(*part)

    def _over(self, console: Console, seen: Seen, fit: Fit, at: imgui.ImVec2, panel: tuple[float, float]) -> None:
        """Draw what lies over the picture."""
        lines = imgui.get_window_draw_list()
        lines.push_clip_rect(at, imgui.ImVec2(at.x + panel[0], at.y + panel[1]), True)  # noqa: FBT003  the library's
        if console.settings.crosshair:
            _cross(lines, at, fit)
        if console.settings.scale_bar:
            _scale_bar(console, lines, at, fit, panel)
        _value(console, seen, fit, lines, at)
        if console.line is not None:
            _profile(seen, console.line, fit, lines, at, panel)
        if self._part is not None:
            _frame(lines, at, fit, self._part)
        lines.pop_clip_rect()


def _cross(lines: imgui.ImDrawList, at: imgui.ImVec2, fit: Fit) -> None:
    width, height = fit.picture
    x, y = (a + b for a, b in zip((at.x, at.y), fit.place_of(width / 2, height / 2), strict=True))
    left, top = (a + b for a, b in zip((at.x, at.y), fit.place_of(0, 0), strict=True))
    right, bottom = (a + b for a, b in zip((at.x, at.y), fit.place_of(width, height), strict=True))
    for colour, off in ((BLACK, 1), (w.YELLOW, 0)):
        lines.add_line(imgui.ImVec2(left, y + off), imgui.ImVec2(right, y + off), colour)
        lines.add_line(imgui.ImVec2(x + off, top), imgui.ImVec2(x + off, bottom), colour)


def _frame(lines: imgui.ImDrawList, at: imgui.ImVec2, fit: Fit, part: Line) -> None:
    """Draw the part that is being chosen, and how large it is."""
    (x0, y0), (x1, y1) = part
    left, right, top, bottom = min(x0, x1), max(x0, x1) + 1, min(y0, y1), max(y0, y1) + 1
    corners = [fit.place_of(left, top), fit.place_of(right, bottom)]
    (x, y), low = corners[0], corners[1]
    lines.add_rect(imgui.ImVec2(at.x + x, at.y + y), imgui.ImVec2(at.x + low[0], at.y + low[1]), w.YELLOW, 0.0, 2.0)
    w.over_picture(lines, imgui.ImVec2(at.x + x, at.y + y - w.em(1.4).x), f"{right - left} × {bottom - top}")


def _scale_bar(
    console: Console, lines: imgui.ImDrawList, at: imgui.ImVec2, fit: Fit, panel: tuple[float, float]
) -> None:
    rig = console.bench.rig
    pixel_um = None if rig is None else rig.object_pixel_um
    if not pixel_um:
        return
    length_um, length = placing.scale_bar(pixel_um / fit.scale, panel[0])
    x, y = at.x + w.em(1).x, at.y + panel[1] - w.em(1).x
    thick = w.em(0.25).x
    lines.add_rect_filled(imgui.ImVec2(x - 2, y - thick - 2), imgui.ImVec2(x + length + 2, y + 2), BLACK)
    lines.add_rect_filled(imgui.ImVec2(x, y - thick), imgui.ImVec2(x + length, y), w.WHITE)
    w.over_picture(lines, imgui.ImVec2(x, y - thick - w.em(1.4).x), f"{length_um:g} µm")


def _value(console: Console, seen: Seen, fit: Fit, lines: imgui.ImDrawList, at: imgui.ImVec2) -> None:
    """Write what is under the mouse, and what the frame is."""
    header = seen.header
    plane = f" · section {header.section + 1} · plane {header.plane + 1}" if header.plane >= 0 else ""
    parts = [f"{fit.picture[0]} × {fit.picture[1]}{plane} · z {header.z_um:+.2f} µm"]
    if console.state is not None and (console.state.live or console.running):
        parts.append(f"{console.eyes.rate_hz:.0f} frames/s")
    if console.eyes.afar:
        parts.append("preview from afar: compressed, ends of the scale cut off")
    mouse = imgui.get_io().mouse_pos
    pixel = fit.pixel_at(mouse.x - at.x, mouse.y - at.y) if imgui.is_window_hovered() else None
    if pixel is not None:
        parts.append(f"x {pixel[0]} y {pixel[1]}: {seen.pixels[pixel[1], pixel[0]]}")
    w.over_picture(lines, imgui.ImVec2(at.x + w.em(0.5).x, at.y + w.em(0.3).x), "   ".join(parts))


def _profile(
    seen: Seen,
    line: Line,
    fit: Fit,
    lines: imgui.ImDrawList,
    at: imgui.ImVec2,
    panel: tuple[float, float],
) -> None:
    """Draw the line and the grey levels along it."""
    (x0, y0), (x1, y1) = line
    ends = [imgui.ImVec2(at.x + x, at.y + y) for x, y in (fit.place_of(x0, y0), fit.place_of(x1, y1))]
    lines.add_line(ends[0], ends[1], w.YELLOW, 2.0)
    levels = along(seen.pixels, line)
    top, bottom = at.y + panel[1] - w.em(LINE_EM + 3).x, at.y + panel[1] - w.em(3).x
    w.curve(lines, levels, imgui.ImVec2(at.x + 4, top), imgui.ImVec2(at.x + panel[0] - 4, bottom))
    words = f"grey levels {levels.min():.0f} … {levels.max():.0f} along {len(levels)} px"
    w.over_picture(lines, imgui.ImVec2(at.x + w.em(0.5).x, top - w.em(1.4).x), words)


def along(pixels: np.ndarray, line: Line) -> np.ndarray:
    """Return the grey levels along a line between two pixels (column, row), the nearest pixel at every step of one."""
    height, width = pixels.shape[:2]
    (x0, y0), (x1, y1) = ((min(x, width - 1), min(y, height - 1)) for x, y in line)  # frames may shrink
    count = max(abs(x1 - x0), abs(y1 - y0)) + 1
    columns, rows = (np.rint(np.linspace(a, b, count)).astype(int) for a, b in ((x0, x1), (y0, y1)))
    levels: np.ndarray = pixels[rows, columns].astype(np.float64)
    return levels if levels.ndim == 1 else np.asarray(levels.mean(axis=1))
