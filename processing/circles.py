"""Circles that the planes of a volume show of its features, and the sizes of balls found from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.features import add_up
from processing.labels import components
from processing.measure_plots import BORDER, INSIDE, LINE, entitled, plotted
from processing.planes import slabs
from processing.result_folder import csv_bytes
from processing.unfold import CLASSES, Unfolded, unfold

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from processing.neighbours import Spacing
    from processing.planes import Planes

    Array = NDArray[Any]

FILES = ("circles.csv", "ball_sizes.csv", "ball_sizes.png", "ball_sizes.svg")


@dataclass(frozen=True, eq=False)
class BallSizes:
    """Sizes of balls from circles in two ways, and of features directly, all over the same classes.

    Attributes
    ----------
    circles : array (n, 3)
        Section, diameter in µm, and how many circles each stands for.
    found, textbook : Unfolded
        By expectation and maximisation with smoothing, and by Saltykov's subtraction.
    direct_per_um3 : array (classes,)
        Features that the border does not cut, each standing for those of its size that it does.
    """

    circles: Array
    found: Unfolded
    textbook: Unfolded
    direct_per_um3: Array


def ball_sizes(labels: Planes, spacing_um: Spacing) -> BallSizes:
    """Measure the circles of every plane and find the sizes of balls from them.

    Raises
    ------
    InputError
        ``circles``: too few.
    """
    planes = ((start + k, plane) for start, slab in slabs(labels) for k, plane in enumerate(slab))
    circles = np.concatenate([_of_plane(plane, number, spacing_um) for number, plane in planes])
    whole = add_up(labels, None, spacing_um)
    diameters = np.cbrt(6 * whole.sums[:, 0] * np.prod(spacing_um) / np.pi)
    stands_for = _stands_for(whole.spans, labels.shape)
    top = max([*circles[:, 1], *diameters[stands_for > 0], 0]) * (1 + 1e-9)
    edges = np.linspace(0, max(top, 1e-12), CLASSES + 1)
    area = float(np.prod(labels.shape)) * spacing_um[1] * spacing_um[2]
    volume = area * spacing_um[0]
    direct, _ = np.histogram(diameters, edges, weights=stands_for)
    found, textbook = (
        unfold(circles[:, 1], area, weights=circles[:, 2], edges_um=edges, method=method)
        for method in ("ems", "saltykov")
    )
    return BallSizes(circles, found, textbook, direct / volume)


def _of_plane(plane: Array, number: int, spacing_um: Spacing) -> Array:
    """Return section, diameter and weight of the circles of a plane that its border does not cut."""
    apart, count = components(plane[None], by_value=True)
    if not count:
        return np.empty((0, 3))
    sums = add_up(apart, None)
    diameters = np.sqrt(4 * sums.sums[:, 0] * spacing_um[1] * spacing_um[2] / np.pi)
    weights = _stands_for(sums.spans, apart.shape)
    rows = np.column_stack([np.full(len(diameters), float(number)), diameters, weights])
    return np.asarray(rows[weights > 0])


def _stands_for(spans: Array, shape: tuple[int, ...]) -> Array:
    """Return how many of its size each stands for, 0 where the border cuts it (Miles 1974, Lantuéjoul 1980)."""
    deep = np.array(shape) > 1
    inside = ((spans[:, :3] > 0) & (spans[:, 3:] < np.array(shape) - 1)) | ~deep
    room = np.array(shape) - 1 - (spans[:, 3:] - spans[:, :3] + 1)
    share = np.where(deep, np.maximum(room, 1) / np.array(shape), 1.0).prod(axis=1)
    return np.where(inside.all(axis=1), 1 / share, 0.0)


def files(sizes: BallSizes, unit: str) -> dict[str, bytes]:
    """Encode circles and sizes as tables, and draw the sizes."""
    short = "um" if unit == "µm" else unit
    edges, found, textbook = sizes.found.edges_um, sizes.found, sizes.textbook
    columns = [f"from_{short}", f"to_{short}", *(f"{name}_per_{short}3" for name in ("unfolded", "standard_error"))]
    columns += [f"{name}_per_{short}3" for name in ("saltykov", "direct")]
    ways = (found.per_um3, found.error_per_um3, textbook.per_um3, sizes.direct_per_um3)
    rows = zip(edges[:-1], edges[1:], *ways, strict=True)
    return {
        "circles.csv": csv_bytes(["section", f"diameter_{short}", "stands_for"], sizes.circles.tolist()),
        "ball_sizes.csv": csv_bytes(columns, [list(map(float, row)) for row in rows]),
        **_drawn(sizes, unit),
    }


def _drawn(sizes: BallSizes, unit: str) -> dict[str, bytes]:
    def draw(axes: Axes) -> None:
        edges = sizes.found.edges_um
        middle, width = (edges[1:] + edges[:-1]) / 2, float(edges[1] - edges[0])
        axes.bar(middle, sizes.direct_per_um3, 0.9 * width, color="#cccccc", label="direct")
        bars = sizes.found.error_per_um3
        axes.errorbar(middle, sizes.found.per_um3, bars, fmt="o", color=INSIDE, markersize=3, label="from circles")
        axes.plot(middle, sizes.textbook.per_um3, "x", color=BORDER, markersize=4, label="Saltykov")
        axes.axvline(sizes.found.mean_um, color=LINE, linewidth=0.8)
        axes.set(xlabel=f"diameter, {unit}", ylabel=f"per {unit}³ and class")
        entitled(axes, "Sizes of balls")

    return plotted(draw, "ball_sizes")
