"""The console's window: Hello ImGui owns it, ModernGL draws into it, panels fill it. Nothing here waits."""

from __future__ import annotations

import logging
import time
import traceback
from functools import partial
from typing import TYPE_CHECKING, Any

from imgui_bundle import hello_imgui, imgui, immapp

from acquire.state import FINAL
from acquire.words import took
from devices.errors import DisplayError
from display.console.keys import BINDINGS
from display.console.panels import (
    camera,
    files,
    floating,
    glasses,
    live,
    log,
    monitor,
    review,
    sections,
    session,
    stack,
    stage,
)
from display.console.panels import widgets as w
from display.console.review import Reviewer
from display.console.thrift import FULL_HZ, Thrift
from display.console.whole_screen import WholeScreen
from display.gl.canvas import Canvas
from display.gl.show import window_context

if TYPE_CHECKING:
    from collections.abc import Callable

    from display.console.keys import Binding
    from display.console.model import Console

logger = logging.getLogger(__name__)
TITLE = "Stereotome"
SIZE = (1280, 720)
IDLE_HZ = 1.0  # an event, news from the instrument or a frame is drawn at once
LAYOUT = "console-4"
SOLID = (
    imgui.Col_.window_bg,
    imgui.Col_.popup_bg,
    imgui.Col_.title_bg,
    imgui.Col_.title_bg_active,
    imgui.Col_.title_bg_collapsed,
)


class ConsoleWindow:
    """The window around a console.

    Parameters
    ----------
    scale : float, optional
        How large everything is, where the system does not tell it right.
    remembers : bool
        Keep the places of panels between two starts.
    """

    def __init__(self, console: Console, *, scale: float | None = None, remembers: bool = True) -> None:
        self.console = console
        self.canvas: Canvas | None = None
        self.review: review.ReviewPanel | None = None
        self._failed: set[str] = set()
        self._idles = False
        self._thrift = Thrift(time.process_time)
        self._screen = WholeScreen()
        self._chords = [_chord(binding) for binding in BINDINGS if binding.key != "escape"]
        self._reviewer = Reviewer(console.journal, console.flipping)
        self._draws: dict[str, Callable[[Console], None]] = {
            "Stage": stage.draw,
            "Camera": camera.draw,
            "Stack": stack.draw,
            "Sections": sections.draw,
            "Session": session.SessionPanel().draw,
            "Files": files.draw,
            "Glasses": glasses.draw,
            "Log": log.LogPanel().draw,
        }
        self.params = self.make_params(scale, remembers=remembers)

    def run(self) -> None:
        """Show it until it is closed.

        Raises
        ------
        DisplayError
            ``no-display``: there is no screen; ``no-opengl``: it has no OpenGL 3.3.
        """
        try:
            immapp.run(self.params)
        except RuntimeError as cause:
            raise not_opened(str(cause)) from None
        finally:
            self.close()

    def close(self) -> None:
        """End what draws beside the window."""
        self.console.bench.wake = self.console.eyes.wake = lambda: None
        self._reviewer.close()

    def make_params(self, scale: float | None, *, remembers: bool) -> hello_imgui.RunnerParams:
        """Return how the window is to be."""
        params = hello_imgui.RunnerParams()
        params.app_window_params.window_title = TITLE
        params.app_window_params.window_geometry.size = SIZE
        params.app_window_params.restore_previous_geometry = remembers
        params.renderer_backend_options.open_gl_options = hello_imgui.OpenGlOptions(
            glsl_version="330", major_version=3, minor_version=3, use_core_profile=True, anti_aliasing_samples=0
        )
        params.fps_idling.fps_max = FULL_HZ
        params.fps_idling.vsync_to_monitor = False  # the stereo presenter is the one who owns the refresh
        params.fps_idling.time_active_after_last_event = 0.5
        params.ini_disable = not remembers
        params.ini_folder_type = hello_imgui.IniFolderType.app_user_config_folder
        params.ini_filename = "stereotome/console.ini"
        if scale is not None:
            params.dpi_aware_params.dpi_window_size_factor = scale
        self._frame(params.imgui_window_params)
        self._callbacks(params.callbacks)
        params.docking_params = self._docking()
        return params

    def _frame(self, window: hello_imgui.ImGuiWindowParams) -> None:
        window.default_imgui_window_type = hello_imgui.DefaultImGuiWindowType.provide_full_screen_dock_space
        window.enable_viewports = False  # more windows would be more OpenGL contexts
        window.show_menu_bar = True
        window.show_menu_app = False
        window.show_menu_view = True
        window.show_menu_view_themes = False
        window.show_status_bar = True
        window.show_status_fps = False
        window.tweaked_theme.theme = hello_imgui.ImGuiTheme_.darcula_darker

    def _callbacks(self, callbacks: hello_imgui.RunnerCallbacks) -> None:
        callbacks.post_init = self._attach
        callbacks.setup_imgui_config = _configure
        callbacks.setup_imgui_style = _opaque
        callbacks.show_menus = partial(self.guarded, "menu", self._menu)
        callbacks.show_status = partial(self.guarded, "status", self._status)
        callbacks.show_gui = partial(self.guarded, "console", self._every_frame)

    def _docking(self) -> hello_imgui.DockingParams:
        split = hello_imgui.DockingSplit
        docking = hello_imgui.DockingParams()
        docking.layout_name = LAYOUT
        docking.docking_splits = [
            split("MainDockSpace", "Left", imgui.Dir.left, 0.25),
            split("MainDockSpace", "Right", imgui.Dir.right, 0.33),
            split("MainDockSpace", "Below", imgui.Dir.down, 0.22),
            split("Left", "LeftBelow", imgui.Dir.down, 0.58),
        ]
        places = {
            "Stage": "Left",
            "Camera": "LeftBelow",
            "Stack": "Right",
            "Sections": "Right",
            "Session": "Right",
            "Glasses": "Right",
            "Files": "Right",
            "Live": "MainDockSpace",
            "Review": "MainDockSpace",
            "Monitor": "MainDockSpace",
            "Log": "Below",
        }
        docking.dockable_windows = [self._dockable(name, place) for name, place in places.items()]
        return docking

    def _dockable(self, name: str, place: str) -> hello_imgui.DockableWindow:
        return hello_imgui.DockableWindow(
            name, place, partial(self.guarded, name, lambda _: self._draws[name](self.console)), can_be_closed_=False
        )

    def _attach(self) -> None:
        """Draw with ModernGL in the window's own context; be woken by what the instrument tells, and by each frame."""
        import glfw  # noqa: PLC0415  after imgui_bundle, which names the library that both use

        self.console.bench.wake = self.console.eyes.wake = lambda: glfw.post_empty_event() if self._idles else None
        self.canvas = Canvas(window_context())
        self.review = review.ReviewPanel(self.canvas, self._reviewer)
        self._draws["Review"] = self.review.draw
        self._draws["Monitor"] = monitor.MonitorPanel(self.canvas).draw
        self._draws["Live"] = live.LivePanel(self.canvas).draw

    def guarded(self, name: str, draw: Callable[[Console], None]) -> None:
        """Draw a part; what it raises is told once, and the window lives."""
        try:
            draw(self.console)
        except Exception as bug:
            words = f"{type(bug).__name__}: {bug}"
            if words not in self._failed:
                self._failed.add(words)
                logger.exception("the panel %s failed", name)
                self.console.journal.add("error", name, f"[bug] {words} {traceback.format_exc(limit=-1)}")

    def _every_frame(self, console: Console) -> None:
        """Take keys, do what is due, and draw what floats."""
        self._keys(console)
        console.in_front = not imgui.get_io().app_focus_lost
        console.tick()
        self._idles = not console.running  # in a run it comes round by itself: more pictures would slow it
        self.params.fps_idling.fps_idle = self._least_hz(console)
        if console.front:
            _to_the_front(console.front)
            console.front = ""
        self._screen.follow(wanted=console.full_screen)
        floating.draw(console)

    def _least_hz(self, console: Console) -> float:
        """Return how often to draw while nothing wakes the window; in a run no more frames are looked at than drawn."""
        thrifty_hz = self._thrift.rate_hz()
        console.eyes.rest_s = 1 / thrifty_hz if console.running else 0.0
        if console.running:
            return thrifty_hz
        return FULL_HZ if console.stick.device is not None else IDLE_HZ

    def _keys(self, console: Console) -> None:
        """Take keys; STOP is read raw, since a routed key is kept by a field that is being edited."""
        if imgui.is_key_pressed(imgui.Key.escape, False):  # noqa: FBT003  the library's
            console.stop()
        for chord, flags, do in self._chords:
            if imgui.shortcut(chord, flags):
                do(console)

    def _menu(self, console: Console) -> None:
        """Draw STOP, its release, and how the run stands, where nothing can clip them."""
        with w.coloured(w.RED):
            if imgui.button("STOP (Esc)"):
                console.stop()
        if console.stopped:
            imgui.text_colored(w.ORANGE, "STOPPED")
            if imgui.button("Release"):
                console.release_stop()
        run = console.run
        if console.running and run is not None:
            _progress(console, run)
        if unseen := len(console.alarms.unseen):
            with w.coloured(w.BROWN):
                if imgui.button(f"! {unseen} alarm{'s' if unseen > 1 else ''} (F2)"):
                    console.alarms_seen()
        if imgui.small_button("Keys (F1)"):
            console.shows_keys = not console.shows_keys

    def _status(self, console: Console) -> None:
        bench, state = console.bench, console.state
        name = bench.rig.name if bench.rig is not None else "no instrument"
        if not bench.connected:
            imgui.text_colored(w.ORANGE, f"{name}: not answering")
            return
        holder = state.holder if state is not None else ""
        imgui.text(f"{name} · {state.state if state is not None else ''} ·")
        imgui.same_line()
        if bench.commands:
            imgui.text("this console commands")
        elif imgui.small_button(f"{holder or 'nobody'} commands: take it when free"):
            bench.take_command()


def _chord(binding: Binding) -> tuple[int, int, Callable[[Console], None]]:
    """Return a key as the library takes it, how it is listened for, and what it does."""
    chord = int(getattr(imgui.Key, binding.key)) | (int(imgui.Key.mod_ctrl) if binding.ctrl else 0)
    flags = int(imgui.InputFlags_.route_global) | (int(imgui.InputFlags_.repeat) if binding.repeats else 0)
    return chord, flags, binding.do


def _to_the_front(panel: str) -> None:
    """Show a panel, and frame its first field, so that Tab has where to go on from."""
    imgui.set_window_focus(panel)
    imgui.internal.nav_init_window(imgui.internal.find_window_by_name(panel), True)  # noqa: FBT003  the library's
    imgui.set_nav_cursor_visible(True)


def not_opened(said: str) -> DisplayError:
    """Return the error of a window that was not opened: there is no screen, or no OpenGL on it."""
    if "glfwInit" in said:
        return DisplayError(
            "there is no display on which the console can be opened.",
            why="The window system does not answer, see the line above.",
            fix=("log in at the display, or name it: DISPLAY=:0", "work without a window: stereotome run RECIPE"),
            code="no-display",
        )
    return DisplayError(
        "the display has no OpenGL 3.3, which the console needs.",
        why=said.strip(),
        fix=(
            "install the driver of the graphics card",
            "a software one: sudo apt install libgl1 libgl1-mesa-dri",
        ),
        code="no-opengl",
    )


def _progress(console: Console, run: Any) -> None:
    left = "" if run.left_s is None else f" · {took(run.left_s)} left"
    section = f"section {run.section + 1}/{run.sections} · " if run.sections > 1 else ""
    colour = w.ORANGE if run.state in {"HOLD", "PAUSED"} else w.BLUE
    imgui.text_colored(colour, f"{run.state} · {section}{run.durable}/{run.planned} planes{left}")
    imgui.progress_bar(run.durable / max(run.planned, 1), w.em(8, 0), "")
    why_not = "" if console.bench.commands else "this console does not command"
    if run.state in FINAL:
        return
    if run.state == "PAUSED":
        if w.button("Resume##menu", why_not):
            console.resume()
    elif w.button("Pause##menu", why_not):
        console.pause()


def _configure() -> None:
    """Let an unfinished panel be mended instead of ending the program; pads do not click on widgets."""
    hello_imgui.imgui_default_settings.setup_default_imgui_config()
    io = imgui.get_io()
    io.config_error_recovery_enable_assert = False
    io.config_error_recovery_enable_tooltip = False
    io.config_flags |= imgui.ConfigFlags_.nav_enable_keyboard
    io.config_flags &= ~imgui.ConfigFlags_.nav_enable_gamepad


def _opaque() -> None:
    """Let nothing shine through what floats: words over a picture could not be read."""
    style = imgui.get_style()
    for which in SOLID:
        colour = style.color_(which)
        style.set_color_(which, imgui.ImVec4(colour.x, colour.y, colour.z, 1.0))
