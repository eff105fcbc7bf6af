"""A finished run, looked at again in any kind of picture and stereo, measured and saved."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from imgui_bundle import imgui

from devices.errors import StereotomeError
from display import controls
from display.console.contrast import TABLES
from display.console.flipping import REVIEW
from display.console.panels import widgets as w
from display.console.review import FLAT, PAGE_FLIP, RESULTS, Film, Reviewer, Wish, first_shown
from display.controls import STEREOS
from display.gl.live_picture import StillPicture
from display.movie import SWEEPS
from display.scene import Light

if TYPE_CHECKING:
    from display.console.model import Console
    from display.console.review import Drawn, Line
    from display.gl.canvas import Canvas
    from display.movie import Sweep
    from display.stereo import Mode

YELLOW = 0xFF30D0FF
SHADE = 0xC0000000
STILL_S = 0.3
BUTTONS: tuple[tuple[imgui.MouseButton_, Literal["left", "right", "middle"]], ...] = (
    (imgui.MouseButton_.left, "left"),
    (imgui.MouseButton_.right, "right"),
    (imgui.MouseButton_.middle, "middle"),
)
OWN = "own colours"
FRAMES = 120
STEREO_KINDS: tuple[Mode, ...] = (STEREOS[0], PAGE_FLIP, *STEREOS[1:])


class ReviewPanel:
    """Holds what is shown; draws nothing itself but what the reviewer's thread made."""

    def __init__(self, canvas: Canvas, reviewer: Reviewer) -> None:
        self._picture = StillPicture(canvas)
        self.reviewer = reviewer
        self.folder = ""
        self.shown = first_shown()
        self.colours = ""
        self.points: list[tuple[float, float]] = []
        self.threshold: float | None = None
        self.light = (-35.0, 40.0)
        self.line: Line | None = None
        self._field = ""
        self.sweep: Sweep = "rotation"
        self.frames = FRAMES

    def draw(self, console: Console) -> None:
        """Draw the panel."""
        self._source(console)
        if not self.folder:
            w.words("Open the last run, or name a run's folder, a TIFF, a Zarr ...", w.GREY)
            return
        self._kind(console)
        if self.shown.mode not in FLAT:
            self._depth()
        self._show(console)

    def _source(self, console: Console) -> None:
        run = console.run
        if (
            w.button("Last run", "" if run is not None and not console.running else "there is none yet")
            and run is not None
        ):
            self._open(run.folder)
        imgui.same_line()
        self._field = w.text_field("##folder", self._field, 14)
        imgui.same_line()
        if w.button("Open", "" if self._field else "name a folder or a file"):
            self._open(self._field)
        imgui.same_line()
        if w.button("Save picture", "" if self.reviewer.drawn is not None else "there is no picture"):
            self._save(console)
        self._movie(console)

    def _movie(self, console: Console) -> None:
        """Draw what makes a movie of what is shown."""
        drawn, filming = self.reviewer.drawn, self.reviewer.filming
        imgui.same_line()
        why_not = filming or ("" if drawn is not None else "there is no picture")
        why_not = why_not or ("a flat picture stays as it is" if self.shown.mode in FLAT[:2] else "")
        if w.button("Movie", why_not, f"{self.frames} pictures as MP4: {self.sweep}") and drawn is not None:
            self.reviewer.film(Film(drawn.wish, self.sweep, self.frames, self._free(console, ".mp4")))
        imgui.same_line()
        self.sweep = SWEEPS[SWEEPS.index(w.choice("##sweep", SWEEPS, self.sweep, 6))]  # type: ignore[assignment]
        if filming:
            w.words(filming, w.BLUE)

    def _free(self, console: Console, suffix: str) -> Path:
        """Return a file that does not exist, named after what is shown."""
        folder = Path(console.settings.snapshots)
        folder.mkdir(parents=True, exist_ok=True)
        name = f"{Path(self.folder).name}-{self.shown.mode.replace(' ', '-')}-{self.shown.stereo.mode}"
        free = (folder / f"{name}{f'-{n}' if n else ''}{suffix}" for n in range(10_000))
        return next(path for path in free if not path.exists())

    def _open(self, folder: str) -> None:
        self.folder = self._field = folder
        self.line, self.points, self.threshold = None, [], None
        if self.shown.mode in FLAT and not (Path(folder) / RESULTS / "range.tif").exists():
            self.shown = replace(self.shown, mode="orthogonal")

    def _save(self, console: Console) -> None:
        try:
            self.reviewer.save(self._free(console, ".png"))
        except OSError as error:
            console.journal.add("error", "review", f"not saved: {error}")

    def _kind(self, console: Console) -> None:
        shown = self.shown
        mode = w.choice("##kind", shown.modes, shown.mode, 8)
        imgui.same_line()
        stereo = STEREO_KINDS[STEREO_KINDS.index(w.choice("##stereo", STEREO_KINDS, self._stereo(console), 9))]
        self._flip(console, stereo)
        imgui.same_line()
        self.colours = w.choice("##colours", (OWN, *TABLES), self.colours or OWN, 7)
        self.colours = "" if self.colours == OWN else self.colours
        self.line = self.line if mode == shown.mode else None
        self.shown = replace(shown, mode=mode, stereo=replace(shown.stereo, mode=stereo))
        if stereo != "mono":
            imgui.set_next_item_width(w.em(7).x)
            _, angle = imgui.slider_float("° depth", shown.stereo.vergence_deg, 0.0, 20.0, "%.1f")
            imgui.same_line()
            _, swap = imgui.checkbox("swap eyes", shown.stereo.swap)
            self.shown = replace(self.shown, stereo=replace(self.shown.stereo, vergence_deg=angle, swap=swap))
        if mode not in FLAT[:2]:
            imgui.set_next_item_width(w.em(10).x)
            _, light = imgui.slider_float2("light", list(self.light), -90.0, 90.0, "%.0f°")
            self.light = (light[0], light[1])

    def _stereo(self, console: Console) -> Mode:
        """Return how the eyes see it: no longer by glasses once these show something else, or nothing."""
        mode = self.shown.stereo.mode
        return "mono" if mode == PAGE_FLIP and console.flipping.shows != REVIEW else mode

    def _flip(self, console: Console, stereo: Mode) -> None:
        """Let the shutter glasses follow what was chosen."""
        before = self.shown.stereo.mode
        if stereo == PAGE_FLIP != before:
            console.flipping.begin(REVIEW)
        elif before == PAGE_FLIP != stereo and console.flipping.shows == REVIEW:
            console.flipping.end()

    def _depth(self) -> None:
        """Draw what belongs to volumes: the plane in the middle, the threshold of a surface, opacities."""
        self.shown = controls.grown(self.shown, self.reviewer.planes)
        if self.shown.mode in controls.PLANES:
            imgui.set_next_item_width(w.em(10).x)
            _, plane = imgui.slider_int("plane", round(self.shown.plane), 0, max(self.shown.planes - 1, 0))
            self.shown = replace(self.shown, plane=float(plane))
            return
        low, high = self.reviewer.limits
        imgui.set_next_item_width(w.em(10).x)
        value = (low + high) / 2 if self.threshold is None else self.threshold
        changed, value = imgui.slider_float("threshold", value, low, high, "%.0f")
        self.threshold = value if changed else self.threshold
        if imgui.tree_node("opacity"):
            self._opacity(low, high)
            imgui.tree_pop()

    def _opacity(self, low: float, high: float) -> None:
        """Draw the points of opacity against value; they stay in order."""
        points = self.points or [(low, 0.0), (high, 0.1)]
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
            self.points = []
            return
        rising = sorted(points)
        apart = all(b[0] > a[0] for a, b in pairwise(rising))
        self.points = rising if apart and rising != [(low, 0.0), (high, 0.1)] else self.points

    def _show(self, console: Console) -> None:
        room = imgui.get_content_region_avail()
        size = (int(room.x), int(room.y))
        if min(size) < 32:
            return
        at = imgui.get_cursor_screen_pos()
        self.reviewer.wish(self._wish(size))
        drawn = self.reviewer.drawn
        if self.reviewer.problem or drawn is None:
            w.words(self.reviewer.problem or "reading ...", w.ORANGE if self.reviewer.problem else w.GREY)
            return
        self._picture.draw(drawn.picture, size=size)
        imgui.image(imgui.ImTextureRef(self._picture.name), room)
        imgui.set_cursor_screen_pos(at)
        imgui.invisible_button("drawn", room)
        if imgui.is_item_hovered() or imgui.is_item_active():
            self._hands(drawn, (at.x, at.y))
        self._measured(console, drawn, (at.x, at.y))

    def _wish(self, size: tuple[int, int]) -> Wish:
        light = Light(azimuth_deg=self.light[0], elevation_deg=self.light[1])
        return Wish(self.folder, self.shown, size, self.colours, tuple(self.points), self.threshold, light)

    def _hands(self, drawn: Drawn, at: tuple[float, float]) -> None:
        """Let the mouse turn, move and enlarge; in flat pictures the left button draws a line."""
        io = imgui.get_io()
        if io.mouse_wheel:
            self.shown = controls.wheel(self.shown, io.mouse_wheel)
        place = (int(io.mouse_pos.x - at[0]), int(io.mouse_pos.y - at[1]))
        if self.shown.mode in FLAT[:2] and imgui.is_mouse_down(imgui.MouseButton_.left):
            start = place if imgui.is_mouse_clicked(imgui.MouseButton_.left) or self.line is None else self.line[0]
            self.line = (start, place)
            return
        for which, name in BUTTONS:
            if imgui.is_mouse_dragging(which):
                self.shown = controls.drag(self.shown, io.mouse_delta.x, io.mouse_delta.y, name, drawn.pixel_um)

    def _measured(self, console: Console, drawn: Drawn, at: tuple[float, float]) -> None:
        """Draw the line with its length in µm, and, over a range image, the heights along it."""
        if self.line is None or self.line[0] == self.line[1] or drawn.wish.shown.mode not in FLAT[:2]:
            return
        lines = imgui.get_window_draw_list()
        start, end = (imgui.ImVec2(at[0] + x, at[1] + y) for x, y in self.line)
        lines.add_line(start, end, YELLOW, 2.0)
        words = f"{drawn.length_um(self.line):.2f} µm"
        try:
            found = drawn.profile(self.line)
        except StereotomeError:
            found = None
        if found is not None and np.isfinite(found.height).any():
            heights = found.height[np.isfinite(found.height)]
            words += (
                f", height {heights.min():.2f} … {heights.max():.2f} µm, end to end {heights[-1] - heights[0]:+.2f}"
            )
            size = imgui.ImVec2(min(w.em(18).x, float(drawn.wish.size[0])), w.em(5).x)
            imgui.set_cursor_screen_pos(imgui.ImVec2(at[0] + 4, at[1] + w.em(4).x))
            imgui.plot_lines("##profile", heights.astype(np.float32), graph_size=size)
        corner = imgui.ImVec2(at[0] + w.em(0.5).x, at[1] + w.em(2.4).x)
        size = imgui.calc_text_size(words)
        lines.add_rect_filled(corner, imgui.ImVec2(corner.x + size.x, corner.y + size.y), SHADE)
        lines.add_text(corner, YELLOW, words)
        console.measured = words
