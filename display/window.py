"""A window with keys, mouse and wheel; the only module that opens one for `stereotome view`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import glfw as typed_glfw

from devices.errors import DisplayError

if TYPE_CHECKING:
    from display.controls import Button

glfw: Any = typed_glfw  # its own type hints are wrong in several places

NAMES = {
    glfw.KEY_SPACE: "space", glfw.KEY_RIGHT: "right", glfw.KEY_LEFT: "left", glfw.KEY_UP: "up", glfw.KEY_DOWN: "down",
    glfw.KEY_HOME: "home", glfw.KEY_END: "end", glfw.KEY_BACKSPACE: "backspace", glfw.KEY_ESCAPE: "escape",
    glfw.KEY_PERIOD: "period", glfw.KEY_COMMA: "comma",
    **{getattr(glfw, f"KEY_{letter}"): letter.lower() for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"},
}  # fmt: skip
BUTTONS: dict[int, Button] = {
    glfw.MOUSE_BUTTON_LEFT: "left",
    glfw.MOUSE_BUTTON_RIGHT: "right",
    glfw.MOUSE_BUTTON_MIDDLE: "middle",
}


@dataclass
class Happened:
    """What the user did since the last look."""

    keys: list[str] = field(default_factory=list)
    drags: list[tuple[float, float, Button]] = field(default_factory=list)
    wheel: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.keys or self.drags or self.wheel)


class Window:
    """A window with an OpenGL context that is current.

    Raises
    ------
    DisplayError
        ``no-display``: there is no screen, or it has no OpenGL 3.3.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        glfw.ERROR_REPORTING = "ignore"
        if not glfw.init():
            raise _no_display()
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        self._window = glfw.create_window(*size, title, None, None)
        if not self._window:
            glfw.terminate()
            raise _no_display()
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        self._held: dict[Button, bool] = {}
        self._at: tuple[float, float] | None = None
        self._happened = Happened()
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_mouse_button_callback(self._window, self._on_button)
        glfw.set_cursor_pos_callback(self._window, self._on_move)
        glfw.set_scroll_callback(self._window, self._on_wheel)

    @property
    def closed(self) -> bool:
        """Whether the user closed it."""
        return bool(glfw.window_should_close(self._window))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels; 0 while it is made an icon or resized to nothing."""
        width, height = glfw.get_framebuffer_size(self._window)
        return int(width), int(height)

    def wait(self, timeout_s: float) -> Happened:
        """Return what happened, waiting for it at most so long."""
        if timeout_s > 0:
            glfw.wait_events_timeout(timeout_s)
        else:
            glfw.poll_events()
        happened, self._happened = self._happened, Happened()
        return happened

    def swap(self) -> None:
        """Show what was drawn."""
        glfw.swap_buffers(self._window)

    def title(self, words: str) -> None:
        """Write into the title bar."""
        glfw.set_window_title(self._window, words)

    def close(self) -> None:
        """Close it and give the screen back."""
        glfw.destroy_window(self._window)
        glfw.terminate()

    def _on_key(self, _window: object, key: int, _scan: int, action: int, _mods: int) -> None:
        if action in {glfw.PRESS, glfw.REPEAT} and key in NAMES:
            self._happened.keys.append(NAMES[key])

    def _on_button(self, _window: object, button: int, action: int, _mods: int) -> None:
        if button in BUTTONS:
            self._held[BUTTONS[button]] = action == glfw.PRESS

    def _on_move(self, _window: object, x: float, y: float) -> None:
        before, self._at = self._at, (x, y)
        held = [button for button, down in self._held.items() if down]
        if before is not None and held:
            self._happened.drags.append((x - before[0], y - before[1], held[0]))

    def _on_wheel(self, _window: object, _x: float, y: float) -> None:
        self._happened.wheel += y


def _no_display() -> DisplayError:
    return DisplayError(
        "there is no display on which a window can be opened.",
        why="glfw found no screen, or one without OpenGL 3.3.",
        fix=("make pictures without a window: stereotome render DATA -o x.png", "over ssh: ssh -X"),
        code="no-display",
    )
