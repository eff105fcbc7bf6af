"""What all modes that cast rays through a volume share: one loop, in a shader and on the processor, and a snippet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import cast as cpu
from display.cpu.bricks import Bricks, make_bricks
from display.cpu.shear import cast_sheared, main_axis, shearable, swept
from display.light import linear_of
from display.modes import Bar, Legend
from display.rays import Rays, bounds, rays, thinned
from display.resolve import light_vector
from display.scene import Band, Volume, VolumeLook, band_colours

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Blend, Canvas
    from display.resolve import Drawing

    Array = NDArray[Any]

TABLE, SURFACE, COLOUR, THROUGH, DEPTH = range(5)
FULL = {"uint8": 255.0, "uint16": 65535.0}
DENSEST_PERCENT = 99.9
DENSEST_DEPTH = 3.0  # -ln of what the densest columns let through: 5 %
MANY_VOXELS = 40_000_000  # of more, a moving picture shows every second along each axis
THINNER = 2
EDGE_FLOOR = 0.1  # change of the value from voxel to voxel that makes an edge
REAR_GAP = 0.02  # of the size of everything, between the data and the plane behind it


class RayMode:
    """What all modes that cast rays have in common."""

    data, look = Volume, VolumeLook
    kind: int
    snippet: str
    shade = TABLE
    exact = False
    one_band = False

    def draw(self, canvas: Canvas, drawing: Drawing) -> None:
        """Cast every band and add their colours."""
        shown = drawing.data.bands[:1] if self.one_band else drawing.data.bands
        self.draw_behind(canvas, drawing, shown[0])
        for band in shown:
            self.draw_band(canvas, drawing, self.prepared(canvas, band), "add" if len(shown) > 1 else "over")

    def draw_behind(self, canvas: Canvas, drawing: Drawing, band: Band) -> None:
        """Draw what stands behind the volume."""

    def prepared(self, canvas: Canvas, band: Band) -> Band:  # noqa: ARG002  others make something of it
        """Return what is cast in the place of a band."""
        return band

    def draw_band(self, canvas: Canvas, drawing: Drawing, band: Band, blend: Blend) -> None:
        """Cast one band where it is faster."""
        seen_by = rays(drawing.camera, drawing.data)
        uniforms = {**ray_uniforms(seen_by), **light_uniforms(drawing), **self.numbers(canvas, drawing, band)}
        textures = {"table": band_table(canvas, band)}
        if canvas.executor == "cpu":
            seen = self.cast(canvas, drawing, band, seen_by, uniforms)
            textures["seen"] = canvas.picture(seen, smooth=False)
            canvas.fill("shaded.frag.glsl", uniforms=uniforms, textures=textures, defines=self.defines, blend=blend)
            return
        low, high = bounds(drawing.data, drawing.look.cut)
        full = FULL[str(band.values.dtype)]
        uniforms |= {"limits": tuple(v / full for v in band.limits), "low": low, "high": high}
        smooth = drawing.look.interpolation == "trilinear" and not self.exact
        textures |= {"volume": canvas.volume(band.values, smooth=smooth), **self.textures(canvas, drawing, band)}
        canvas.fill(
            "cast.frag.glsl",
            uniforms=uniforms,
            textures=textures,
            defines=self.defines,
            snippet=self.snippet,
            blend=blend,
        )

    def cast(
        self, canvas: Canvas, drawing: Drawing, band: Band, seen_by: Rays, uniforms: dict[str, Any]
    ) -> NDArray[np.float32]:
        """Cast one band on the processor."""
        return self.cast_with(canvas, drawing, band, seen_by, uniforms)

    def cast_with(
        self,
        canvas: Canvas,
        drawing: Drawing,
        band: Band,
        seen_by: Rays,
        uniforms: dict[str, Any],
        *,
        table: Array | None = None,
        lit: Bricks | None = None,
    ) -> NDArray[np.float32]:
        """Cast one band exactly, or while the picture moves by shearing where that shows the same."""
        numbers, size = casting(band, uniforms), drawing.camera.size
        box = bounds(drawing.data, drawing.look.cut)
        if canvas.moving and lit is None and self.shade != DEPTH and shearable(self.kind, seen_by, numbers):
            thin = THINNER if band.values.size > MANY_VOXELS else 1
            axis = main_axis(seen_by)
            volume = canvas.keep(f"swept {axis}", (band.values,), lambda: swept(bricks_of(canvas, band, thin), axis))
            if thin > 1:
                canvas.notes = (f"while moving: each {thin}nd voxel",)
                seen_by, box = thinned(seen_by, thin), (box[0] / thin, box[1] / thin)
            return cast_sheared(self.kind, volume, seen_by, box, size, numbers, table)
        return cpu.cast(self.kind, bricks_of(canvas, band), seen_by, box, size, numbers, table=table, lit=lit)

    @property
    def defines(self) -> tuple[tuple[str, object], ...]:
        """What the shaders are compiled with."""
        return (("SHADE", self.shade), *((("EXACT", 1),) if self.exact else ()))

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: ARG002
        """Return the numbers of the loop; both executors take them."""
        look: VolumeLook = drawing.look
        return {
            "step_um": look.step * float(min(drawing.data.spacing_um)),
            "threshold": threshold(band, look),
            "gain": 1.0,
            "surface": 0.0,
            "fade_per_um": 0.0,
            "front_um": 0.0,
            "from_behind": False,
        }

    def textures(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: ARG002
        """Return what the snippet samples beside the volume."""
        return {}

    def legend(self, drawing: Drawing) -> Legend:
        """Return a colour bar for every band."""
        return Legend(tuple(bar(band) for band in drawing.data.bands), common_words(drawing))


def bricks_of(canvas: Canvas, band: Band, thin: int = 1) -> Bricks:
    """Return the volume of a band as the processor casts it, or of each ``thin``-th voxel along an axis; made once."""
    some = (slice(None, None, thin),) * 3
    return canvas.keep(f"bricks {thin}", (band.values,), lambda: make_bricks(band.values[some]))  # type: ignore[no-any-return]


def threshold(band: Band, look: VolumeLook) -> float:
    """Return the threshold as 0 to 1 between the band's limits."""
    if look.threshold is None:
        return 0.5
    return (look.threshold - band.limits[0]) / (band.limits[1] - band.limits[0])


def front_and_back_um(drawing: Drawing) -> tuple[float, float]:
    """Return the depths of the front and the back of the data behind the screen plane."""
    camera = drawing.camera
    half = float(np.abs(camera.axis) @ drawing.data.size_um) / 2
    middle = -float(camera.centre @ camera.axis)
    return middle - half, middle + half


def bar(band: Band) -> Bar:
    """Return the colour bar of a band."""
    limits = band.limits if band.stand_for is None else band.stand_for
    return Bar(band_colours(band), limits, f"{band.name}, {band.unit}" if band.unit else band.name)


def common_words(drawing: Drawing) -> tuple[str, ...]:
    """Return what is said about every volume."""
    view = "perspective" if drawing.camera.eye is not None else "parallel view"
    return (f"{drawing.look.interpolation}, {view}",)


def ray_uniforms(seen_by: Rays) -> dict[str, Any]:
    """Return the uniforms of ``camera.glsl``."""
    return {
        "corner": seen_by.corner,
        "right": seen_by.right,
        "down": seen_by.down,
        "along": seen_by.along,
        "eye": np.zeros(3) if seen_by.eye is None else seen_by.eye,
        "voxel_um": seen_by.voxel_um,
        "perspective": seen_by.eye is not None,
    }


def light_uniforms(drawing: Drawing) -> dict[str, Any]:
    """Return the uniforms of ``shade.glsl``."""
    light = drawing.look.light
    return {
        "to_light": light_vector(drawing.camera, light),
        "answer": (light.ambient, light.diffuse, light.specular, light.shininess),
        "surface_colour": (1.0, 1.0, 1.0),
    }


def band_table(canvas: Canvas, band: Band) -> Any:
    """Return the texture of a band's colours as linear light, made once."""

    def make() -> Any:
        return canvas.picture(np.asarray(linear_of(band_colours(band))[None], np.float32))

    return canvas.keep("table", (band,), make)


def casting(band: Band, numbers: dict[str, Any]) -> cpu.Casting:
    """Return the numbers of the loop as the processor takes them."""
    low, high = band.limits
    return cpu.Casting(
        low=low,
        per_value=1 / (high - low),
        step_um=numbers["step_um"],
        perspective=bool(numbers.get("perspective", False)),
        threshold=float(numbers["threshold"]),
        fade_per_um=float(numbers["fade_per_um"]),
        front_um=float(numbers["front_um"]),
        surface=float(numbers["surface"]),
        light=_three(numbers["to_light"]),
        answer=numbers["answer"],
    )


def _three(vector: Array) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in vector)
    return x, y, z
