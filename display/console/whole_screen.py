"""The window over the whole screen it stands on, and back. GLFW is loaded late: after ``imgui_bundle``."""

from __future__ import annotations

from typing import Any

Place = tuple[int, int, int, int]  # left, top, width, height


class WholeScreen:
    """Whether the window fills its screen, and where it was before."""

    def __init__(self) -> None:
        self._before: Place | None = None

    def follow(self, *, wanted: bool) -> None:
        """Make the window as it is wanted, in the thread that draws it."""
        if wanted == (self._before is not None):
            return
        import glfw as typed_glfw  # noqa: PLC0415

        glfw: Any = typed_glfw  # its own type hints are wrong in several places
        window = glfw.get_current_context()
        if self._before is not None:
            glfw.set_window_monitor(window, None, *self._before, 0)
            self._before = None
            return
        place = self._before = (*glfw.get_window_pos(window), *glfw.get_window_size(window))
        screen = max(glfw.get_monitors(), key=lambda monitor: shared(place, _place(glfw, monitor)))
        mode = glfw.get_video_mode(screen)
        glfw.set_window_monitor(window, screen, 0, 0, mode.size.width, mode.size.height, mode.refresh_rate)


def shared(one: Place, other: Place) -> int:
    """Return the area two rectangles have in common."""
    sides = (min(one[k] + one[k + 2], other[k] + other[k + 2]) - max(one[k], other[k]) for k in range(2))
    width, height = (max(side, 0) for side in sides)
    return width * height


def _place(glfw: Any, monitor: Any) -> Place:
    mode = glfw.get_video_mode(monitor)
    return (*glfw.get_monitor_pos(monitor), mode.size.width, mode.size.height)
