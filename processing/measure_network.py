"""The skeleton of features as a network: its nodes, branches and loops, and what of them the border cuts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.neighbours import CUBIC, Spacing
from processing.skeleton import BRANCH_COLUMNS, NODE_COLUMNS, drawn, net_of
from processing.stereology import Estimate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Rows = list[list[Any]]

PRUNE = 1.0  # branches with a free end that are shorter than their node is deep are cut: roughness makes them
FILES = ("branches.csv", "nodes.csv", "skeleton.png")
BRANCHES = ("feature", *BRANCH_COLUMNS, "cut_ends")
NODES = ("feature", *NODE_COLUMNS, "at_border")
SHARED = "; a branch counts half for each of its ends that the border does not cut"


@dataclass(frozen=True, eq=False)
class Network:
    """What the skeleton is.

    Attributes
    ----------
    branches, nodes : list of rows
        Columns as of `BRANCHES` and `NODES`.
    numbers : dict of Estimate
        Of the whole, by name with unit.
    columns : dict of arrays
        Nodes, ends, branches, and the length of these, of each feature.
    picture : array (rows, columns, 3) uint8
        The skeleton seen along z.
    notes : list of str
        What must be said.
    """

    branches: Rows
    nodes: Rows
    numbers: dict[str, Estimate]
    columns: dict[str, Array]
    picture: NDArray[np.uint8]
    notes: list[str]


def network(labels: Array, features: Array, spacing_um: Spacing = CUBIC, *, cavities: int = 0) -> Network:
    """Thin the features to lines and count.

    An end of a branch that is no farther from the border of the volume than from the surface of the feature is none:
    the border cuts the branch there. What is counted for the volume leaves such ends out and counts a branch half for
    each end that it has within, so that tiles of a specimen add up to the whole.

    Parameters
    ----------
    labels : array (z, y, x)
        Features; those that touch are thinned as one.
    features : array (n,)
        Numbers of the features, ascending.
    spacing_um : tuple of float
        Distance of voxels along (z, y, x).
    cavities : int
        Closed cavities of the features; shells around them cannot be thinned to lines.

    Raises
    ------
    InputError
        ``mask-full``: the features fill the volume.
    """
    inside = np.asarray(labels > 0)
    net, depth = net_of(inside, spacing_um, PRUNE)
    found, rows = net.nodes(), net.branch_table().rows
    kinds = np.array([kind for kind, *_ in found])
    owners: Array = np.asarray(labels[tuple(net.node_voxels().T)], np.int64)
    cut: Array = (kinds == "end") & _at_border(found, labels.shape, spacing_um)
    nodes = [[int(o), *row, bool(c)] for o, row, c in zip(owners, net.node_table().rows, cut, strict=True)]
    ends = np.array([row[2:4] for row in rows], np.int64).reshape(-1, 2)
    cut_ends: Array = cut[ends].sum(axis=1)
    of_branches = owners[ends[:, 0]].tolist()
    branches = [[o, *row, n] for o, row, n in zip(of_branches, rows, cut_ends.tolist(), strict=True)]
    lengths: Array = np.array([row[5] for row in rows], np.float64)
    share = len(rows) - cut_ends.sum() / 2
    numbers = _numbers(kinds, cut, lengths, share, net.parts_and_loops()[1], inside.size * float(np.prod(spacing_um)))
    columns = _columns(features, owners, kinds, cut, ends, lengths)
    return Network(branches, nodes, numbers, columns, drawn(net.kinds_in(inside.shape), depth), _notes(cavities))


def _at_border(nodes: list[Any], shape: tuple[int, ...], spacing_um: Spacing) -> NDArray[np.bool_]:
    """Tell which nodes are no farther from the border of the volume than from the surface."""
    place, reach = np.array([n[1] for n in nodes]).reshape(-1, 3), np.array([n[3] for n in nodes])
    size, deep = np.array(spacing_um), np.array(shape) > 1
    away = np.minimum(place, (np.array(shape) - 1) * size - place) + size / 2
    return np.asarray((away <= reach[:, None])[:, deep].any(axis=1))


def _numbers(kinds: Array, cut: Array, lengths: Array, share: float, loops: int, volume: float) -> dict[str, Estimate]:
    crossings = int((kinds == "node").sum())
    ends, points = int((kinds == "end").sum() - cut.sum()), int(np.isin(kinds, ("point", "ring")).sum())
    euler = crossings + ends + points - share
    return {
        "skeleton_nodes": Estimate(crossings, None, "where branches meet"),
        "skeleton_ends": Estimate(ends, None, "free ends"),
        "skeleton_ends_at_border": Estimate(int(cut.sum()), None, "no farther from the border than from the surface"),
        "skeleton_branches": Estimate(len(lengths), None, "between nodes and ends, and closed rings"),
        "skeleton_loops": Estimate(loops, None, "branches - nodes and ends + parts, as if nothing were outside"),
        "skeleton_length_um": Estimate(float(lengths.sum()), None, "along the voxels: up to 13 % too long if oblique"),
        "node_density_per_um3": Estimate(crossings / volume, None, "nodes / volume"),
        "branch_density_per_um3": Estimate(share / volume, None, f"branches / volume{SHARED}"),
        "length_density_per_um2": Estimate(float(lengths.sum()) / volume, None, "length / volume"),
        "skeleton_connectivity_density_per_um3": Estimate(
            (1 - euler) / volume, None, f"(1 - nodes and ends + branches) / volume{SHARED}"
        ),
    }


def _columns(features: Array, owners: Array, kinds: Array, cut: Array, ends: Array, lengths: Array) -> dict[str, Array]:
    """Count for each feature."""
    count = int(features.max()) + 1
    tallies = {
        "nodes": np.bincount(owners[kinds == "node"], minlength=count),
        "ends": np.bincount(owners[(kinds == "end") & ~cut], minlength=count),
        "branches": np.bincount(owners[ends[:, 0]], minlength=count),
        "branch_length_um": np.bincount(owners[ends[:, 0]], lengths, count),
    }
    return {name: tally[features] for name, tally in tallies.items()}


def _notes(cavities: int) -> list[str]:
    if not cavities:
        return []
    words = (
        "cavities cannot be thinned to lines: shells around them count as nodes, and loops of the skeleton are wrong"
    )
    return [f"{words} ({cavities} cavities); fill them first: --fill."]
