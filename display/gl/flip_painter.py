"""Draws one eye's view of the newest pair, and its sync code, into whatever is bound. Nothing else happens per flip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import moderngl

from display.gl.context import offscreen
from display.sync_codes import marks

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.glasses_timing import Eye
    from display.mailbox import Mailbox
    from display.pacing import Turn
    from display.sync_codes import Code

    Size = tuple[int, int]

VERTEX = """
#version 330 core
out vec2 place;
void main() {
    place = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(place * 2.0 - 1.0, 0.0, 1.0);
}
"""
FRAGMENT = """
#version 330 core
uniform sampler2D view;
in vec2 place;
out vec4 colour;
void main() { colour = vec4(texture(view, vec2(place.x, 1.0 - place.y)).rgb, 1.0); }
"""
BACK_LEFT, BACK_RIGHT, BACK = 0x0402, 0x0403, 0x0405
TRIES = 3  # at a pair that is overtaken while it is sent to the driver


class FlipPainter:
    """Holds the newest pair as two textures.

    Parameters
    ----------
    mailbox : Mailbox
        Where pairs come from.
    code : str
        Which sync code is drawn; see `display.sync_codes`.
    windowed : bool
        Draw into the window whose context is current in this thread; else into a picture as large as a view.
    """

    def __init__(self, mailbox: Mailbox, code: Code = "none", *, windowed: bool) -> None:
        context = self._context = moderngl.create_context() if windowed else offscreen()
        self._target = context.screen if windowed else context.simple_framebuffer(mailbox.size)
        self._mailbox = mailbox
        self._code = code
        self._taken = 0
        program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        self._corners = context.vertex_array(program, [])
        self._views: dict[Eye, moderngl.Texture] = {
            "left": context.texture(mailbox.size, 3, alignment=1),
            "right": context.texture(mailbox.size, 3, alignment=1),
        }
        for view in self._views.values():
            view.repeat_x = view.repeat_y = False
            view.filter = (moderngl.LINEAR, moderngl.LINEAR)

    def take_newest(self) -> None:
        """Send the newest pair to the driver, unless it is there; one that was overtaken is not kept."""
        for _ in range(TRIES):
            pairs = self._mailbox.pairs
            if pairs == self._taken:
                return
            with self._mailbox.newest() as pair:
                if pair is not None:
                    self._views["left"].write(pair[0])
                    self._views["right"].write(pair[1])
                    self._taken = pairs if self._mailbox.intact else 0

    def paint(self, turn: Turn | None, size: Size) -> None:
        """Draw the view of the turn's eye as large as it fits, and its sync code; None: darkness."""
        target = self._target
        target.use()
        target.viewport = (0, 0, *size)
        target.clear()
        if turn is None:
            return
        if self._taken:
            target.viewport = fitted(self._mailbox.size, size)
            self._views[turn.eye].use(0)
            self._corners.render(moderngl.TRIANGLES, vertices=3)
        for mark in marks(self._code, turn.eye, turn.number, size):
            upwards = size[1] - mark.y - mark.height
            target.clear(*mark.colour, 1.0, viewport=(mark.x, upwards, mark.width, mark.height))

    def finish(self) -> None:
        """Wait until everything is drawn, and swapped in where that was asked for."""
        self._context.finish()

    def pixels(self) -> bytes:
        """Return what was drawn last, RGB, the lowest row first."""
        return bytes(self._target.read(alignment=1))

    def close(self) -> None:
        """Give the context back."""
        self._context.release()


def has_right_half(draw_buffer: Callable[[int], None]) -> bool:
    """Tell whether the current window has a half for the right eye: some drivers take the hint and leave it at that."""
    context = moderngl.create_context()
    draw_buffer(BACK_RIGHT)
    able: bool = context.error == "GL_NO_ERROR"
    draw_buffer(BACK)
    return able


def fitted(inner: Size, outer: Size) -> tuple[int, int, int, int]:
    """Return x, y, width and height of the largest picture of that shape in the middle of another."""
    scale = min(outer[0] / inner[0], outer[1] / inner[1])
    width, height = max(round(inner[0] * scale), 1), max(round(inner[1] * scale), 1)
    return (outer[0] - width) // 2, (outer[1] - height) // 2, width, height
