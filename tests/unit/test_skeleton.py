"""Skeletons of shapes whose graphs are known: balls, bars, rings, crosses, trees, grids."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy import ndimage
from skimage.measure import euler_number

from devices.cli import run
from devices.errors import InputError
from processing.skeleton import END, LINK, NODE, graph

RNG = np.random.default_rng(49)


def tube(points: list[tuple[float, float, float]], radius: float, shape: tuple[int, int, int]) -> np.ndarray:
    """All voxels within ``radius`` of the straight lines between points."""
    z, y, x = np.mgrid[: shape[0], : shape[1], : shape[2]]
    inside = np.zeros(shape, bool)
    for a, b in zip(np.array(points[:-1]), np.array(points[1:]), strict=True):
        way = b - a
        t = np.clip(((z - a[0]) * way[0] + (y - a[1]) * way[1] + (x - a[2]) * way[2]) / (way @ way), 0, 1)
        near = sum((axis - a[i] - t * way[i]) ** 2 for i, axis in enumerate((z, y, x)))
        inside |= near <= radius**2
    return inside


def ring(shape: tuple[int, int, int], radius: float, thick: float) -> np.ndarray:
    z, y, x = np.mgrid[: shape[0], : shape[1], : shape[2]]
    middle = [(n - 1) / 2 for n in shape]
    return (np.hypot(y - middle[1], x - middle[2]) - radius) ** 2 + (z - middle[0]) ** 2 <= thick**2


def counts(mask: np.ndarray, **how: float) -> dict[str, int]:
    kinds, branches, nodes, _, parts, loops, _ = graph(mask, **how)
    told = {kind: nodes.column("kind").count(kind) for kind in ("node", "end", "point", "ring")}
    assert set(np.unique(kinds)) <= {0, LINK, NODE, END}
    assert not (kinds[~mask] > 0).any()
    return {**told, "branches": len(branches.rows), "parts": int(parts), "loops": int(loops)}


SHAPE = (15, 40, 44)
Y = (7, 20, 22)
TREE = tube([(7, 4, 22), Y, (7, 34, 8)], 3, SHAPE) | tube([Y, (7, 34, 36)], 3, SHAPE)


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        (tube([(7, 20, 8), (7, 20, 36)], 3, SHAPE), {"node": 0, "end": 2, "branches": 1, "parts": 1, "loops": 0}),
        (TREE, {"node": 1, "end": 3, "branches": 3, "parts": 1, "loops": 0}),
        (ring(SHAPE, 12, 3), {"node": 0, "end": 0, "ring": 1, "branches": 1, "parts": 1, "loops": 1}),
        (
            ring(SHAPE, 12, 2.5) | tube([(7, 20, 4), (7, 20, 40)], 2.5, SHAPE),
            {"node": 2, "end": 2, "parts": 1, "loops": 2, "branches": 5},
        ),
    ],
    ids=["bar", "tree", "ring", "ring with a bar"],
)
def test_the_graph_of_a_known_shape(mask: np.ndarray, expected: dict[str, int]) -> None:
    found = counts(mask)
    assert {name: found[name] for name in expected} == expected


def test_branches_of_a_tree_have_their_lengths_and_thickness() -> None:
    _, branches, nodes, *_ = graph(TREE, (2.0, 0.5, 0.5))
    arms = [16 * 0.5, np.hypot(14, 14) * 0.5, np.hypot(14, 14) * 0.5]
    assert sorted(branches.column("length_um")) == pytest.approx(sorted(arms), abs=1.8)  # ends are thinned away
    middle = next(row for row in nodes.rows if row[1] == "node")
    assert middle[2:5] == pytest.approx((14.0, 10.0, 11.0), abs=1.0)
    assert all(1.0 <= radius <= 2.2 for radius in branches.column("radius_um"))


def test_a_ring_is_as_long_as_its_circle() -> None:
    _, branches, *_ = graph(ring(SHAPE, 12, 3))
    assert branches.column("length_um")[0] == pytest.approx(2 * np.pi * 12, rel=0.1)


def test_bumps_are_pruned_and_true_branches_stay() -> None:
    bumpy = TREE | tube([(7, 10, 22), (7, 10, 28)], 1, SHAPE) | tube([(7, 30, 12), (7, 25, 7)], 1, SHAPE)
    assert counts(bumpy, prune=0)["end"] > 3
    assert counts(bumpy, prune=2.5) == counts(TREE, prune=2.5)


@pytest.mark.parametrize("seed", range(3))
def test_parts_and_loops_are_those_of_the_mask(seed: int) -> None:
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(16, 24, 28)), 1.6)
    mask = ndimage.binary_fill_holes(noise > 0.06)
    found = counts(mask, prune=0)
    parts = ndimage.label(mask, np.ones((3, 3, 3)))[1]
    assert found["parts"] == parts
    assert found["parts"] - found["loops"] == euler_number(mask, connectivity=3)


def test_cavities_are_told_since_their_shells_stay_surfaces() -> None:
    shell = np.pad(np.ones((9, 9, 9), bool), 2)
    assert graph(shell)[-1] == 0
    shell[5:8, 5:8, 5:8] = False
    assert graph(shell)[-1] == 1


def test_points_planes_and_what_cannot_be_thinned() -> None:
    speck = np.zeros((5, 6, 7), bool)
    speck[2, 3, 3] = True
    assert counts(speck) == {"node": 0, "end": 0, "point": 1, "ring": 0, "branches": 0, "parts": 1, "loops": 0}
    flat = np.zeros((1, 9, 20), bool)
    flat[0, 3:6, 2:18] = True
    assert counts(flat, prune=3)["branches"] == 1
    for mask, code in ((np.zeros((3, 3, 3), bool), "mask-empty"), (np.ones((3, 3, 3), bool), "mask-full")):
        with pytest.raises(InputError) as refused:
            graph(mask)
        assert refused.value.code == code


def test_the_command_leaves_tables_and_a_picture(tmp_path) -> None:
    np.save(tmp_path / "tree.npy", np.uint8(255) * TREE)
    assert run(["process", "volume", "skeleton.graph", str(tmp_path / "tree.npy"), "-o", str(tmp_path / "out")]) == 0
    with (tmp_path / "out" / "branches.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 3
    assert (tmp_path / "out" / "skeleton.png").exists()
