"""Range images as surfaces: lit, coloured, as a grid, with an image draped over them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.words import spanned
from display.light import linear, linear_of
from display.modes import Bar, Legend, mode
from display.relief import Relief, ReliefLook
from display.resolve import light_vector
from display.scene import colour_table

if TYPE_CHECKING:
    from display.gl.canvas import Canvas
    from display.resolve import Camera, Drawing
    from display.scene import Light

UNLIT, SHADINGS = 0, {"flat": 1, "gouraud": 2, "phong": 3}
PLAIN, TABLED, DRAPED, OWN = range(4)
PAINTS = {"plain": PLAIN, "heights": TABLED, "cycles": TABLED, "image": DRAPED}
GREY = 0.8
BEHIND = 2e-3  # how far the surface stands behind the lines on it, of half the depth of the data


def mesh_uniforms(camera: Camera, light: Light) -> dict[str, Any]:
    """Return the uniforms that every mesh needs."""
    return {
        "clip": camera.matrix().T.reshape(-1).astype(np.float32),
        "along": camera.along / np.linalg.norm(camera.along),
        "eye": np.zeros(3) if camera.eye is None else camera.eye,
        "perspective": camera.eye is not None,
        "to_light": light_vector(camera, light),
        "answer": (light.ambient, light.diffuse, light.specular, light.shininess),
        "surface_colour": (GREY, GREY, GREY),
        "behind": 0.0,
        "contours": 0.0,
        "first_contour": 0.0,
        "cycles": 1.0,
    }


class ReliefMode:
    """What all pictures of a relief have in common."""

    data, look = Relief, ReliefLook

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw the surface."""
        self.surface(canvas, drawing, SHADINGS[drawing.look.shading], PAINTS[drawing.look.paint])

    def surface(self, canvas: Canvas, drawing: Drawing, shading: int, paint: int, **more: Any) -> None:
        """Draw the facets with a shading and a paint."""
        relief, look = drawing.data, drawing.look
        uniforms = mesh_uniforms(drawing.camera, look.light) | {
            "cycles": look.cycles if look.paint == "cycles" else 1.0,
            **_contours(relief, look),
            **more,
        }
        canvas.mesh(
            "mesh",
            vertices=_points(relief),
            indices=relief.facets.triangles,
            uniforms=uniforms,
            textures=self._textures(canvas, relief, look, paint),
            defines=(("SHADING", shading), ("PAINT", paint)),
        )

    def _textures(self, canvas: Canvas, relief: Relief, look: ReliefLook, paint: int) -> dict[str, Any]:
        if paint == TABLED:
            table = np.asarray(linear_of(colour_table(look.colours))[None], np.float32)
            return {"table": canvas.picture(table)}
        if paint == DRAPED and relief.image is not None:
            image = relief.image if relief.image.ndim == 3 else np.repeat(relief.image[..., None], 3, axis=2)
            return {"drape": canvas.picture(linear(image))}
        return {}

    def legend(self, drawing: Drawing) -> Legend:
        """Return the colour bar, and what was done to the heights."""
        relief, look = drawing.data, drawing.look
        bars = _bars(relief, look) if look.paint in {"heights", "cycles"} else ()
        return Legend(bars, (*self.words(relief, look), *relief_words(relief, look)))

    def words(self, relief: Relief, look: ReliefLook) -> tuple[str, ...]:  # noqa: ARG002  others look at it
        """Return how it is lit."""
        light = look.light
        shares = (
            f"ambient {light.ambient:g}, diffuse {light.diffuse:g}, specular {light.specular:g}^{light.shininess:g}"
        )
        return (f"{look.shading}: {shares}",)


@mode("relief")
class Lit(ReliefMode):
    """A range image as a lit surface."""


@mode("isometric")
class Coloured(ReliefMode):
    """A range image as a surface whose colours alone tell the height."""

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:  # noqa: D102
        look = drawing.look if drawing.look.paint != "plain" else replace(drawing.look, paint="heights", colours="gray")
        unlit = replace(drawing, layer=replace(drawing.layer, look=look))
        self.surface(canvas, unlit, UNLIT, PAINTS[look.paint])

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        look = drawing.look if drawing.look.paint != "plain" else replace(drawing.look, paint="heights", colours="gray")
        bars = () if look.paint == "image" else _bars(drawing.data, look)
        return Legend(bars, relief_words(drawing.data, look))


@mode("grid")
class Grid(ReliefMode):
    """A range image as a grid of lines; what lies behind is hidden."""

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:  # noqa: D102
        relief, look = drawing.data, drawing.look
        background = drawing.scene.background
        self.surface(canvas, drawing, UNLIT, PLAIN, behind=BEHIND, surface_colour=background, contours=0.0)
        canvas.mesh(
            "mesh",
            vertices=_points(relief),
            indices=relief.facets.lines,
            uniforms=mesh_uniforms(drawing.camera, look.light),
            textures=self._textures(canvas, relief, look, TABLED),
            defines=(("SHADING", UNLIT), ("PAINT", TABLED)),
            lines=True,
        )

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        return Legend(_bars(drawing.data, drawing.look), relief_words(drawing.data, drawing.look))


def relief_words(relief: Relief, look: ReliefLook) -> tuple[str, ...]:
    """Return what has to be said of every picture of heights."""
    low, high = relief.heights.limits
    words = [f"heights {spanned(low, high)} {relief.unit}, drawn × {relief.exaggeration:.3g}"]
    if relief.stride > 1:
        words.append(f"one point for every {relief.stride} pixels")
    if look.contours:
        words.append(f"lines every {look.contours:g} {relief.unit}")
    return tuple(words)


def _points(relief: Relief) -> dict[str, Any]:
    return {"position": relief.facets.position, "normal": relief.facets.normal, "tone": relief.facets.tone}


def _bars(relief: Relief, look: ReliefLook) -> tuple[Bar, ...]:
    table = colour_table(look.colours)
    if look.paint == "cycles":
        table = table[(np.linspace(0, look.cycles - 1e-6, 16 * len(table)) % 1 * len(table)).astype(int)]
    return (Bar(table, relief.heights.limits, f"height, {relief.unit}"),)


def _contours(relief: Relief, look: ReliefLook) -> dict[str, float]:
    """Return how many lines there are from the lowest to the highest, and where the first multiple lies."""
    if not look.contours:
        return {}
    low, high = relief.heights.limits
    return {"contours": (high - low) / look.contours, "first_contour": -low / look.contours}
