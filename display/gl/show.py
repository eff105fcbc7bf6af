"""Finished pictures in a window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import moderngl

from devices.errors import DisplayError
from display.gl.context import OLDEST, check

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from display.gl.canvas import Canvas


def window_context() -> moderngl.Context:
    """Return the context of the window that was opened last.

    Raises
    ------
    DisplayError
        ``no-opengl``: it is too old.
    """
    try:
        context = moderngl.create_context(require=OLDEST)
    except Exception as error:  # noqa: BLE001  moderngl raises bare Exception
        raise DisplayError("the window has no OpenGL 3.3.", why=str(error).strip(), code="no-opengl") from None
    context.gc_mode = "context_gc"
    return context


def show(canvas: Canvas, picture: NDArray[np.uint8], size: tuple[int, int]) -> None:
    """Draw a picture of sRGB levels into the window, as large as fits."""
    screen: Any = canvas.context.detect_framebuffer(0)
    screen.use()
    canvas.context.viewport = (0, 0, *size)
    textures = {"picture": canvas.picture(picture)}
    canvas.fill("picture.frag.glsl", uniforms={"window": tuple(map(float, size))}, textures=textures)
    check(canvas.context, "showing a picture")
    canvas.context.gc()
