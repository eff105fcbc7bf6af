"""The newest camera frame as a texture for a panel: uploaded when it is new, coloured whenever anything changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from display.gl.canvas import FORMATS, FULL_SCALE
from display.gl.context import check
from display.levels import colours_of_levels, seen

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Canvas

    Array = NDArray[Any]


class PanelPicture:
    """A target of its own that a panel shows; the window's own target is bound again after every drawing."""

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        self._target: moderngl.Framebuffer | None = None
        self._drawn: object = None

    @property
    def name(self) -> int:
        """OpenGL's name of the texture, 0 before the first drawing."""
        return 0 if self._target is None else int(self._target.color_attachments[0].glo)

    def read(self) -> NDArray[np.uint8]:
        """Return what it shows, (height, width, 3)."""
        assert self._target is not None
        width, height = self._target.size
        return np.frombuffer(self._target.read(components=3, alignment=1), np.uint8).reshape(height, width, 3)

    def begin(self, size: tuple[int, int], state: object) -> bool:
        """Bind the target; False when it shows ``state`` at this size already."""
        if self._target is not None and self._target.size == size and state == self._drawn:
            return False
        context = self.canvas.context
        if self._target is None or self._target.size != size:
            self._target = context.framebuffer([context.texture(size, 4, dtype="f1")])
        self._drawn = state
        self._target.use()
        context.scissor = None
        return True

    def lay(self, picture: NDArray[np.uint32]) -> None:
        """Write a finished picture, (height, width) of four bytes each, in the place of drawing."""
        assert self._target is not None
        texture = self._target.color_attachments[0]
        assert isinstance(texture, moderngl.Texture)
        texture.write(picture.data)
        self.end()

    def end(self) -> None:
        """Give the window its target back; raises `DisplayError` if OpenGL failed."""
        context = self.canvas.context
        if context.screen is not None:  # there is a window
            context.screen.use()
        check(context, "drawing a panel")
        context.gc()


class LivePicture(PanelPicture):
    """A camera frame, (height, width[, 3]) uint8 or uint16."""

    def __init__(self, canvas: Canvas) -> None:
        super().__init__(canvas)
        self._frame: moderngl.Texture | None = None
        self._number = -1
        self._tables: dict[int, tuple[moderngl.Texture, Array]] = {}  # held with what they show
        self._colours: tuple[object, NDArray[np.uint32], Array] | None = None

    def draw(
        self,
        pixels: Array,
        number: int,
        *,
        size: tuple[int, int],
        place: tuple[float, float, float],
        table: Array,
        levels: tuple[float, float, float, float, bool],
    ) -> None:
        """Draw a frame unless it is there as it is.

        Parameters
        ----------
        number : int
            Another one for every frame.
        size : (width, height)
            Of the panel, in pixels of the screen.
        place : (left, top, scale)
            Where the frame lies in it.
        table : array (1, 256, 3) float32
            Colours.
        levels : (low, high, gamma, top, paint)
            Grey levels shown as nothing and as full, gamma, the camera's largest, whether ends are hatched.
        """
        if not self.begin(size, (number, place, id(table), levels)):
            return
        if self.canvas.executor == "cpu" and pixels.ndim == 2:
            self.lay(seen(pixels, size, place, self._colours_of(table, levels, pixels.dtype), levels))
            return
        if number != self._number:
            self._upload(pixels, number)
        assert self._frame is not None
        low, high, gamma, top, paint = levels
        uniforms = {
            "full": FULL_SCALE[str(pixels.dtype)],
            "limits": (low, high),
            "gamma": gamma,
            "top": top,
            "paint": paint,
            "coloured": pixels.ndim == 3,
            "corner": place[:2],
            "scale": place[2],
        }
        textures = {"frame": self._frame, "table": self._table(table)}
        self.canvas.fill("live.frag.glsl", uniforms=uniforms, textures=textures)
        self.end()

    def _colours_of(
        self, table: Array, levels: tuple[float, float, float, float, bool], dtype: np.dtype[Any]
    ) -> NDArray[np.uint32]:
        """Return the colours of all grey levels, made anew when the contrast is another."""
        state = (id(table), levels, dtype)
        if self._colours is None or self._colours[0] != state:
            self._colours = (state, colours_of_levels(table, levels, dtype), table)
        return self._colours[1]

    def _upload(self, pixels: Array, number: int) -> None:
        """Send a frame: into the texture there is when it is of the same kind."""
        bands, size = (1 if pixels.ndim == 2 else pixels.shape[2]), pixels.shape[1::-1]
        kind = FORMATS[str(pixels.dtype)]
        frame = self._frame
        if frame is None or (frame.size, frame.components, frame.dtype) != (size, bands, kind):
            self._frame = self.canvas.picture(pixels, smooth=False)
        else:
            frame.write(np.ascontiguousarray(pixels).data, alignment=1)
        self._number = number

    def _table(self, table: Array) -> moderngl.Texture:
        if id(table) not in self._tables:
            self._tables[id(table)] = (self.canvas.picture(table, smooth=True), table)
        return self._tables[id(table)][0]


class StillPicture(PanelPicture):
    """A finished picture of sRGB levels, (height, width, 3) uint8, as large as fits."""

    def draw(self, picture: NDArray[np.uint8], *, size: tuple[int, int]) -> None:
        """Draw a picture unless it is there already."""
        if not self.begin(size, id(picture)):
            return
        self._kept = picture  # so that its identity stays its own
        uniforms = {"window": tuple(map(float, size))}
        self.canvas.fill("panel.frag.glsl", uniforms=uniforms, textures={"picture": self.canvas.picture(picture)})
        self.end()
