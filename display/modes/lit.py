"""Volumes in light: surfaces, translucent matter, and the shadows they cast."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cast_mode import (
    COLOUR,
    SURFACE,
    RayMode,
    bar,
    bricks_of,
    casting,
    common_words,
    front_and_back_um,
    light_uniforms,
    ray_uniforms,
    threshold,
)
from display.cpu import cast as cpu
from display.cpu.bricks import make_bricks
from display.cpu.shadow import reaching_light
from display.modes import Legend, mode
from display.rays import Rays, bounds, in_voxels, rays
from display.resolve import light_vector
from display.scene import VolumeLook, transfer_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Canvas
    from display.resolve import Drawing
    from display.scene import Band

    Array = NDArray[Any]

EDGE_FLOOR = 0.1  # change of the value from voxel to voxel that makes an edge
REAR_GAP = 0.02  # of the size of everything, between the data and the plane behind it


class LitMode(RayMode):
    """A mode before which a plane can stand that catches the shadow."""

    def draw_behind(self, canvas: Canvas, drawing: Drawing, band: Band) -> None:  # noqa: D102
        if drawing.look.shadow in {"rear", "both"}:
            draw_rear_plane(canvas, drawing, band)


@mode("first")
class FirstSurface(LitMode):
    """First place along each ray where the value reaches the threshold, as a lit surface."""

    kind, snippet, shade, one_band = cpu.FIRST, "cast_surface.glsl", SURFACE, True

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        band = drawing.data.bands[0]
        level = band.limits[0] + threshold(band, drawing.look) * (band.limits[1] - band.limits[0])
        return Legend((), (*common_words(drawing), f"surface at {band.name} {level:.4g}"))


@mode("last")
class LastSurface(FirstSurface):
    """Last such place, the far side, as a lit surface."""

    kind = cpu.LAST

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        return {**super().numbers(canvas, drawing, band), "from_behind": True}


@mode("edge")
class Steepest(LitMode):
    """Place along each ray where the value changes most, as a lit surface."""

    kind, snippet, shade, one_band = cpu.EDGE, "cast_edge.glsl", SURFACE, True

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        given = {} if drawing.look.threshold is not None else {"threshold": EDGE_FLOOR}
        return {**super().numbers(canvas, drawing, band), **given}

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        return Legend((), (*common_words(drawing), "surface of the steepest change"))


@mode("translucent")
class Translucent(LitMode):
    """Emission and absorption together by colour and opacity tables; with --surface a lit surface within."""

    kind, snippet, shade = cpu.LIGHT, "cast_light.glsl", COLOUR

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        shadowed = drawing.look.shadow in {"self", "both"}
        numbers = super().numbers(canvas, drawing, band)
        return {**numbers, "surface": drawing.look.surface, "self_shadow": shadowed}

    def textures(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        table = transfer_of(canvas, drawing, band)
        picture = canvas.keep("transfer", (table,), lambda: canvas.picture(table[None]))
        lit = reaching(canvas, drawing, band)
        reached = canvas.volume(band.values if lit is None else lit, smooth=True)
        return {"transfer": picture, "reaching": reached}

    def cast(  # noqa: D102
        self, canvas: Canvas, drawing: Drawing, band: Band, seen_by: Rays, uniforms: dict[str, Any]
    ) -> NDArray[np.float32]:
        lit = reaching(canvas, drawing, band)
        light = None if lit is None else canvas.keep("lit", (lit,), lambda: make_bricks(lit))
        table = transfer_of(canvas, drawing, band)
        return self.cast_with(canvas, drawing, band, seen_by, uniforms, table=table, lit=light)

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        words = common_words(drawing)
        if drawing.look.surface:
            words += (f"surface at {threshold(drawing.data.bands[0], drawing.look):.0%} of full",)
        return Legend(tuple(bar(band) for band in drawing.data.bands), words)


def draw_rear_plane(canvas: Canvas, drawing: Drawing, band: Band) -> None:
    """Draw a white plane behind the data, darker where the data take the light away."""
    table = transfer_of(canvas, drawing, band)
    camera, look = drawing.camera, drawing.look
    _, back = front_and_back_um(drawing)
    place = back + REAR_GAP * float(np.linalg.norm(drawing.scene.size_um))
    reach = 1.0 if camera.eye is None else 1 + place / float((camera.centre - camera.eye) @ camera.axis)
    corner = camera.corner + place * camera.along
    if camera.eye is not None:
        corner = camera.eye + (camera.corner - camera.eye) * reach
    to_light = light_vector(camera, look.light)
    behind = in_voxels(corner, camera.right * reach, camera.down * reach, to_light, None, drawing.data)
    bricks = bricks_of(canvas, band)
    numbers = casting(band, {**Translucent().numbers(canvas, drawing, band), **light_uniforms(drawing), "surface": 0.0})
    dark = np.column_stack([np.zeros((256, 3), np.float32), table[:, 3]])
    seen = cpu.cast(cpu.LIGHT, bricks, behind, bounds(drawing.data, look.cut), camera.size, numbers, table=dark)
    shade = look.light.ambient + (1 - look.light.ambient) * (1 - seen[..., 3])
    plane = np.dstack([shade] * 3 + [np.ones_like(shade)]).astype(np.float32)
    canvas.fill(
        "shaded.frag.glsl",
        uniforms=ray_uniforms(rays(camera, drawing.data)),
        textures={"seen": canvas.picture(plane, smooth=False)},
        defines=(("SHADE", COLOUR),),
    )


def reaching(canvas: Canvas, drawing: Drawing, band: Band) -> Array | None:
    """Return the light that reaches each voxel, made once for a direction; None without shadows."""
    look: VolumeLook = drawing.look
    if look.shadow not in {"self", "both"}:
        return None
    direction = light_vector(drawing.camera, look.light)
    table = transfer_of(canvas, drawing, band)
    name = "reaching " + " ".join(f"{part:.3f}" for part in direction)

    def make() -> Array:
        return reaching_light(band.values, table[:, 3], direction, drawing.data.voxel_um, band.limits)

    return canvas.keep(name, (band.values, table), make)  # type: ignore[no-any-return]


def transfer_of(canvas: Canvas, drawing: Drawing, band: Band) -> Array:
    """Return the table of light and absorption of a band, made once."""
    look, unit_um = drawing.look, float(min(drawing.data.spacing_um))
    return canvas.keep("transfer table", (band, look.transfer), lambda: transfer_table(band, look.transfer, unit_um))  # type: ignore[no-any-return]
