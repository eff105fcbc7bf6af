"""Volumes cast by rays: one loop, in a shader and on the processor, and a snippet for each mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu.bricks import make_bricks
from display.cpu.cast import MAX, cast
from display.light import linear_of
from display.modes import Bar, Legend, mode
from display.rays import bounds, rays
from display.scene import Band, Volume, VolumeLook, axes_of_light, colour_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Blend, Canvas
    from display.resolve import Drawing
    from display.scene import Layer

    Array = NDArray[Any]

TABLE, SURFACE, COLOUR = range(3)


class RayMode:
    """What all modes that cast rays have in common."""

    data, look = Volume, VolumeLook
    kind: int
    snippet: str
    shade = TABLE

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Cast every band and add their colours."""
        for band in drawing.data.bands:
            self.draw_band(canvas, drawing, band)

    def draw_band(self, canvas: Canvas, drawing: Drawing, band: Band) -> None:
        """Cast one band where it is faster."""
        look: VolumeLook = drawing.look
        volume: Volume = drawing.data
        seen_by = rays(drawing.camera, volume)
        box = bounds(volume, look.cut)
        step_um = look.step * float(min(volume.spacing_um))
        table = canvas.keep("table", (band,), lambda: canvas.picture(_table(band), smooth=True))
        uniforms = {**ray_uniforms(seen_by), "step_um": step_um, **light_uniforms(drawing), **self.uniforms(drawing)}
        blend: Blend = "add" if len(volume.bands) > 1 else "over"
        if canvas.executor == "cpu":
            bricks = canvas.keep("bricks", (band.values,), lambda: make_bricks(band.values))
            seen = cast(self.kind, bricks, seen_by, box, drawing.camera.size, step_um=step_um, limits=band.limits)
            textures = {"seen": canvas.picture(seen, smooth=False), "table": table}
            canvas.fill("shaded.frag.glsl", uniforms=uniforms, textures=textures, defines=self.defines, blend=blend)
            return
        full = {"uint8": 255.0, "uint16": 65535.0}[str(band.values.dtype)]
        uniforms |= {"limits": tuple(v / full for v in band.limits), "low": box[0], "high": box[1]}
        textures = {"volume": canvas.volume(band.values, smooth=look.interpolation == "trilinear"), "table": table}
        canvas.fill(
            "cast.frag.glsl",
            uniforms=uniforms,
            textures=textures,
            defines=self.defines,
            snippet=self.snippet,
            blend=blend,
        )

    @property
    def defines(self) -> tuple[tuple[str, object], ...]:
        """What the shaders are compiled with."""
        return (("SHADE", self.shade),)

    def uniforms(self, drawing: Drawing) -> dict[str, object]:  # noqa: ARG002  others look at it
        """Return what the snippet needs beside the common."""
        return {}

    def legend(self, layer: Layer) -> Legend:
        """Return a colour bar for every band."""
        return Legend(tuple(bar(band) for band in layer.data.bands), (f"{layer.look.interpolation} samples",))


@mode("mip")
class Maximum(RayMode):
    """Brightest value along each ray."""

    kind, snippet = MAX, "cast_max.glsl"


def _table(band: Band) -> Array:
    return np.asarray(linear_of(colour_table(band.colour))[None], np.float32)


def bar(band: Band) -> Bar:
    """Return the colour bar of a band."""
    return Bar(colour_table(band.colour), band.limits, f"{band.name}, {band.unit}" if band.unit else band.name)


def ray_uniforms(seen_by: Any) -> dict[str, object]:
    """Return the uniforms of ``camera.glsl``."""
    eye = np.zeros(3) if seen_by.eye is None else seen_by.eye
    return {
        "corner": seen_by.corner,
        "right": seen_by.right,
        "down": seen_by.down,
        "along": seen_by.along,
        "eye": eye,
        "voxel_um": seen_by.voxel_um,
        "perspective": seen_by.eye is not None,
    }


def light_uniforms(drawing: Drawing) -> dict[str, object]:
    """Return the uniforms of ``shade.glsl``; the light stays where it is when the viewer moves around the data."""
    light = drawing.look.light
    camera = drawing.camera
    right, down = camera.right / camera.pixel_um, camera.down / camera.pixel_um
    aside, above, before = axes_of_light(light)
    return {
        "to_light": aside * right - above * down - before * camera.axis,
        "answer": (light.ambient, light.diffuse, light.specular, light.shininess),
        "surface_colour": (1.0, 1.0, 1.0),
    }
