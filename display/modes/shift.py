"""Pseudo-rotation of a volume by shifting its planes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from display.cast_mode import band_table, bar, ray_uniforms
from display.cpu.shift import shifted_maximum
from display.modes import Legend, mode
from display.modes.slices import in_texture
from display.rays import rays
from display.resolve import camera
from display.scene import Volume, VolumeLook

if TYPE_CHECKING:
    from display.gl.canvas import Blend, Canvas
    from display.resolve import Drawing
    from display.scene import Band

DOUBTFUL_DEG = 30.0  # beyond, shifted planes look distorted, not turned
STEEPEST_DEG = 80.0


@mode("shift")
class PlaneShift:
    """Brightest value over planes that are shifted instead of turned; --interpolation nearest shifts whole voxels."""

    data, look = Volume, VolumeLook

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw every band and add their colours."""
        blend: Blend = "add" if len(drawing.data.bands) > 1 else "over"
        for band in drawing.data.bands:
            self.draw_band(canvas, drawing, band, blend)

    def draw_band(self, canvas: Canvas, drawing: Drawing, band: Band, blend: Blend) -> None:
        """Draw one band where it is faster."""
        uniforms, slope = self.geometry(drawing)
        whole = drawing.look.interpolation == "nearest"
        textures = {"table": band_table(canvas, band)}
        defines = (("SHADE", 0),)
        uniforms |= {"slope": slope, "whole": whole, "limits": in_texture(band)}
        if canvas.executor == "gl":
            textures["volume"] = canvas.volume(band.values, smooth=not whole)
            canvas.fill("shift.frag.glsl", uniforms=uniforms, textures=textures, defines=defines, blend=blend)
            return
        found, origin = shifted_maximum(band.values, slope, whole=whole)
        textures["found"] = canvas.picture(found, smooth=not whole)
        uniforms |= {"origin": origin} | ({} if whole else {"limits": band.limits})
        canvas.fill("shifted.frag.glsl", uniforms=uniforms, textures=textures, defines=defines, blend=blend)

    def geometry(self, drawing: Drawing) -> tuple[dict[str, object], tuple[float, float]]:
        """Return the rays of a look along the planes' axis, and the shift in voxels for each plane."""
        view = drawing.scene.view
        ahead = replace(view, azimuth_deg=0.0, elevation_deg=0.0, perspective_deg=0.0)
        seen_by = camera(replace(drawing.scene, view=ahead), drawing.camera.size, drawing.eye)
        dz, dy, dx = drawing.data.spacing_um
        across, up = (_tangent(angle) for angle in (view.azimuth_deg, view.elevation_deg))
        # a viewer to the right sees what is behind shifted to the right, one above sees it shifted up
        slope = ((across - seen_by.along[0]) * dz / dx, (-up - seen_by.along[1]) * dz / dy)
        return ray_uniforms(rays(seen_by, drawing.data)), slope

    def legend(self, drawing: Drawing) -> Legend:
        """Return colour bars, and a warning where shifting is no rotation any more."""
        view = drawing.scene.view
        words = [
            "planes shifted by " + ("whole voxels" if drawing.look.interpolation == "nearest" else "parts of voxels")
        ]
        if max(abs(view.azimuth_deg), abs(view.elevation_deg)) > DOUBTFUL_DEG:
            words.append(f"beyond {DOUBTFUL_DEG:g}° the shift distorts")
        return Legend(tuple(bar(band) for band in drawing.data.bands), tuple(words))


def _tangent(angle_deg: float) -> float:
    return math.tan(math.radians(max(-STEEPEST_DEG, min(STEEPEST_DEG, angle_deg))))
