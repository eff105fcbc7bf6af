"""Where pairs are flipped: a window on a display, or no window and a clock in the display's place."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any, Literal

import glfw as typed_glfw

from devices.errors import DisplayError
from display.gl.flip_painter import BACK, BACK_LEFT, BACK_RIGHT, FlipPainter, has_right_half

if TYPE_CHECKING:
    from devices.protocols import Clock
    from display.mailbox import Mailbox
    from display.pacing import Turn
    from display.sync_codes import Code

glfw: Any = typed_glfw  # its own type hints are wrong in several places

Key = Literal["swap", "later", "sooner", "longer", "shorter"]
KEYS: dict[int, Key] = {
    glfw.KEY_S: "swap",
    glfw.KEY_UP: "later",
    glfw.KEY_DOWN: "sooner",
    glfw.KEY_RIGHT: "longer",
    glfw.KEY_LEFT: "shorter",
}


class ClockedScreen:
    """Pictures without a window, flipped by a clock: for machines without a display, never for eyes.

    Parameters
    ----------
    mailbox : Mailbox
        Where pairs come from.
    clock : Clock
        In the place of the display.
    refresh_hz : float
        How often.
    """

    keys: tuple[Key, ...] = ()
    quad_buffered = False
    closed = False
    unplugged = False

    def __init__(self, mailbox: Mailbox, clock: Clock, refresh_hz: float, code: Code = "none") -> None:
        self.refresh_hz = refresh_hz
        self._clock = clock
        self._next_s = clock.now()
        self._size = mailbox.size
        self._painter = FlipPainter(mailbox, code, windowed=False)

    def draw(self, turn: Turn | None) -> None:
        """As `display.presenter.Screen`."""
        self._painter.take_newest()
        self._painter.paint(turn, self._size)
        self._painter.finish()

    def swap(self) -> None:
        """Wait for the clock's next refresh."""
        behind = (self._clock.now() - self._next_s) * self.refresh_hz
        self._next_s += max(int(behind) + 1, 1) / self.refresh_hz
        self._clock.sleep(self._next_s - self._clock.now())

    def pixels(self) -> bytes:
        """Return what was drawn last, RGB, the lowest row first."""
        return self._painter.pixels()

    def close(self) -> None:
        """Give the context back."""
        self._painter.close()


class FlipWindow:
    """A window that flips at the display's own beat.

    Parameters
    ----------
    mailbox : Mailbox
        Where pairs come from.
    code : str
        Sync code.
    windowed : bool
        A window instead of the whole display; a compositor may then hold pictures back.

    Attributes
    ----------
    quad_buffered : bool
        Whether the driver itself flips pairs; then both are drawn at each swap and no turns are needed.
    """

    def __init__(self, mailbox: Mailbox, code: Code = "none", *, windowed: bool = False) -> None:
        _start()
        monitor = glfw.get_primary_monitor()
        if not monitor:
            raise DisplayError("no display is plugged in.", fix="plug one in and switch it on.", code="no-display")
        mode = glfw.get_video_mode(monitor)
        self._monitor = None if windowed else _address(monitor)
        self.refresh_hz = float(mode.refresh_rate)
        self._window, self.quad_buffered = _opened(
            mailbox.size if windowed else mode.size, None if windowed else monitor
        )
        glfw.swap_interval(1)
        glfw.set_key_callback(self._window, self._pressed)
        self._pending: list[Key] = []
        self._painter = FlipPainter(mailbox, code, windowed=True)
        self._draw_buffer = _draw_buffer() if self.quad_buffered else None

    @property
    def closed(self) -> bool:
        """Whether the person has closed the window, or its display is gone."""
        return bool(glfw.window_should_close(self._window)) or self.unplugged

    @property
    def unplugged(self) -> bool:
        """Whether the display is gone; a window would be moved to another one, whose refreshes are not counted."""
        left = [_address(monitor) for monitor in glfw.get_monitors()]
        return not left or (self._monitor is not None and self._monitor not in left)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Return the keys pressed since the last call."""
        pressed, self._pending = tuple(self._pending), []
        return pressed

    def draw(self, turn: Turn | None) -> None:
        """As `display.presenter.Screen`."""
        self._painter.take_newest()
        self._painter.paint(turn, self._size)
        self._painter.finish()

    def draw_both(self, left: Turn, right: Turn) -> None:
        """Draw a pair into the two halves of a quad buffer."""
        assert self._draw_buffer is not None
        self._painter.take_newest()
        for half, turn in ((BACK_LEFT, left), (BACK_RIGHT, right)):
            self._draw_buffer(half)
            self._painter.paint(turn, self._size)
        self._draw_buffer(BACK)
        self._painter.finish()

    def swap(self) -> None:
        """Swap, and wait until the driver has done so: what it would queue would be seen at nobody knows which turn."""
        glfw.swap_buffers(self._window)
        self._painter.finish()
        glfw.poll_events()

    def close(self) -> None:
        """Close the window."""
        glfw.destroy_window(self._window)
        glfw.terminate()

    @property
    def _size(self) -> tuple[int, int]:
        width, height = glfw.get_framebuffer_size(self._window)
        return max(width, 1), max(height, 1)

    def _pressed(self, window: Any, key: int, _scancode: int, action: int, _mods: int) -> None:
        if action == glfw.RELEASE:
            return
        if key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(window, True)  # noqa: FBT003  GLFW's own signature
        elif key in KEYS:
            self._pending.append(KEYS[key])


def _address(monitor: Any) -> int | None:
    """Return what tells monitors apart."""
    return ctypes.cast(monitor, ctypes.c_void_p).value


def _start() -> None:
    said: list[str] = []
    glfw.set_error_callback(lambda _code, words: said.append(words.decode("utf-8", "replace")))
    if not glfw.init():
        raise DisplayError(
            "no window can be opened here.",
            why=said[-1] if said else "GLFW does not start.",
            fix=(
                "log in at the display, or name it: DISPLAY=:0",
                "try the glasses without pictures: stereotome glasses test",
                "make pictures in files: stereotome render … -o PICTURE.png",
            ),
            code="no-display",
        )


def _opened(size: Any, monitor: Any) -> tuple[Any, bool]:
    """Open a window with a quad buffer where the driver has one, else without; say which."""
    glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
    glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
    glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
    for stereo in (True, False):
        glfw.window_hint(glfw.STEREO, stereo)
        window = glfw.create_window(*size, "Stereotome", monitor, None)
        if window:
            glfw.make_context_current(window)
            return window, stereo and has_right_half(_draw_buffer())
    glfw.terminate()
    raise DisplayError(
        "the display's driver has no OpenGL 3.3.", fix="install the driver of the graphics card.", code="no-opengl"
    )


def _draw_buffer() -> Any:
    """Return glDrawBuffer, which moderngl leaves out."""
    return ctypes.CFUNCTYPE(None, ctypes.c_uint)(glfw.get_proc_address("glDrawBuffer"))
