"""Draws scenes: one eye at a time, to linear light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from display.gl.canvas import Canvas
from display.gl.context import check, make_current, offscreen
from display.modes import Legend, find_mode
from display.resolve import resolve

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    import moderngl
    from numpy.typing import NDArray

    from devices.glasses_timing import Eye
    from display.gl.canvas import Executor
    from display.resolve import Size
    from display.scene import Scene

    Light = NDArray[np.float32]


class Renderer:
    """Draws scenes with OpenGL; use it as a context manager, or `close` it.

    Parameters
    ----------
    context : moderngl.Context, optional
        Of a window; one without a window is opened when left out.
    executor : "gl" or "cpu", optional
        Where work per voxel is done; by the kind of driver when left out.

    Raises
    ------
    DisplayError
        ``no-opengl``: nothing can be drawn here.
    """

    def __init__(self, context: moderngl.Context | None = None, *, executor: Executor | None = None) -> None:
        self._own = context is None
        self.context = context or offscreen()
        self.canvas = Canvas(self.context, executor)
        self._targets: dict[tuple[Size, Eye | None], moderngl.Framebuffer] = {}

    def paint(self, scene: Scene, size: Size, eye: Eye | None = None) -> moderngl.Framebuffer:
        """Draw one eye's view and return the target with it: linear light, alpha 1, row 0 at the top.

        Raises
        ------
        DisplayError
            As `resolve`; ``opengl`` if the driver fails, ``shader`` if a shader does not compile.
        """
        drawings = resolve(scene, size, eye)
        make_current(self.context)
        self.canvas.notes = ()
        target = self._target(size, eye)
        target.use()
        target.clear(*scene.background, 1.0)
        for drawing in drawings:
            find_mode(drawing.layer.mode).draw(self.canvas, drawing)
        check(self.context, "drawing a scene")
        return target

    def draw(self, scene: Scene, size: Size, eye: Eye | None = None) -> Light:
        """Draw one eye's view and return it as linear light.

        Returns
        -------
        array (height, width, 3) float32
            RGB, 0 to 1 where nothing is overexposed; row 0 is the top. Errors as `paint`.
        """
        return read(self.paint(scene, size, eye))

    def legend(self, scene: Scene, size: Size) -> Legend:
        """Return what has to be said on the picture of a scene, drawn before."""
        parts = [find_mode(drawing.layer.mode).legend(drawing) for drawing in resolve(scene, size)]
        return Legend(sum((part.bars for part in parts), ()), sum((part.words for part in parts), self.canvas.notes))

    def end_frame(self) -> None:
        """Forget what the frame just drawn did not use; call it after all eyes of a frame."""
        make_current(self.context)
        self.canvas.drop_unused()
        self.context.gc()

    def close(self) -> None:
        """Give everything back."""
        make_current(self.context)
        self._targets.clear()
        self.canvas.clear()
        self.context.gc()
        if self._own:
            self.context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _target(self, size: Size, eye: Eye | None) -> moderngl.Framebuffer:
        if (size, eye) not in self._targets:
            for key in [key for key in self._targets if key[0] != size]:
                del self._targets[key]
            self._targets[size, eye] = self.canvas.target(size)
        return self._targets[size, eye]


def read(target: moderngl.Framebuffer) -> Light:
    """Return a target's linear light, (height, width, 3) float32."""
    width, height = target.size
    raw = target.read(components=3, dtype="f4", alignment=1)
    return np.frombuffer(raw, np.float32).reshape(height, width, 3)
