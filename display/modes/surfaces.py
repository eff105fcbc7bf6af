"""Surfaces of features: opaque, translucent, dimmed, and as lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from display.modes import Legend, mode
from display.modes.reliefs import OWN, SHADINGS, UNLIT, mesh_uniforms
from display.surfaces import SurfaceLook, Surfaces, in_order, joined

if TYPE_CHECKING:
    from display.gl.canvas import Blend, Canvas
    from display.resolve import Drawing
    from display.surfaces import Joined


@mode("surface")
class Solid:
    """Surfaces of features, each in its colour; what is translucent shows what is behind it."""

    data, look = Surfaces, SurfaceLook

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw what is opaque, then the rest from the farthest to the nearest facet, then lines."""
        whole = _whole(canvas, drawing)
        uniforms = mesh_uniforms(drawing.camera, drawing.look.light)
        points = {"position": whole.position, "normal": whole.normal, "tone": whole.tone}
        defines = (("SHADING", SHADINGS[drawing.look.shading]), ("PAINT", OWN))
        blends: tuple[Blend, Blend] = ("replace", "over")
        for facets, blend in zip(in_order(whole, drawing.camera), blends, strict=True):
            if len(facets):
                canvas.mesh("mesh", vertices=points, indices=facets, uniforms=uniforms, defines=defines, blend=blend)
        draw_lines(canvas, drawing, whole)

    def legend(self, drawing: Drawing) -> Legend:
        """Return how many there are, and how translucent."""
        meshes, look = drawing.data.meshes, drawing.look
        count = f"{len(meshes)} surface{'s' if len(meshes) > 1 else ''}"
        opacities = sorted({mesh.opacity * look.opacity for mesh in meshes})
        seen = f"opacity {opacities[0]:.3g}" + (f" … {opacities[-1]:.3g}" if len(opacities) > 1 else "")
        dimmed = (f"dimmed: all but {', '.join(look.bright)}",) if look.bright else ()
        return Legend((), (f"{count}, {seen}", *dimmed))


@mode("outlines")
class Outlines:
    """Lines alone: outlines of sections, or the edges of facets where there are none."""

    data, look = Surfaces, SurfaceLook

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw the lines."""
        draw_lines(canvas, drawing, _whole(canvas, drawing))

    def legend(self, drawing: Drawing) -> Legend:
        """Return how many there are."""
        return Legend((), (f"outlines of {len(drawing.data.meshes)}",))


def draw_lines(canvas: Canvas, drawing: Drawing, whole: Joined) -> None:
    """Draw the lines of all surfaces in their colours, unlit."""
    if not len(whole.lines):
        return
    canvas.mesh(
        "mesh",
        vertices={"position": whole.position, "normal": whole.normal, "tone": whole.tone},
        indices=whole.lines,
        uniforms=mesh_uniforms(drawing.camera, drawing.look.light),
        defines=(("SHADING", UNLIT), ("PAINT", OWN)),
        blend="over",
        lines=True,
    )


def _whole(canvas: Canvas, drawing: Drawing) -> Joined:
    whole: Joined = canvas.keep("surfaces", (drawing.data, drawing.look), lambda: joined(drawing.data, drawing.look))
    return whole
