"""What is measured of every feature of a labelled volume: size, place, axes, surface, shape, topology, brightness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing import feature_kernels as kernels
from processing.blocks import euler_table, surface_table
from processing.neighbours import CUBIC, Rule, Spacing, checked_spacing
from processing.planes import largest, slabs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from processing.facet_sums import FacetSums
    from processing.planes import Planes

    Array = NDArray[Any]

Table = dict[str, Any]  # of arrays, a column each
MOST_FEATURES = 2_000_000  # a table of more rows is noise that was labelled
AT_ONCE = 8192  # features whose outermost voxels are kept at once
FEW_VOXELS = 27  # triangles cut smaller features to less than they are, and their shapes are those of voxels
AXES = "zyx"
SPHERE = 36 * np.pi  # S³ / V² of a ball


@dataclass(frozen=True)
class Sums:
    """What was added up over all planes, a row for each label that there is.

    Attributes
    ----------
    labels : array (n,) int64
        The numbers.
    sums, spans, extremes : array
        As of `processing.feature_kernels.add_plane`.
    euler, area_um2 : array (n,) float64
        Euler number, and surface without the cuts at the border of the volume.
    """

    labels: Array
    sums: Array
    spans: Array
    extremes: Array
    euler: Array
    area_um2: Array

    @property
    def middles(self) -> Array:
        """Centroids in voxels, (n, 3)."""
        return np.asarray(self.sums[:, 1:4] / self.sums[:, :1])

    def spread(self, spacing_um: Spacing) -> Array:
        """Second moments about the centroid in µm², (n, 3, 3); a voxel spreads over a twelfth of its side squared."""
        count, middle, size = self.sums[:, 0], self.middles, np.array(spacing_um)
        spread = np.empty((len(count), 3, 3))
        for column, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)], start=4):
            part = self.sums[:, column] / count - middle[:, i] * middle[:, j] + (i == j) / 12
            spread[:, i, j] = spread[:, j, i] = part * size[i] * size[j]
        return spread


def add_up(
    labels: Planes,
    grey: Planes | None,
    spacing_um: Spacing = CUBIC,
    rule: Rule = 26,
    told: Callable[[int], None] | None = None,
) -> Sums:
    """Go through a labelled volume once and add up what each feature needs.

    Parameters
    ----------
    labels : array (z, y, x)
        Whole numbers, 0 for background.
    grey : array (z, y, x), optional
        Grey values; without them densities are 1.
    rule : 6, 18 or 26
        Under which voxels touch.
    told : callable, optional
        Told how many planes are done.

    Raises
    ------
    InputError
        ``labels-many``: more labels than a table can have.
    """
    count = checked_count(labels) + 1
    sums, spans = np.zeros((count, kernels.SUMS)), np.full((count, 6), np.iinfo(np.int64).max)
    spans[:, 3:] = -1
    extremes = np.tile([np.inf, -np.inf], (count, 1))
    euler, area = np.zeros(count), np.zeros(count)
    tables = np.stack([euler_table(rule) / 8, surface_table(spacing_um)])
    last = np.zeros(np.add(labels.shape[1:], 2), np.uint32)
    empty = np.zeros_like(last)
    for z, (plane, bright) in enumerate(_planes(labels, grey)):
        kernels.add_plane(plane[1:-1, 1:-1], bright, z, sums, spans, extremes)
        kernels.add_blocks(last, plane, z > 0, tables, euler, area)
        last = plane
        if told:
            told(z + 1)
    kernels.add_blocks(last, empty, False, tables, euler, area)  # noqa: FBT003  compiled code takes no keywords
    there = np.flatnonzero(sums[:, 0])
    return Sums(there, sums[there], spans[there], extremes[there], euler[there], area[there])


def checked_count(labels: Planes) -> int:
    """Return the largest label; raises `InputError` ``labels-many`` where a table cannot have so many."""
    count = largest(labels)
    if count > MOST_FEATURES:
        raise InputError(
            f"there are labels up to {count}; a table of more than {MOST_FEATURES} features is not made.",
            why="so many parts are noise that was told apart, or grey values that are no labels.",
            fix=("smooth the volume first", "drop the smallest: --smallest N", "leave out --labels"),
            code="labels-many",
        )
    return count


def _planes(labels: Planes, grey: Planes | None) -> Iterator[tuple[Array, Array]]:
    """Yield each plane of labels within a frame of 0, and its grey values."""
    for start, slab in slabs(labels):
        bright = np.ones(slab.shape, np.float32) if grey is None else grey[start : start + len(slab)]
        for plane, values in zip(slab, bright, strict=True):
            yield np.pad(plane.astype(np.uint32, copy=False), 1), np.asarray(values, np.float32)


@dataclass(frozen=True)
class Reach:
    """How far features reach.

    Attributes
    ----------
    length_um, breadth_um : array (n,)
        Largest dimension, and smallest width between parallel planes among those tried.
    """

    length_um: Array
    breadth_um: Array


@cache
def even_directions(count: int = 64) -> tuple[tuple[float, float, float], ...]:
    """Return directions spread evenly over half of a sphere, by the golden section, and the three axes."""
    k = np.arange(count) + 0.5
    z, turn = k / count, np.pi * (1 + 5**0.5) * k
    around = np.sqrt(1 - z**2)
    spread = np.stack([z, around * np.sin(turn), around * np.cos(turn)], axis=1)
    return tuple(map(tuple, np.concatenate([np.eye(3), spread]).tolist()))


def reach(labels: Planes, found: Sums, axes: Array, spacing_um: Spacing = CUBIC) -> Reach:
    """Measure length and breadth; ``axes`` (n, 3, 3) are each feature's own directions, a row each.

    The outermost voxels along all directions take three kilobytes for a feature, so that many features are taken in
    turns.
    """
    some = [slice(k, k + AT_ONCE) for k in range(0, max(len(axes), 1), AT_ONCE)]
    turns = [_reach(labels, found.labels[part], axes[part], spacing_um) for part in some]
    return Reach(*(np.concatenate(ends) for ends in zip(*turns, strict=True)))


def _reach(labels: Planes, wanted: Array, axes: Array, spacing_um: Spacing) -> tuple[Array, Array]:
    """Return length and breadth of some of the labels."""
    size = np.array(spacing_um)
    common = np.array(even_directions())
    rows = np.zeros(int(wanted.max(initial=0)) + 2, np.uint32)  # of each label; the last is for all that are higher
    rows[wanted] = np.arange(1, len(wanted) + 1)
    own = np.concatenate([np.zeros((1, 3, 3)), axes])
    span = np.tile([np.inf, -np.inf], (len(own), len(common) + 3, 1))
    places = np.zeros((len(own), len(common) + 3, 2, 3), np.int32)
    for start, slab in slabs(labels):
        for z, plane in enumerate(rows[np.minimum(slab, len(rows) - 1)], start):
            kernels.add_ends(plane, z, common * size, own * size, span, places)
    directions = np.concatenate([np.broadcast_to(common, (len(axes), *common.shape)), axes], axis=1)
    widths = span[1:, :, 1] - span[1:, :, 0] + np.linalg.norm(directions * size, axis=2)
    return kernels.longest(places[1:].reshape(len(axes), -1, 3), size), widths.min(axis=1)


def measured(
    labels: Planes,
    grey: Planes | None = None,
    spacing_um: Spacing | None = None,
    *,
    rule: Rule = 26,
    facets: FacetSums | None = None,
    told: Callable[[int], None] | None = None,
) -> Table:
    """Measure every feature.

    Parameters
    ----------
    labels : array (z, y, x)
        Whole numbers, 0 for background.
    grey : array (z, y, x), optional
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule : 6, 18 or 26
        Under which voxels touch, for the Euler number.
    facets : FacetSums, optional
        Areas and volumes from triangles between grey values, which are finer than those from voxels.
    told : callable, optional
        Told how many planes are done.

    Returns
    -------
    dict of arrays (n,)
        Columns in the order of the table; lengths in µm, places from the middle of the first voxel. ``counted`` are
        features that a tile of a larger specimen would count: of a feature on two tiles exactly one does.

    Raises
    ------
    InputError
        ``labels-many``, ``spacing``.
    """
    spacing = checked_spacing(spacing_um or CUBIC)
    found = add_up(labels, grey, spacing, rule, told)
    widths, axes = _axes(found.spread(spacing))
    spans = reach(labels, found, axes, spacing)
    cut = at_border(found.spans, labels.shape)
    table = {
        "feature": found.labels,
        "voxels": found.sums[:, 0].astype(np.int64),
        **_sizes(found, spacing, spans, facets, cut),
    }
    table |= _places(found, spacing) | _moments(widths, axes) | _brightness(found, grey)
    table["euler"] = found.euler.astype(np.int64)
    table["at_border"] = cut
    if facets is not None:
        table["volume_facets_um3"] = np.where(cut, np.nan, facets.volume_um3[found.labels])
    table["counted"] = (found.spans[:, 3:] < np.array(labels.shape) - 1)[:, np.array(labels.shape) > 1].all(axis=1)
    return table


def _sizes(found: Sums, spacing: Spacing, spans: Reach, facets: FacetSums | None, cut: Array) -> Table:
    volume, crofton = found.sums[:, 0] * np.prod(spacing), found.area_um2
    fine = np.zeros(len(volume), bool) if facets is None else found.sums[:, 0] >= FEW_VOXELS
    area = np.where(fine, 0 if facets is None else facets.area_um2[found.labels], crofton)
    known = np.where((area > 0) & ~cut & (found.sums[:, 0] >= FEW_VOXELS), area, np.nan)  # shape needs all the surface
    return {
        "volume_um3": volume,
        "surface_um2": area,
        "surface_crofton_um2": crofton,
        "length_um": spans.length_um,
        "breadth_um": spans.breadth_um,
        "diameter_um": np.cbrt(6 * volume / np.pi),
        "sphericity": np.cbrt(SPHERE * volume**2) / known,
        "compactness": np.cbrt(volume) / np.sqrt(known),
        "length_over_breadth": spans.length_um / spans.breadth_um,
    }


def _places(found: Sums, spacing: Spacing) -> Table:
    return {f"{axis}_um": found.middles[:, k] * spacing[k] for k, axis in enumerate(AXES)}


def _axes(spread: Array) -> tuple[Array, Array]:
    """Return lengths of axes, longest first, and directions; an ellipsoid of semi-axes a has second moments a² / 5."""
    values, vectors = np.linalg.eigh(spread)
    return np.sqrt(5 * np.maximum(values[:, ::-1], 0)) * 2, np.swapaxes(vectors[:, :, ::-1], 1, 2)


def _moments(widths: Array, axes: Array) -> Table:
    """Return the three axes of the ellipsoid with a feature's moments, and the direction of the longest."""
    table: Table = {f"axis{k + 1}_um": widths[:, k] for k in range(3)}
    longest = axes[:, 0] * np.where(axes[:, :1, 0] < 0, -1, 1)
    return table | {f"axis1_{axis}": longest[:, k] for k, axis in enumerate(AXES)}


def _brightness(found: Sums, grey: Planes | None) -> Table:
    if grey is None:
        return {}
    count, total, squares = found.sums[:, 0], found.sums[:, 10], found.sums[:, 11]
    mean = total / count
    return {
        "mean_density": mean,
        "integrated_density": total,
        "density_sd": np.sqrt(np.maximum(squares / count - mean**2, 0)),
        "density_min": found.extremes[:, 0],
        "density_max": found.extremes[:, 1],
    }


def at_border(spans: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which features touch the border of the volume, and so may go on outside.

    Along an axis of one plane only the others count: a single section cuts everything.
    """
    deep = np.array(shape) > 1
    low, high = spans[:, :3] == 0, spans[:, 3:] == np.array(shape) - 1
    return np.asarray(((low | high) & deep).any(axis=1))


def in_voxels(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rename the columns of a table that was measured in voxels."""
    return {name.replace("_um", "_voxels"): column for name, column in table.items()}
