"""What a mode draws with: textures of arrays, full-screen passes, meshes. Modes see this and not OpenGL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import moderngl
import numpy as np

from display.gl.context import check, is_software
from display.gl.programs import compiled

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from display.gl.programs import Defines

    Array = NDArray[Any]
    Texture = moderngl.Texture | moderngl.Texture3D

Blend = Literal["replace", "over", "add", "multiply"]
Executor = Literal["gl", "cpu"]
FORMATS = {"uint8": "f1", "uint16": "nu2", "float16": "f2", "float32": "f4"}
FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0, "float16": 1.0, "float32": 1.0}
COLOUR = "f4"
ENDS = 3  # corners of the one triangle that covers every pixel


@dataclass
class Kept:
    """Something made from arrays, which are held so that their identity stays theirs."""

    arrays: tuple[object, ...]
    made: Any
    used: bool = True


class Canvas:
    """Draws into the bound target of a context; row 0 of every target is the top of the picture.

    Attributes
    ----------
    context : moderngl.Context
    executor : "gl" or "cpu"
        Where work per voxel is done.
    largest : int
        Longest side of a volume texture.
    moving : bool
        The picture is one of many in motion: what is faster and nearly the same will do.
    notes : tuple of str
        What has to be said on what was drawn since they were emptied.
    """

    def __init__(self, context: moderngl.Context, executor: Executor | None = None) -> None:
        self.context = context
        self.executor = executor or ("cpu" if is_software(context) else "gl")
        self.largest = int(context.info["GL_MAX_3D_TEXTURE_SIZE"])
        self.moving = False
        self.notes: tuple[str, ...] = ()
        self._programs: dict[object, moderngl.Program] = {}
        self._kept: dict[object, Kept] = {}

    def target(self, size: tuple[int, int]) -> moderngl.Framebuffer:
        """Return a new target of (width, height) for linear light and alpha, with depth."""
        colour = self.context.texture(size, 4, dtype=COLOUR)
        return self.context.framebuffer([colour], self.context.depth_renderbuffer(size))

    def keep(self, key: str, arrays: tuple[object, ...], make: Callable[[], Any]) -> Any:
        """Return what ``make`` returned for these very arrays, made once and dropped when a frame does without it."""
        name = (key, *map(id, arrays))
        if name not in self._kept:
            self._kept[name] = Kept(arrays, make())
        self._kept[name].used = True
        return self._kept[name].made

    def drop_unused(self) -> None:
        """Forget what was not used since the last call."""
        for name in [name for name, kept in self._kept.items() if not kept.used]:
            del self._kept[name]  # the context releases what nobody holds
        for kept in self._kept.values():
            kept.used = False

    def clear(self) -> None:
        """Forget everything, programs included."""
        self._kept.clear()
        self._programs.clear()

    def volume(self, values: Array, *, smooth: bool) -> moderngl.Texture3D:
        """Return the texture of a volume (z, y, x), uploaded once; ``smooth`` interpolates between voxels.

        Where it is larger than a texture may be, means of neighbouring voxels stand for it, and ``notes`` says so.
        """
        texture: moderngl.Texture3D = self.keep("volume", (values,), lambda: self._upload(values))
        if max(values.shape) > self.largest:
            sizes = ("×".join(map(str, shape)) for shape in (values.shape[::-1], texture.size))
            self.notes = ("{} voxels drawn as {}: a texture holds no more".format(*sizes),)
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR) if smooth else (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def _upload(self, values: Array) -> moderngl.Texture3D:
        fitting = np.ascontiguousarray(reduced(values, self.largest))
        size = fitting.shape[::-1]
        texture = self.context.texture3d(size, 1, fitting.data, alignment=1, dtype=FORMATS[str(values.dtype)])
        texture.extra = tuple(float(n) for n in values.shape[::-1])
        texture.repeat_x = texture.repeat_y = texture.repeat_z = False
        check(self.context, "sending a volume")
        return texture

    def picture(self, values: Array, *, smooth: bool = True, keep: bool = False) -> moderngl.Texture:
        """Return the texture of (height, width[, bands]); kept between frames only when asked."""
        if keep:
            texture: moderngl.Texture = self.keep("picture", (values,), lambda: self.picture(values, smooth=smooth))
            return texture
        height, width = values.shape[:2]
        bands = 1 if values.ndim == 2 else values.shape[2]
        made = self.context.texture(
            (width, height), bands, np.ascontiguousarray(values).data, alignment=1, dtype=FORMATS[str(values.dtype)]
        )
        made.repeat_x = made.repeat_y = False
        made.filter = (moderngl.LINEAR, moderngl.LINEAR) if smooth else (moderngl.NEAREST, moderngl.NEAREST)
        return made

    def fill(
        self,
        fragment: str,
        *,
        uniforms: Mapping[str, object],
        textures: Mapping[str, Texture],
        defines: Defines = (),
        snippet: str = "",
        blend: Blend = "replace",
    ) -> None:
        """Run a fragment shader over every pixel; ``snippet`` is the file it includes as ``snippet.glsl``."""
        if "volume" in textures:
            uniforms = {**uniforms, "voxels": textures["volume"].extra}
        program = self._program("screen.vert.glsl", fragment, defines, (("snippet.glsl", snippet),) if snippet else ())
        self._set(program, uniforms, textures)
        self._blend(blend)
        self.context.disable(moderngl.DEPTH_TEST)
        self._vertices(program).render(moderngl.TRIANGLES, vertices=ENDS)
        check(self.context, f"drawing {snippet or fragment}")

    def mesh(
        self,
        shader: str,
        *,
        vertices: Mapping[str, Array],
        indices: Array,
        uniforms: Mapping[str, object],
        textures: Mapping[str, Texture] | None = None,
        defines: Defines = (),
        blend: Blend = "replace",
        lines: bool = False,
    ) -> None:
        """Draw triangles or lines with ``<shader>.vert.glsl`` and ``<shader>.frag.glsl``, depth tested.

        Parameters
        ----------
        vertices : dict of array (n, k) float32
            Attributes by name.
        indices : array, uint32
            Corners, three (two for lines) each.
        """
        program = self._program(f"{shader}.vert.glsl", f"{shader}.frag.glsl", defines, ())
        self._set(program, uniforms, textures or {})
        self._blend(blend)
        self.context.enable(moderngl.DEPTH_TEST)
        self.context.depth_func = "<="
        array = self.keep(
            f"mesh {shader} {defines}",
            (*vertices.values(), indices),
            lambda: self._vertex_array(program, vertices, indices),
        )
        array.render(moderngl.LINES if lines else moderngl.TRIANGLES)
        check(self.context, f"drawing {shader}")

    def _vertex_array(
        self, program: moderngl.Program, vertices: Mapping[str, Array], indices: Array
    ) -> moderngl.VertexArray:
        buffers = [
            (self.context.buffer(np.ascontiguousarray(values, np.float32).data), f"{values.shape[1]}f", name)
            for name, values in vertices.items()
            if name in program  # the compiler leaves out what makes no difference
        ]
        corners = self.context.buffer(np.ascontiguousarray(indices, np.uint32).data)
        return self.context.vertex_array(program, buffers, corners)

    def _vertices(self, program: moderngl.Program) -> moderngl.VertexArray:
        array: moderngl.VertexArray = self.keep("screen", (program,), lambda: self.context.vertex_array(program, []))
        return array

    def _program(
        self, vertex: str, fragment: str, defines: Defines, substitutes: tuple[tuple[str, str], ...]
    ) -> moderngl.Program:
        key = (vertex, fragment, defines, substitutes)
        if key not in self._programs:
            made = compiled(self.context, vertex, fragment, defines=defines, substitutes=dict(substitutes))
            self._programs[key] = made
        return self._programs[key]

    def _set(self, program: moderngl.Program, uniforms: Mapping[str, object], textures: Mapping[str, Texture]) -> None:
        """Set what the program knows; what the compiler left out is passed over."""
        for name, value in uniforms.items():
            if name in program:
                program[name] = _plain(value)
        for place, (name, texture) in enumerate(textures.items()):
            if name in program:
                texture.use(place)
                program[name] = place

    def _blend(self, blend: Blend) -> None:
        if blend == "replace":
            self.context.disable(moderngl.BLEND)
            return
        self.context.enable(moderngl.BLEND)
        self.context.blend_func = {
            "over": (moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA),
            "add": (moderngl.ONE, moderngl.ONE),
            "multiply": (moderngl.DST_COLOR, moderngl.ZERO),
        }[blend]


def reduced(values: Array, largest: int) -> Array:
    """Return a volume with at most so many voxels along each axis: means over equal parts, the whole extent kept."""
    depth, height, width = (min(n, largest) for n in values.shape)
    if (height, width) != values.shape[1:]:
        planes = [cv2.resize(plane, (width, height), interpolation=cv2.INTER_AREA) for plane in values]
        values = np.stack(planes).reshape(len(values), height, width)
    if depth == len(values):
        return values
    rows = [cv2.resize(values[:, j], (width, depth), interpolation=cv2.INTER_AREA) for j in range(height)]
    return np.stack(rows, axis=1).reshape(depth, height, width)


def _plain(value: object) -> object:
    """Return an array as moderngl takes it: a tuple, or a list of tuples unless there is but one."""
    if not isinstance(value, np.ndarray):
        return value
    if value.ndim == 1:
        return tuple(value.tolist())
    rows = [tuple(row) for row in value.tolist()]
    return rows if len(rows) > 1 else rows[0]
