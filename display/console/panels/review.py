"""A finished run, looked at again in any kind of picture and stereo, measured and saved."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from imgui_bundle import imgui

from devices.errors import StereotomeError
from display import controls
from display.console.contrast import TABLES
from display.console.drawn import FLAT
from display.console.flipping import REVIEW as SHOWN_REVIEW
from display.console.panels import widgets as w
from display.console.review import PAGE_FLIP, Film
from display.console.viewing import REVIEW
from display.controls import STEREOS
from display.gl.live_picture import StillPicture
from display.movie import SWEEPS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from display.console.drawn import Drawn
    from display.console.model import Console
    from display.console.review import Reviewer
    from display.console.viewing import Viewing
    from display.gl.canvas import Canvas
    from display.stereo import Mode

BUTTONS: tuple[tuple[imgui.MouseButton_, Literal["left", "right", "middle"]], ...] = (
    (imgui.MouseButton_.left, "left"),
    (imgui.MouseButton_.right, "right"),
    (imgui.MouseButton_.middle, "middle"),
)
OWN = "own colours"
STEREO_KINDS: tuple[Mode, ...] = (STEREOS[0], PAGE_FLIP, *STEREOS[1:])


class ReviewPanel:
    """Shows what the reviewer's thread made of what `Viewing` says."""

    def __init__(self, canvas: Canvas, reviewer: Reviewer) -> None:
        self._picture = StillPicture(canvas)
        self.reviewer = reviewer

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        viewing = console.viewing
        console.shows = REVIEW
        self._source(console)
        if not viewing.folder:
            w.words("Open the last run, or name a run's folder, a TIFF, a Zarr ...", w.GREY)
            return
        _kind(console)
        if viewing.shown.mode not in FLAT:
            self._depth(viewing)
        if self.reviewer.drawn is not None and self.reviewer.drawn.third:
            self._points(console, self.reviewer.drawn)
        self._show(console)

    def _points(self, console: Console, drawn: Drawn) -> None:
        """Draw what is done with points that are picked, and the pixel of one to be typed."""
        viewing, picks = console.viewing, console.viewing.picks
        imgui.set_next_item_width(w.em(7).x)
        x, y = imgui.input_int2("##pixel", list(viewing.pixel))[1]
        viewing.pixel = (x, y)
        imgui.same_line()
        found = drawn.place_um(viewing.pixel)
        if w.button("Point here", "" if found else "nothing is known there", "Ctrl and click, or P over the picture"):
            assert found is not None
            picks.add(found, drawn.third, drawn.unit)
        imgui.same_line()
        why_not = "" if picks.points else "no point was picked"
        if w.button("No points", why_not):
            picks.forget()
        imgui.same_line()
        if w.button("Save points", why_not, "each with the way to it and its angle, as a table"):
            self._save(console, ".csv", picks.save)

    def _source(self, console: Console) -> None:
        viewing = console.viewing
        if w.button("Last run", "" if console.last_run else "there is none yet"):
            viewing.open(console.last_run)
        imgui.same_line()
        viewing.typed = w.text_field("##folder", viewing.typed, 14)
        imgui.same_line()
        if w.button("Open", "" if viewing.typed else "name a folder or a file"):
            viewing.open(viewing.typed)
        imgui.same_line()
        if w.button("Save picture", "" if self.reviewer.drawn is not None else "there is no picture"):
            self._save(console, ".png", self.reviewer.save)
        self._movie(console)

    def _movie(self, console: Console) -> None:
        """Draw what makes a movie of what is shown."""
        viewing = console.viewing
        drawn, filming = self.reviewer.drawn, self.reviewer.filming
        imgui.same_line()
        why_not = filming or ("" if drawn is not None else "there is no picture")
        why_not = why_not or ("a flat picture stays as it is" if viewing.flat else "")
        if w.button("Movie", why_not, f"{viewing.frames} pictures as MP4: {viewing.sweep}") and drawn is not None:
            self.reviewer.film(Film(drawn.wish, viewing.sweep, viewing.frames, self._free(console, ".mp4")))
        imgui.same_line()
        viewing.sweep = SWEEPS[SWEEPS.index(w.choice("##sweep", SWEEPS, viewing.sweep, 6))]  # type: ignore[assignment]
        if filming:
            w.words(filming, w.BLUE)

    def _free(self, console: Console, suffix: str) -> Path:
        """Return a file that does not exist, named after what is shown."""
        folder, viewing = Path(console.settings.snapshots), console.viewing
        folder.mkdir(parents=True, exist_ok=True)
        name = f"{Path(viewing.folder).name}-{viewing.shown.mode.replace(' ', '-')}-{viewing.shown.stereo.mode}"
        free = (folder / f"{name}{f'-{n}' if n else ''}{suffix}" for n in range(10_000))
        return next(path for path in free if not path.exists())

    def _save(self, console: Console, suffix: str, save: Callable[[Path], None]) -> None:
        try:
            file = self._free(console, suffix)
            save(file)
        except OSError as error:
            console.journal.add("error", "review", f"not saved: {error}")
        else:
            console.journal.add("info", "review", f"saved {file}")

    def _depth(self, viewing: Viewing) -> None:
        """Draw what belongs to volumes: the plane in the middle, the threshold of a surface, opacities."""
        viewing.shown = controls.grown(viewing.shown, self.reviewer.planes)
        if viewing.shown.mode in controls.PLANES:
            imgui.set_next_item_width(w.em(10).x)
            _, plane = imgui.slider_int("plane", round(viewing.shown.plane), 0, max(viewing.shown.planes - 1, 0))
            viewing.plane(plane)
            return
        low, high = self.reviewer.limits
        imgui.set_next_item_width(w.em(10).x)
        value = (low + high) / 2 if viewing.threshold is None else viewing.threshold
        changed, value = imgui.slider_float("threshold", value, low, high, "%.0f")
        viewing.threshold = value if changed else viewing.threshold
        if imgui.tree_node("opacity"):
            _opacity(viewing, low, high)
            imgui.tree_pop()

    def _show(self, console: Console) -> None:
        room = imgui.get_content_region_avail()
        size = (int(room.x), int(room.y))
        if min(size) < 32:
            return
        at = imgui.get_cursor_screen_pos()
        self.reviewer.wish(console.viewing.wish(size))
        drawn = self.reviewer.drawn
        if self.reviewer.problem or drawn is None:
            w.words(self.reviewer.problem or "reading ...", w.ORANGE if self.reviewer.problem else w.GREY)
            return
        self._picture.draw(drawn.picture, size=size)
        imgui.image(imgui.ImTextureRef(self._picture.name), room)
        imgui.set_cursor_screen_pos(at)
        imgui.invisible_button("drawn", room)
        if imgui.is_item_hovered() or imgui.is_item_active():
            _hands(console.viewing, drawn, (at.x, at.y))
        _measured(console, drawn, (at.x, at.y))
        _picked(console.viewing, drawn, (at.x, at.y), room.y)
        if self.reviewer.busy:
            lines = imgui.get_window_draw_list()
            w.over_picture(lines, imgui.ImVec2(at.x + w.em(0.5).x, at.y + room.y - w.em(1.6).x), "drawing ...")


def _hands(viewing: Viewing, drawn: Drawn, at: tuple[float, float]) -> None:
    """Let the mouse turn, move and enlarge; in flat pictures the left button draws a line."""
    io = imgui.get_io()
    if io.mouse_wheel:
        viewing.nearer(io.mouse_wheel)
    place = (int(io.mouse_pos.x - at[0]), int(io.mouse_pos.y - at[1]))
    picked = imgui.is_key_pressed(imgui.Key.p, False)  # noqa: FBT003  the library's
    if drawn.third and (picked or io.key_ctrl):
        if picked or imgui.is_mouse_clicked(imgui.MouseButton_.left):
            _pick(viewing, drawn, place)
        return
    if viewing.flat and imgui.is_mouse_down(imgui.MouseButton_.left):
        start = place if imgui.is_mouse_clicked(imgui.MouseButton_.left) or viewing.line is None else viewing.line[0]
        viewing.line = (start, place)
        return
    for which, name in BUTTONS:
        if imgui.is_mouse_dragging(which):
            viewing.shown = controls.drag(viewing.shown, io.mouse_delta.x, io.mouse_delta.y, name, drawn.pixel_um)


def _pick(viewing: Viewing, drawn: Drawn, pixel: tuple[int, int]) -> None:
    """Add the place under the mouse to the line of points, where there is one."""
    if (found := drawn.place_um(pixel)) is not None:
        viewing.picks.add(found, drawn.third, drawn.unit)


def _picked(viewing: Viewing, drawn: Drawn, at: tuple[float, float], height: float) -> None:
    """Draw the points that were picked, and what was measured along them."""
    picks = viewing.picks
    if not picks.points or drawn.third != picks.third:
        return
    lines = imgui.get_window_draw_list()
    seen = [drawn.pixel_of(place) for place in picks.points]
    corners = [imgui.ImVec2(at[0] + x, at[1] + y) for x, y in seen]
    lines.add_polyline([*corners], w.YELLOW, 2.0, 0)
    for number, corner in enumerate(corners, start=1):
        lines.add_circle(corner, w.em(0.3).x, w.YELLOW)
        lines.add_text(imgui.ImVec2(corner.x + w.em(0.4).x, corner.y), w.YELLOW, str(number))
    w.over_picture(lines, imgui.ImVec2(at[0] + w.em(0.5).x, at[1] + height - w.em(3.2).x), picks.words, w.YELLOW)


def _measured(console: Console, drawn: Drawn, at: tuple[float, float]) -> None:
    """Draw the line with its length in µm, and, over a range image, the heights along it."""
    viewing = console.viewing
    if viewing.line is None or viewing.line[0] == viewing.line[1] or drawn.wish.shown.mode not in FLAT[:2]:
        return
    lines = imgui.get_window_draw_list()
    if drawn.scene.stereo.mode != "mono":  # each eye sees the line's ends elsewhere
        words = "measured with one eye only: choose mono"
        w.over_picture(lines, imgui.ImVec2(at[0] + w.em(0.5).x, at[1] + w.em(2.4).x), words, w.YELLOW)
        return
    start, end = (imgui.ImVec2(at[0] + x, at[1] + y) for x, y in drawn.ends_px(viewing.line).tolist())
    lines.add_line(start, end, w.YELLOW, 2.0)
    words = f"{drawn.length_um(viewing.line):.2f} µm"
    try:
        found = drawn.profile(viewing.line)
    except StereotomeError:
        found = None
    corner = imgui.ImVec2(at[0] + w.em(0.5).x, at[1] + w.em(2.4).x)
    if found is not None and np.isfinite(found.height).any():
        heights = found.height[np.isfinite(found.height)]
        words += f", height {heights.min():.2f} … {heights.max():.2f} µm, end to end {heights[-1] - heights[0]:+.2f}"
        _profile(lines, found.height, imgui.ImVec2(corner.x, corner.y + w.em(1.6).x))
    w.over_picture(lines, corner, words, w.YELLOW)
    console.measured = words


def _profile(lines: imgui.ImDrawList, heights: NDArray[np.float64], corner: imgui.ImVec2) -> None:
    """Draw heights along a line, with gaps where none was found."""
    end = imgui.ImVec2(corner.x + w.em(18).x, corner.y + w.em(5).x)
    lines.add_rect_filled(corner, end, w.SHADE)
    w.curve(lines, heights, corner, end)


def _kind(console: Console) -> None:
    """Draw what chooses the kind of picture, its stereo and its colours, and where it is seen from."""
    viewing = console.viewing
    viewing.kind(w.choice("##kind", viewing.shown.modes, viewing.shown.mode, 8))
    imgui.same_line()
    stereo = STEREO_KINDS[STEREO_KINDS.index(w.choice("##stereo", STEREO_KINDS, _stereo(console), 9))]
    _flip(console, stereo)
    viewing.eyes(mode=stereo)
    imgui.same_line()
    colours = w.choice("##colours", (OWN, *TABLES), viewing.colours or OWN, 7)
    viewing.colours = "" if colours == OWN else colours
    if stereo != "mono":
        imgui.set_next_item_width(w.em(7).x)
        _, angle = imgui.slider_float("° depth", viewing.shown.stereo.vergence_deg, 0.0, 20.0, "%.1f")
        imgui.same_line()
        _, swap = imgui.checkbox("swap eyes", viewing.shown.stereo.swap)
        viewing.eyes(depth_deg=angle, swap=swap)
    if viewing.flat:
        _line_fields(viewing)
    else:
        _sides(viewing)


def _sides(viewing: Viewing) -> None:
    """Draw from where it is seen, and from where it is lit."""
    view = viewing.shown.view
    imgui.set_next_item_width(w.em(10).x)
    _, side = imgui.slider_float2("turned", [view.azimuth_deg, view.elevation_deg], -180.0, 180.0, "%.0f°")
    viewing.turned(side[0], side[1])
    imgui.same_line()
    imgui.set_next_item_width(w.em(10).x)
    _, light = imgui.slider_float2("light", list(viewing.light), -90.0, 90.0, "%.0f°")
    viewing.light = (light[0], light[1])


def _line_fields(viewing: Viewing) -> None:
    """Draw the ends of the line that is measured, to be typed."""
    (x0, y0), (x1, y1) = viewing.line or ((0, 0), (0, 0))
    imgui.set_next_item_width(w.em(14).x)
    typed, ends = imgui.input_int4("line: x y, x y (drag, or L)", [x0, y0, x1, y1])
    if typed:
        viewing.line = ((ends[0], ends[1]), (ends[2], ends[3]))


def _stereo(console: Console) -> Mode:
    """Return how the eyes see it: no longer by glasses once these show something else, or nothing."""
    mode = console.viewing.shown.stereo.mode
    return "mono" if mode == PAGE_FLIP and console.flipping.shows != SHOWN_REVIEW else mode


def _flip(console: Console, stereo: Mode) -> None:
    """Let the shutter glasses follow what was chosen."""
    before = console.viewing.shown.stereo.mode
    if stereo == PAGE_FLIP != before:
        console.flipping.begin(SHOWN_REVIEW)
    elif before == PAGE_FLIP != stereo and console.flipping.shows == SHOWN_REVIEW:
        console.flipping.end()


def _opacity(viewing: Viewing, low: float, high: float) -> None:
    """Draw the points of opacity against value; they stay in order."""
    points = viewing.points or [(low, 0.0), (high, 0.1)]
    for k, (value, opacity) in enumerate(points):
        imgui.push_id(k)
        imgui.set_next_item_width(w.em(12).x)
        _, made = imgui.drag_float2("value, opacity", [value, opacity], 0.01, 0.0, high, "%.2f")
        points[k] = (float(made[0]), min(max(float(made[1]), 0.0), 1.0))
        imgui.pop_id()
    if imgui.small_button("one more"):
        points.append((high, points[-1][1]))
    imgui.same_line()
    if imgui.small_button("as usual"):
        viewing.points = []
        return
    rising = sorted(points)
    apart = all(b[0] > a[0] for a, b in pairwise(rising))
    viewing.points = rising if apart and rising != [(low, 0.0), (high, 0.1)] else viewing.points
