"""Pictures of a measurement: where the features are, how large, of what shape; as PNG and, of plots, as SVG."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from processing.pictures import DOTS_PER_INCH, captioned, nice_length, png_bytes, preview
from processing.planes import cut

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from processing.neighbours import Spacing
    from processing.planes import Planes

    Array = NDArray[Any]

CUT_PX = 420  # longer side of a cut
DEEPEST = 3.0  # times that, at most, along z
GAP_PX = 6
BAR_PX = 6  # wide, and away from the corner
GOLDEN = 0.381966  # of a turn: hues that stay apart
PLOT_INCH = (5.2, 3.6)
MARGINS = {"left": 0.16, "right": 0.95, "bottom": 0.14, "top": 0.91}
SVG_SEED = "stereotome"  # names within an SVG file stay the same from run to run
WIDE = 10.0  # sizes that differ more are drawn by their logarithms
ROUND, ROUND_UP_TO = (1.0, 2.0, 5.0), 300.0  # ticks, where sizes do not differ by more
KINDS = ["whole", "cut by the border"]
UNKNOWN_SHAPES = "no shape is known: the border cuts\nthe features, or they have too few voxels"
INSIDE, BORDER, LINE = "#2166ac", "#b2182b", "#d95f02"


def cuts(grey: Planes, labels: Planes, fullest: tuple[int, ...], spacing_um: Spacing, unit: str) -> bytes:
    """Draw cuts through one plane of each axis, outlines of features in colours, and a bar of known length; PNG."""
    xy, xz, yz = (_cut(grey, labels, axis, fullest[axis], spacing_um) for axis in range(3))
    yz = yz.transpose(1, 0, 2)
    white = np.uint8(255)
    top = np.concatenate([xy, np.full((xy.shape[0], GAP_PX, 3), white), _tall(yz, xy.shape[0])], axis=1)
    below = np.full((xz.shape[0], top.shape[1], 3), white)
    below[:, : xz.shape[1]] = xz
    whole = np.concatenate([top, np.full((GAP_PX, top.shape[1], 3), white), below])
    length = nice_length(labels.shape[2] * spacing_um[2] / 3)
    _bar(whole, xy.shape[0], max(1, round(length * _scale(labels.shape, spacing_um))))
    places = ", ".join(f"{axis} = {place}" for axis, place in zip("zyx", fullest, strict=True))
    return png_bytes(captioned(whole, f"bar: {_words(length, unit)}; cut at {places} (voxels from 0)"))


def _words(length: float, unit: str) -> str:
    return f"{length / 1000:g} mm" if unit == "µm" and length >= 1000 else f"{length:g} {unit}"


def _bar(picture: Array, below: int, length_px: int) -> None:
    """Draw a bar, white within black, into the lower left of the uppermost rows of a picture."""
    end = min(BAR_PX + length_px, picture.shape[1])
    picture[max(0, below - 3 * BAR_PX) : max(0, below - BAR_PX), BAR_PX - 2 : end + 2] = 0
    picture[max(0, below - 3 * BAR_PX + 2) : max(0, below - BAR_PX - 2), BAR_PX:end] = 255


def _scale(shape: tuple[int, ...], spacing_um: Spacing) -> float:
    """Return how many pixels of a picture a µm has."""
    deep, *across = (n * s for n, s in zip(shape, spacing_um, strict=True))
    return CUT_PX / max(*across, deep / DEEPEST)


def _tall(picture: Array, rows: int) -> Array:
    return picture[:rows] if len(picture) >= rows else np.pad(picture, [(0, rows - len(picture)), (0, 0), (0, 0)])


def _cut(grey: Planes, labels: Planes, axis: int, place: int, spacing_um: Spacing) -> NDArray[np.uint8]:
    """Return a cut across an axis as RGB, its pixels square; all three at one scale."""
    shown, numbers = preview(cut(grey, place, axis).astype(np.float32)), cut(labels, place, axis)
    a, b = (spacing_um[k] for k in range(3) if k != axis)
    scale = _scale(labels.shape, spacing_um)
    size = tuple(max(1, round(n * s * scale)) for n, s in ((numbers.shape[1], b), (numbers.shape[0], a)))
    picture = cv2.cvtColor(cv2.resize(shown, size, interpolation=cv2.INTER_LINEAR), cv2.COLOR_GRAY2RGB)
    large = cv2.resize(numbers.astype(np.float64), size, interpolation=cv2.INTER_NEAREST).astype(np.int64)
    edge = np.zeros(large.shape, bool)
    edge[:-1] |= large[:-1] != large[1:]
    edge[:, :-1] |= large[:, :-1] != large[:, 1:]
    own = np.maximum(large, np.maximum(np.roll(large, -1, 0), np.roll(large, -1, 1)))
    picture[edge] = colours(own[edge])
    return np.asarray(picture, np.uint8)


def colours(labels: Array) -> NDArray[np.uint8]:
    """Return a bright colour for each label, RGB."""
    if not labels.size:
        return np.empty((*labels.shape, 3), np.uint8)
    hues = np.asarray(labels * GOLDEN % 1.0 * 180, np.uint8)
    hsv = np.stack([hues, np.full_like(hues, 190), np.full_like(hues, 255)], axis=-1)
    return np.asarray(cv2.cvtColor(hsv.reshape(-1, 1, 3), cv2.COLOR_HSV2RGB).reshape(*hues.shape, 3), np.uint8)


def plotted(draw: Callable[[Axes], None], name: str) -> dict[str, bytes]:
    """Draw a plot as both kinds of file."""
    with mpl.rc_context({"svg.hashsalt": SVG_SEED, "font.size": 9}):
        figure = Figure(figsize=PLOT_INCH, dpi=DOTS_PER_INCH)
        figure.subplots_adjust(**MARGINS)  # an engine of lay-out takes a second
        draw(figure.add_subplot())
        FigureCanvasAgg(figure)
        png, svg = BytesIO(), BytesIO()
        figure.savefig(png, format="png")
        FigureCanvasSVG(figure)
        figure.savefig(svg, format="svg", metadata={"Date": None})
    return {f"{name}.png": png.getvalue(), f"{name}.svg": svg.getvalue()}


def entitled(axes: Axes, title: str) -> None:
    """Write title and key above a plot, where they cover nothing."""
    axes.set_title(title, loc="left")
    narrow = {"borderpad": 0.2, "columnspacing": 0.8, "handlelength": 1.2, "handletextpad": 0.4}
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, **narrow)


def grey_histogram(counts: Array, values: Array, threshold: float) -> dict[str, bytes]:
    """Draw the histogram of grey values with the threshold."""

    def draw(axes: Axes) -> None:
        there = np.flatnonzero(counts)
        part = slice(there[0], there[-1] + 1)
        axes.fill_between(values[part], counts[part], step="mid", color="#999999")
        axes.axvline(threshold, color=LINE, label=f"threshold {threshold:.5g}")
        axes.set(yscale="log", xlabel="grey value", ylabel="voxels")
        entitled(axes, "Grey values and threshold")

    return plotted(draw, "grey_values")


def size_histogram(diameters: Array, at_border: NDArray[np.bool_], unit: str) -> dict[str, bytes]:
    """Draw how many features have which size; those the border cuts are told apart."""

    def draw(axes: Axes) -> None:
        low, high, wide = _sizes_along(axes, diameters, unit)
        ends = (np.geomspace(low, high, 25) if wide else np.linspace(low, high if high > low else low + 1, 25)).tolist()
        parts = [diameters[~at_border], diameters[at_border]]
        axes.hist(parts, ends, stacked=True, color=[INSIDE, BORDER], label=KINDS)
        axes.set(ylabel="features")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        entitled(axes, "Sizes")

    return plotted(draw, "sizes")


def _sizes_along(axes: Axes, diameters: Array, unit: str) -> tuple[float, float, bool]:
    """Let sizes go along x, by their logarithms where they differ much; returns the ends, and whether they do."""
    low, high = float(diameters.min()), float(diameters.max())
    wide = high > WIDE * low > 0
    axes.set_xlabel(f"diameter of the ball of equal volume, {unit}")
    if wide:
        axes.set_xscale("log")
        axes.set_xlim(low / 1.2, high * 1.2)
        axes.xaxis.set_major_locator(LogLocator(subs=ROUND if high < ROUND_UP_TO * low else (1.0,)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    return low, high, wide


def size_and_shape(diameters: Array, sphericity: Array, at_border: NDArray[np.bool_], unit: str) -> dict[str, bytes]:
    """Draw shape over size, a point for each feature whose shape is known: the border does not cut it."""

    def draw(axes: Axes) -> None:
        _sizes_along(axes, diameters, unit)
        known = np.isfinite(sphericity) & ~at_border
        axes.plot(diameters[known], sphericity[known], ".", color=INSIDE, markersize=4)
        axes.axhline(1, color="#999999", linewidth=0.8)
        axes.set(ylabel="sphericity", title=f"Size and shape of {np.count_nonzero(known)} features")
        if not known.any():
            axes.text(0.5, 0.3, UNKNOWN_SHAPES, ha="center", va="center", transform=axes.transAxes)
        axes.margins(y=0.1)

    return plotted(draw, "size_and_shape")
