"""Planes through a volume: frontal, oblique, three together, pulled apart, and the voxels a plane cuts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError
from display.cast_mode import FULL, band_table, bar, bricks_of, light_uniforms, ray_uniforms
from display.cpu.planes import cut_planes
from display.modes import Legend, mode
from display.rays import bounds, rays
from display.resolve import axes
from display.scene import SliceLook, View, Volume

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Canvas
    from display.resolve import Drawing
    from display.scene import Band

    Array = NDArray[np.float64]

WHOLE = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
MOST_PLANES = 64
TINTS = {"x": (1.0, 0.82, 0.78), "y": (0.8, 1.0, 0.8), "z": (0.8, 0.87, 1.0)}  # lightly, so that values can be read
UNTINTED = (1.0, 1.0, 1.0)
EVERYTHING = -1e9


class PlaneMode:
    """What all modes that show planes have in common."""

    data, look = Volume, SliceLook

    def planes(self, drawing: Drawing) -> Array:
        """Return (planes, 7): normals and distances in µm from the middle, n · p = d, and moves in voxels."""
        raise NotImplementedError

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Draw every band and add their colours."""
        for band in drawing.data.bands:
            self.draw_band(canvas, drawing, band)

    def draw_band(self, canvas: Canvas, drawing: Drawing, band: Band) -> None:
        """Draw one band where it is faster."""
        seen_by, look, planes = rays(drawing.camera, drawing.data), drawing.look, self.planes(drawing)
        cuts, box, smooth = (
            in_voxels(planes, drawing.data),
            bounds(drawing.data, WHOLE),
            look.interpolation == "trilinear",
        )
        least = EVERYTHING if look.transparent is None else share(band, look.transparent)
        tints = np.array([tint_of(plane[:3]) if look.tint else UNTINTED for plane in planes], np.float32)
        uniforms = {**ray_uniforms(seen_by), "tints": tints, "transparent": least}
        defines = (("SHADE", 0), ("PLANES", len(planes)))
        textures = {"table": band_table(canvas, band)}
        blend: Any = "add" if len(drawing.data.bands) > 1 else "over"
        if canvas.executor == "cpu":
            bricks = bricks_of(canvas, band)
            size = drawing.camera.size
            seen = cut_planes(bricks, seen_by, box, size, cuts, limits=band.limits, transparent=least, smooth=smooth)
            textures["seen"] = canvas.picture(seen, smooth=False)
            canvas.fill("cut.frag.glsl", uniforms=uniforms, textures=textures, defines=defines, blend=blend)
            return
        textures["volume"] = canvas.volume(band.values, smooth=smooth)
        uniforms |= {"count": len(cuts), "planes": cuts[:, :4], "moved": cuts[:, 4:], "low": box[0], "high": box[1]}
        uniforms["limits"] = in_texture(band)
        canvas.fill("planes.frag.glsl", uniforms=uniforms, textures=textures, defines=defines, blend=blend)

    def legend(self, drawing: Drawing) -> Legend:
        """Return a colour bar for every band, and how voxels are shown."""
        return Legend(tuple(bar(band) for band in drawing.data.bands), said(drawing.look))


@mode("slice")
class Frontal(PlaneMode):
    """Plane at right angles to the view, on which lengths can be measured; the volume turns behind it."""

    def planes(self, drawing: Drawing) -> Array:  # noqa: D102
        axis = drawing.camera.axis
        return np.array([[*axis, axis @ place_um(drawing.look.at, drawing.data), 0, 0, 0]])


@mode("oblique")
class Oblique(PlaneMode):
    """Plane in any direction (--turn-deg, --tilt-deg) through a volume that stays as it is."""

    def planes(self, drawing: Drawing) -> Array:  # noqa: D102
        return np.array([oblique_plane(drawing)])


@mode("orthogonal")
class Orthogonal(PlaneMode):
    """Three planes along x, y and z together, each at its place."""

    def planes(self, drawing: Drawing) -> Array:  # noqa: D102
        place = place_um(drawing.look.at, drawing.data)
        return np.column_stack([np.eye(3), place, np.zeros((3, 3))])


@mode("exploded")
class Exploded(PlaneMode):
    """Parallel planes pulled apart (--gap), transparent where values are low."""

    def planes(self, drawing: Drawing) -> Array:  # noqa: D102
        look, depth = drawing.look, drawing.data.shape[0]
        count = min(look.planes, depth)
        if not (1 <= count <= MOST_PLANES and 1 <= look.gap <= 16):
            raise DisplayError(
                f"{look.planes} planes pulled apart ×{look.gap:g} cannot be shown.",
                fix=f"1 to {MOST_PLANES} planes, ×1 to ×16",
                code="planes",
            )
        shown = np.round((np.arange(count) + 0.5) * depth / count - 0.5)
        middle = (depth - 1) / 2
        places = middle + (shown - middle) * look.gap
        distances = (places - middle) * drawing.data.spacing_um[0]
        zeros = np.zeros(count)
        return np.column_stack([zeros, zeros, zeros + 1, distances, zeros, zeros, shown - places])


@mode("cubes")
class Cubes(Oblique):
    """Voxels cut by an oblique plane, as whole cubes."""

    def draw_band(self, canvas: Canvas, drawing: Drawing, band: Band) -> None:  # noqa: D102
        seen_by, look = rays(drawing.camera, drawing.data), drawing.look
        low, high = bounds(drawing.data, WHOLE)
        uniforms = {
            **ray_uniforms(seen_by),
            **light_uniforms(drawing),
            "planes": in_voxels(self.planes(drawing), drawing.data)[:, :4],
            "transparent": EVERYTHING if look.transparent is None else share(band, look.transparent),
            "pixel_um": drawing.camera.pixel_um,
            "low": low,
            "high": high,
            "limits": in_texture(band),
        }
        textures = {"table": band_table(canvas, band), "volume": canvas.volume(band.values, smooth=False)}
        blend: Any = "add" if len(drawing.data.bands) > 1 else "over"
        canvas.fill("cubes.frag.glsl", uniforms=uniforms, textures=textures, defines=(("SHADE", 0),), blend=blend)

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        return Legend(tuple(bar(band) for band in drawing.data.bands), ("voxels as cubes",))


def oblique_plane(drawing: Drawing) -> list[float]:
    """Return the plane of a look's direction through its place."""
    look = drawing.look
    normal = axes(View(look.turn_deg, look.tilt_deg))[2]
    return [*normal, float(normal @ place_um(look.at, drawing.data)), 0.0, 0.0, 0.0]


def place_um(at: tuple[float, float, float], volume: Volume) -> Array:
    """Return the point of shares of the whole, (x, y, z) from the middle; what lies outside is put on the border."""
    return np.asarray((np.clip(np.array(at), 0, 1) - 0.5) * volume.size_um)


def in_voxels(planes: Array, volume: Volume) -> Array:
    """Return planes given in µm from the middle in voxels."""
    normals = planes[:, :3] * volume.voxel_um
    distances = planes[:, 3] + normals @ ((np.array(volume.shape[::-1]) - 1) / 2)
    return np.column_stack([normals, distances, planes[:, 4:]])


def tint_of(normal: Array) -> tuple[float, float, float]:
    """Return the light tint of a plane's orientation: a mixture of those of x, y and z."""
    shares = np.asarray(normal) ** 2 / float(np.sum(np.asarray(normal) ** 2))
    red, green, blue = shares @ np.array([TINTS[name] for name in "xyz"])
    return float(red), float(green), float(blue)


def share(band: Band, value: float) -> float:
    """Return a value as a share of the band's limits."""
    return (value - band.limits[0]) / (band.limits[1] - band.limits[0])


def in_texture(band: Band) -> tuple[float, float]:
    """Return a band's limits as a texture has them."""
    full = FULL[str(band.values.dtype)]
    return band.limits[0] / full, band.limits[1] / full


def said(look: SliceLook) -> tuple[str, ...]:
    """Return the words on how voxels are shown."""
    how = "interpolated between voxels" if look.interpolation == "trilinear" else "voxels extended"
    return (how,) if look.transparent is None else (how, f"transparent below {look.transparent:g}")
