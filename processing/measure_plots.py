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

from processing.pictures import DOTS_PER_INCH, png_bytes, preview

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from processing.neighbours import Spacing

    Array = NDArray[Any]

CUT_PX = 420  # longer side of a cut
GAP_PX = 6
GOLDEN = 0.381966  # of a turn: hues that stay apart
PLOT_INCH = (5.2, 3.6)
MARGINS = {"left": 0.16, "right": 0.97, "bottom": 0.14, "top": 0.91}
SVG_SEED = "stereotome"  # names within an SVG file stay the same from run to run
INSIDE, BORDER, LINE = "#2166ac", "#b2182b", "#d95f02"


def cuts(grey: Array, labels: Array, spacing_um: Spacing) -> bytes:
    """Draw three cuts through the fullest plane of each axis, outlines of features in colours; PNG."""
    xy, xz, yz = (_cut(grey, labels, axis, spacing_um) for axis in range(3))
    yz = yz.transpose(1, 0, 2)
    white = np.uint8(255)
    top = np.concatenate([xy, np.full((xy.shape[0], GAP_PX, 3), white), _tall(yz, xy.shape[0])], axis=1)
    below = np.full((xz.shape[0], top.shape[1], 3), white)
    below[:, : xz.shape[1]] = xz
    return png_bytes(np.concatenate([top, np.full((GAP_PX, top.shape[1], 3), white), below]))


def _tall(picture: Array, rows: int) -> Array:
    return picture[:rows] if len(picture) >= rows else np.pad(picture, [(0, rows - len(picture)), (0, 0), (0, 0)])


def fullest(labels: Array, axis: int) -> int:
    """Return the plane across an axis in which most is labelled; the middle one where all are equal."""
    others = tuple(a for a in range(3) if a != axis)
    counts = np.count_nonzero(labels, axis=others)
    best = np.flatnonzero(counts == counts.max())
    return int(best[np.abs(best - labels.shape[axis] // 2).argmin()])


def _cut(grey: Array, labels: Array, axis: int, spacing_um: Spacing) -> NDArray[np.uint8]:
    """Return a cut across an axis as RGB, its pixels square; all three at one scale."""
    place = fullest(labels, axis)
    shown = preview(np.take(grey, place, axis=axis).astype(np.float32))
    numbers = np.take(labels, place, axis=axis)
    a, b = (spacing_um[k] for k in range(3) if k != axis)
    scale = CUT_PX / max(n * s for n, s in zip(labels.shape[1:], spacing_um[1:], strict=True))
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


def grey_histogram(counts: Array, values: Array, threshold: float) -> dict[str, bytes]:
    """Draw the histogram of grey values with the threshold."""

    def draw(axes: Axes) -> None:
        there = np.flatnonzero(counts)
        part = slice(there[0], there[-1] + 1)
        axes.fill_between(values[part], counts[part], step="mid", color="#999999")
        axes.axvline(threshold, color=LINE, label=f"threshold {threshold:.5g}")
        axes.set(yscale="log", xlabel="grey value", ylabel="voxels", title="Grey values and threshold")
        axes.legend(loc="upper right")

    return plotted(draw, "grey_values")


def size_histogram(diameters: Array, cut: NDArray[np.bool_], unit: str) -> dict[str, bytes]:
    """Draw how many features have which size; those the border cuts are told apart."""

    def draw(axes: Axes) -> None:
        low, high = diameters.min(), diameters.max()
        wide = high > 10 * low > 0
        ends = (np.geomspace(low, high, 25) if wide else np.linspace(low, high if high > low else low + 1, 25)).tolist()
        axes.hist([diameters[~cut], diameters[cut]], ends, stacked=True, color=[INSIDE, BORDER], label=KINDS)
        axes.set(xlabel=f"diameter of the ball of equal volume, {unit}", ylabel="features", title="Sizes")
        if wide:
            axes.set_xscale("log")
        axes.legend(loc="upper right")

    return plotted(draw, "sizes")


KINDS = ["whole", "cut by the border"]


def size_and_shape(diameters: Array, sphericity: Array, cut: NDArray[np.bool_], unit: str) -> dict[str, bytes]:
    """Draw shape over size, a point for each feature whose shape is known."""

    def draw(axes: Axes) -> None:
        for chosen, colour, word in ((~cut, INSIDE, KINDS[0]), (cut, BORDER, KINDS[1])):
            axes.plot(diameters[chosen], sphericity[chosen], ".", color=colour, markersize=4, label=word)
        axes.axhline(1, color="#999999", linewidth=0.8)
        axes.set(xlabel=f"diameter of the ball of equal volume, {unit}", ylabel="sphericity", title="Size and shape")
        if diameters.max() > 10 * diameters.min() > 0:
            axes.set_xscale("log")
        axes.legend(loc="lower right")

    return plotted(draw, "size_and_shape")
