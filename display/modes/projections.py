"""Volumes along rays: brightest, darkest, sum, absorption, and depth of the brightest."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from display.cast_mode import DEPTH, FULL, THROUGH, RayMode, bar, common_words, front_and_back_um
from display.cpu import cast as cpu
from display.modes import Bar, Legend, mode
from display.scene import band_colours, colour_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.gl.canvas import Canvas
    from display.resolve import Drawing
    from display.scene import Band

    Array = NDArray[Any]

DENSEST_PERCENT = 99.9
DENSEST_DEPTH = 3.0  # -ln of what the densest columns let through: 5 %


@mode("mip")
class Maximum(RayMode):
    """Brightest value along each ray."""

    kind, snippet = cpu.MAX, "cast_max.glsl"


@mode("minip")
class Minimum(RayMode):
    """Darkest value along each ray."""

    kind, snippet = cpu.MIN, "cast_min.glsl"


@mode("depth")
class DepthOfMaximum(RayMode):
    """How far away the brightest value of each ray is, as a colour."""

    kind, snippet, shade, one_band = cpu.MAX, "cast_max.glsl", DEPTH, True
    colours = "turbo"
    floor = 0.1

    def prepared(self, canvas: Canvas, band: Band) -> Band:  # noqa: D102
        return canvas.keep("depth colours", (band,), lambda: replace(band, colour=self.colours))  # type: ignore[no-any-return]

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        return {**super().numbers(canvas, drawing, band), "depths": front_and_back_um(drawing)} | self._level(drawing)

    def _level(self, drawing: Drawing) -> dict[str, float]:
        """Rays on which nothing is brighter than a tenth show nothing, unless a threshold is given."""
        return {} if drawing.look.threshold is not None else {"threshold": self.floor}

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        front, back = front_and_back_um(drawing)
        label = f"depth of the maximum, {drawing.data.unit}"
        return Legend((Bar(colour_table(self.colours), (0.0, back - front), label),), common_words(drawing))


@mode("emission")
class Emission(RayMode):
    """Sum of the values along each ray, as if they shone and nothing absorbed; farther ones fainter with --fade."""

    kind, snippet = cpu.SUM, "cast_sum.glsl"

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        front, back = front_and_back_um(drawing)
        fade = -np.log1p(-min(drawing.look.fade, 0.999)) / (back - front)
        gain = (drawing.look.contrast or 1.0) / densest_um(canvas, drawing, band)
        return {
            **super().numbers(canvas, drawing, band),
            "gain": gain,
            "fade_per_um": float(fade),
            "front_um": front,
        }

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        words = common_words(drawing)
        if drawing.look.fade:
            words += (f"{drawing.look.fade:.0%} of the light is lost from front to back",)
        bars = tuple(replace_label(bar(band), f"Σ {band.name}, densest = 1") for band in drawing.data.bands)
        return Legend(bars, words)


@mode("glow")
class Glow(Emission):
    """Edges shine: the strength of the gradient as emission."""

    def prepared(self, canvas: Canvas, band: Band) -> Band:  # noqa: D102
        return canvas.keep("edges", (band,), lambda: derived(band, edge_strength(band.values), "edge strength"))  # type: ignore[no-any-return]


@mode("absorption")
class Absorption(RayMode):
    """Light from behind absorbed by the values, I/I0 = exp(-k Σ value · length), lengths exact in every voxel."""

    kind, snippet, shade, exact, one_band = cpu.ABSORB, "cast_sum.glsl", THROUGH, True, True

    def numbers(self, canvas: Canvas, drawing: Drawing, band: Band) -> dict[str, Any]:  # noqa: D102
        gain = drawing.look.contrast or DENSEST_DEPTH / densest_um(canvas, drawing, band)
        return {**super().numbers(canvas, drawing, band), "gain": gain}

    def legend(self, drawing: Drawing) -> Legend:  # noqa: D102
        band = drawing.data.bands[0]
        contrast = drawing.look.contrast
        words = (
            f"k = {contrast:.4g} per {drawing.data.unit} of full value"
            if contrast
            else "densest columns let 5 % through"
        )
        return Legend((Bar(band_colours(band), (0.0, 1.0), "I/I0"),), (words,))


@mode("cellophane")
class Cellophane(Absorption):
    """Local variance in 3×3×3 voxels as what absorbs: surfaces as if of clear film."""

    def prepared(self, canvas: Canvas, band: Band) -> Band:  # noqa: D102
        return canvas.keep("variance", (band,), lambda: derived(band, local_deviation(band.values), "local deviation"))  # type: ignore[no-any-return]


def derived(band: Band, values: Array, name: str) -> Band:
    """Return values that are not negative, as a band of the same type with limits of their own."""
    full = FULL[str(band.values.dtype)]
    top = float(np.percentile(values, DENSEST_PERCENT)) or 1.0
    scaled = np.rint(np.clip(values * (full / top), 0, full)).astype(band.values.dtype)
    return replace(band, values=scaled, limits=(0.0, full), name=name, unit="")


def local_deviation(values: Array) -> NDArray[np.float32]:
    """Return the standard deviation in 3×3×3 voxels."""
    exact = values.astype(np.float32)
    mean = ndimage.uniform_filter(exact, 3)
    return np.asarray(np.sqrt(np.maximum(ndimage.uniform_filter(exact * exact, 3) - mean * mean, 0)), np.float32)


def edge_strength(values: Array) -> NDArray[np.float32]:
    """Return the size of the gradient by Sobel's masks."""
    exact = values.astype(np.float32)
    return np.asarray(np.sqrt(sum(ndimage.sobel(exact, axis) ** 2 for axis in range(3))), np.float32)


def densest_um(canvas: Canvas, drawing: Drawing, band: Band) -> float:
    """Return Σ value · length, in full values · µm, of the densest columns along the planes' axis."""

    def make() -> float:
        low, high = band.limits
        columns = (np.mean(band.values, axis=0, dtype=np.float64) - low) / (high - low)
        return max(float(np.percentile(columns, DENSEST_PERCENT)), 1e-3) * float(drawing.data.size_um[2])

    return float(canvas.keep("densest", (band, drawing.data), make))


def replace_label(made: Bar, label: str) -> Bar:
    """Return a bar from 0 to 1 with another label."""
    return replace(made, limits=(0.0, 1.0), label=label)
