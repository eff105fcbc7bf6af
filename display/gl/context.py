"""An OpenGL context without a window, and what can be said about the driver behind it."""

from __future__ import annotations

import sys

import moderngl

from devices.errors import DisplayError

OLDEST = 330
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader", "basic render")


def offscreen() -> moderngl.Context:
    """Open a context that draws without window or screen.

    Raises
    ------
    DisplayError
        ``no-opengl``: no driver, or one too old.
    """
    backend = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    try:
        context = moderngl.create_context(standalone=True, require=OLDEST, **backend)  # type: ignore[arg-type]
    except Exception as error:  # noqa: BLE001  moderngl raises bare Exception
        raise DisplayError(
            "there is no OpenGL 3.3 on this machine; nothing can be drawn.",
            why=str(error).strip(),
            fix="on Debian: sudo apt install --no-install-recommends libegl1 libgl1 libgl1-mesa-dri",
            code="no-opengl",
        ) from None
    context.gc_mode = "context_gc"  # what Python drops is freed in `Renderer.end_frame`, in its own context
    return context


def is_software(context: moderngl.Context) -> bool:
    """Tell whether the processor draws, so that work per voxel is better done without OpenGL."""
    return any(name in context.info["GL_RENDERER"].lower() for name in SOFTWARE)


def check(context: moderngl.Context, doing: str) -> None:
    """Raise `DisplayError` (``opengl``) if OpenGL's error flag is up."""
    error = context.error
    if error == "GL_OUT_OF_MEMORY":
        raise DisplayError(
            f"the graphics memory is full after {doing}.", fix="make the picture or the volume smaller.", code="opengl"
        )
    if error == "GL_CONTEXT_LOST" or error == "GL_UNKNOWN_ERROR":  # moderngl does not know the name of the first
        raise DisplayError(
            f"the graphics driver gave up after {doing}.",
            why="it was reset, or the graphics card went to sleep; data and runs are not touched.",
            fix="open the window again.",
            code="opengl",
        )
    if error != "GL_NO_ERROR":
        raise DisplayError(f"OpenGL reports {error} after {doing}.", fix="report it as a bug.", code="opengl")


def make_current(context: moderngl.Context) -> None:
    """Draw with this context from now on; another one may have been the thread's current one."""
    context.__enter__()  # type: ignore[no-untyped-call]
