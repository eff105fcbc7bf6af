"""Range images on paper: contour maps, profiles along lines, stacked profiles; and the numbers behind them.

Lines of equal height come in two kinds: along the edges of pixels, between those below and those above, where nothing
is interpolated; and straight through pixels, the height taken as bilinear between their centres (marching squares, by
the library that matplotlib draws with). Pixel (row, column) is centred at (row, column) times the size of a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import contourpy
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy import ndimage

from acquire.words import spanned
from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.heights import Heights

    Array = NDArray[Any]
    Picture = NDArray[np.uint8]
    Line = tuple[tuple[float, float], tuple[float, float]]

Edges = Literal["interpolated", "pixels"]
DOTS_PER_INCH = 100
ABOUT_LEVELS, MOST_LEVELS = 10, 500
NICE = (1.0, 2.0, 2.5, 5.0, 10.0)
TIE = 1e-9  # a height that equals a level counts as above it
STACK_SHARE = 0.5  # of the whole range of heights between one stacked profile and the next, over their number


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a line.

    Attributes
    ----------
    ends : ((x, y), (x, y))
        Where it begins and ends.
    distance, height : array (n,)
        From the beginning, and there; NaN where nothing is known.
    """

    ends: Line
    distance: NDArray[np.float64]
    height: NDArray[np.float64]


def profile(heights: Heights, ends: Line) -> Profile:
    """Return the heights along a line, bilinear between pixels, about one for each pixel it crosses.

    Parameters
    ----------
    ends : ((x, y), (x, y))
        In the unit of the heights, from the centre of the first pixel.

    Raises
    ------
    InputError
        The line leaves the image, or is none.
    """
    (x0, y0), (x1, y1) = ends
    down, across = heights.pixel
    rows, columns = heights.values.shape
    inside = all(0 <= x <= (columns - 1) * across + TIE and 0 <= y <= (rows - 1) * down + TIE for x, y in ends)
    length = math.hypot(x1 - x0, y1 - y0)
    if not (inside and length > 0):
        raise InputError(
            f"the line from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) {heights.unit} is not within the image.",
            fix=f"x from 0 to {(columns - 1) * across:.5g}, y from 0 to {(rows - 1) * down:.5g} {heights.unit}",
            code="heights-line",
        )
    count = max(math.ceil(math.hypot((x1 - x0) / across, (y1 - y0) / down)) + 1, 2)
    t = np.linspace(0.0, 1.0, count)
    places = np.array([(y0 + t * (y1 - y0)) / down, (x0 + t * (x1 - x0)) / across])
    sampled = ndimage.map_coordinates(heights.values.astype(np.float64), places, order=1, mode="nearest")
    return Profile(ends, t * length, sampled)


def nice_increment(heights: Heights) -> float:
    """Return the distance of about ten lines of equal height: 1, 2, 2.5 or 5 times a power of ten."""
    low, high = heights.limits
    wanted = (high - low) / ABOUT_LEVELS
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * min(NICE, key=lambda nice: abs(math.log(nice * power / wanted)))


def levels(heights: Heights, increment: float) -> NDArray[np.float64]:
    """Return the multiples of an increment between the lowest and the highest; raises `InputError` if too many."""
    low, high = heights.limits
    if not (math.isfinite(increment) and increment > 0 and (high - low) / increment <= MOST_LEVELS):
        raise InputError(
            f"lines every {increment:g} {heights.unit} between {low:.4g} and {high:.4g} {heights.unit} make no map.",
            fix=f"an increment such as {nice_increment(heights):g}",
            code="heights-increment",
        )
    return np.arange(math.floor(low / increment) + 1, math.ceil(high / increment), dtype=np.float64) * increment


def contour_lines(heights: Heights, level: float, edges: Edges = "interpolated") -> list[NDArray[np.float64]]:
    """Return the lines of one height as arrays (n, 2) of x, y in the unit of the heights.

    Along the edges of pixels every piece is a line of its own of two points.
    """
    down, across = heights.pixel
    if edges == "pixels":
        return [piece * (across, down) for piece in _edges(heights.values >= level - TIE, np.isfinite(heights.values))]
    lines = contourpy.contour_generator(z=np.ma.masked_invalid(heights.values.astype(np.float64))).lines(level)
    return [np.asarray(line, np.float64) * (across, down) for line in lines]


def _edges(above: Array, known: Array) -> NDArray[np.float64]:
    """Return the sides, (n, 2, 2) of x, y in pixels, between known pixels that are above and that are not."""
    rows, columns = np.nonzero((above[:, 1:] != above[:, :-1]) & known[:, 1:] & known[:, :-1])
    upright = np.stack([np.stack([columns + 0.5, rows - 0.5], -1), np.stack([columns + 0.5, rows + 0.5], -1)], 1)
    rows, columns = np.nonzero((above[1:] != above[:-1]) & known[1:] & known[:-1])
    level = np.stack([np.stack([columns - 0.5, rows + 0.5], -1), np.stack([columns + 0.5, rows + 0.5], -1)], 1)
    return np.concatenate([upright, level]).astype(np.float64)


def contour_map(
    heights: Heights, increment: float, *, edges: Edges = "interpolated", filled: bool = True, colours: str = "viridis"
) -> Picture:
    """Draw lines of equal height at multiples of an increment, labelled and coloured; returns RGB, (h, w, 3) uint8."""
    at = levels(heights, increment)
    figure, axes = _map(heights)
    low, high = heights.limits
    span = {"vmin": low, "vmax": high, "cmap": colours}
    if filled:
        bounds = np.concatenate([[low], at, [high]])
        bands = bounds[np.clip(np.searchsorted(at, heights.values, side="right"), 0, len(bounds) - 1)]
        image = axes.imshow(np.where(np.isfinite(heights.values), bands, np.nan), extent=_extent(heights), **span)
        figure.colorbar(image, label=f"height, {heights.unit}", shrink=0.9)
    lines = {float(level): contour_lines(heights, level, edges) for level in at}
    shades = colormaps[colours]
    for level, found in lines.items():
        ink = "black" if filled else shades((level - low) / (high - low))
        axes.add_collection(LineCollection(found, colors=[ink], linewidths=0.7))
        _label(axes, level, found, heights, increment)
    kind = "interpolated" if edges == "interpolated" else "along the edges of pixels"
    axes.set_title(
        f"Lines every {increment:g} {heights.unit}, {kind}; {spanned(low, high)} {heights.unit}", fontsize=10
    )
    return _drawn(figure)


def profile_picture(heights: Heights, profiles: Sequence[Profile], colours: str = "viridis") -> Picture:
    """Draw where the lines lie, and the heights along each; returns RGB, (h, w, 3) uint8."""
    figure = Figure(figsize=(11, 4.6), dpi=DOTS_PER_INCH, layout="constrained")
    where, along = figure.subplots(1, 2, width_ratios=(1, 1.4))
    image = where.imshow(heights.values, extent=_extent(heights), cmap=colours)
    figure.colorbar(image, ax=where, label=f"height, {heights.unit}", shrink=0.8)
    for k, each in enumerate(profiles):
        (x0, y0), (x1, y1) = each.ends
        where.plot([x0, x1], [y0, y1], color=f"C{k + 1}", marker="o", markersize=3)
        along.plot(
            each.distance, each.height, color=f"C{k + 1}", label=f"{k + 1}: ({x0:.4g}, {y0:.4g}) – ({x1:.4g}, {y1:.4g})"
        )
    _axes(where, heights.unit)
    along.set_xlabel(f"along the line, {heights.unit}")
    along.set_ylabel(f"height, {heights.unit}")
    along.set_title(_stretch_words(figure, along), fontsize=9)
    along.legend(fontsize=8)
    along.grid(alpha=0.3)
    return _drawn(figure)


def stacked_picture(heights: Heights, count: int = 40) -> Picture:
    """Draw profiles of evenly spaced rows one behind the other, each hiding what is behind it; returns RGB."""
    down, across = heights.pixel
    rows = np.unique(np.linspace(0, heights.values.shape[0] - 1, count).round().astype(int))
    low, high = heights.limits
    lift = (high - low) * STACK_SHARE * 4 / len(rows)
    x = np.arange(heights.values.shape[1]) * across
    figure = Figure(figsize=(9, 7), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    for k, row in enumerate(rows):
        base = (len(rows) - k) * lift
        axes.fill_between(x, base + heights.values[row] - low, base - lift, color="white", zorder=k, linewidth=0)
        axes.plot(x, base + heights.values[row] - low, color="black", linewidth=0.7, zorder=k + 0.5)
    step = down * (rows[1] - rows[0])
    axes.set_title(
        f"{len(rows)} rows, {step:.4g} {heights.unit} apart, each {lift:.3g} {heights.unit} lower than the one behind",
        fontsize=9,
    )
    axes.set_xlabel(f"x, {heights.unit}")
    axes.set_ylabel(f"height, {heights.unit}, lifted row by row")
    axes.set_ylim(0, (len(rows) + 1) * lift + high - low)
    return _drawn(figure)


def _map(heights: Heights) -> tuple[Figure, Any]:
    rows, columns = (n * p for n, p in zip(heights.values.shape, heights.pixel, strict=True))
    inches = 8 / max(rows, columns)
    size = (max(columns * inches, 3) + 2.2, max(rows * inches, 2) + 1.3)
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    left, right, bottom, top = _extent(heights)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    _axes(axes, heights.unit)
    return figure, axes


def _axes(axes: Any, unit: str) -> None:
    axes.set_xlabel(f"x, {unit}")
    axes.set_ylabel(f"y, {unit}")


def _extent(heights: Heights) -> tuple[float, float, float, float]:
    (down, across), (rows, columns) = heights.pixel, heights.values.shape
    return -across / 2, (columns - 0.5) * across, (rows - 0.5) * down, -down / 2


def _label(axes: Any, level: float, lines: list[Array], heights: Heights, increment: float) -> None:
    """Write the height on the longest line of a level."""
    line = max(lines, key=lambda each: float(np.abs(np.diff(each, axis=0)).sum()), default=None)
    if line is None:
        return
    size = max(n * p for n, p in zip(heights.values.shape, heights.pixel, strict=True))
    short = float(np.abs(np.diff(line, axis=0)).sum()) < size / 15 and len(lines) < 10
    if short:
        return
    x, y = line[len(line) // 2]
    places = max(-math.floor(math.log10(increment)) + (increment / 10 ** math.floor(math.log10(increment)) % 1 > 0), 0)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.6, "pad": 0.6}
    axes.text(x, y, f"{level:.{places}f}", fontsize=6, ha="center", va="center", color="black", bbox=box)


def _stretch_words(figure: Figure, axes: Any) -> str:
    """Return by how much heights are stretched beside lengths on paper."""
    figure.draw_without_rendering()
    box = axes.get_window_extent()
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    stretch = (box.height / (y1 - y0)) / (box.width / (x1 - x0))
    return f"heights drawn × {stretch:.3g} as large as lengths"


def _drawn(figure: Figure) -> Picture:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()
