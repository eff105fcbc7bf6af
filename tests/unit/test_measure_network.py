"""Nodes, branches and loops of features: known specimens, what the border cuts, and what the command leaves."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from devices.cli import run
from processing.grey_volume import GreyVolume
from processing.measure_network import network
from processing.measuring import Question, measure_volume, with_network
from sim.scenes import shapes, specimens
from tests.unit.test_skeleton import SHAPE, TREE, ring, tube

if TYPE_CHECKING:
    from pathlib import Path

CUBES = (1.0, 1.0, 1.0)
ONE = np.array([1])


@pytest.mark.parametrize(
    ("name", "voxel_um", "expected"),
    [
        ("knot", 1.0, {"nodes": 0, "ends": 0, "branches": 1, "loops": 1}),
        ("braid", 1.0, {"nodes": 0, "ends": 6, "branches": 3, "loops": 0}),
        ("vessels", 0.85, {"nodes": 15, "ends": 17, "branches": 31, "loops": 0}),
    ],
)
def test_known_specimens_have_the_nodes_branches_and_loops_they_are_made_of(
    name: str, voxel_um: float, expected: dict[str, int]
) -> None:
    shape, spacing = specimens.SHAPES[name](), (voxel_um,) * 3
    volume = GreyVolume(shapes.drawn(shape, spacing), spacing)
    found = with_network(measure_volume(volume, Question("127")), volume)
    assert {key: found.numbers[f"skeleton_{key}"].value for key in expected} == expected
    assert found.numbers["skeleton_loops"].value == found.numbers["loops"].value
    density = found.numbers["connectivity_density_per_um3"].value
    assert found.numbers["skeleton_connectivity_density_per_um3"].value == pytest.approx(density)
    assert found.table["branches"].sum() == expected["branches"]
    assert found.table["ends"].sum() == expected["ends"]


@pytest.mark.parametrize("y", [9, 12, 15])
def test_branches_that_the_border_cuts_count_so_that_tiles_add_up(y: int) -> None:
    volume = float(TREE.size)
    whole = network(TREE.astype(int), ONE)
    tiles = [network(part.astype(int), ONE) for part in (TREE[:, :y], TREE[:, y:])]
    assert [tile.numbers["skeleton_ends_at_border"].value for tile in tiles] == [1, 1]
    shares = [
        t.numbers["branch_density_per_um3"].value * p.size
        for t, p in zip(tiles, (TREE[:, :y], TREE[:, y:]), strict=True)
    ]
    assert sum(shares) == pytest.approx(whole.numbers["branch_density_per_um3"].value * volume) == 3
    assert sum(t.numbers["skeleton_ends"].value for t in tiles) == whole.numbers["skeleton_ends"].value == 3
    assert [row[-1] for row in tiles[0].branches] == [1]


def test_each_feature_has_its_own_branches() -> None:
    bar = tube([(7, 20, 4), (7, 20, 40)], 2, SHAPE)
    labels = np.concatenate([4 * TREE, np.zeros((3, *SHAPE[1:]), int), 9 * ring(SHAPE, 12, 3), 0 * TREE, 2 * bar])
    found = network(labels, np.array([2, 4, 9]))
    assert found.columns["branches"].tolist() == [1, 3, 1]
    assert found.columns["nodes"].tolist() == [0, 1, 0]
    assert found.columns["ends"].tolist() == [2, 3, 0]
    assert sorted(row[0] for row in found.branches) == [2, 4, 4, 4, 9]
    assert found.columns["branch_length_um"].sum() == pytest.approx(sum(row[6] for row in found.branches))


def test_cavities_are_told(tmp_path: Path) -> None:
    shell = shapes.drawn(shapes.shell(9, 5), CUBES)
    volume = GreyVolume(shell, CUBES)
    found = with_network(measure_volume(volume, Question("127")), volume)
    assert any("cavities cannot be thinned" in note for note in found.notes)


def test_the_command_leaves_tables_of_branches_and_nodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "tree.npy", TREE.astype(np.uint8))
    words = ["measure", str(tmp_path / "tree.npy"), "-o", str(tmp_path / "out"), "--skeleton", "-q"]
    assert run([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {"branches.csv", "nodes.csv", "skeleton.png"} <= set(report["files"])
    assert report["numbers"]["skeleton_branches"]["value"] == 3
    assert "length_density_per_voxels2" in report["numbers"]
    branches = list(csv.DictReader((tmp_path / "out" / "branches.csv").read_text().splitlines()))
    assert len(branches) == 3
    assert {"feature", "kind", "length_voxels", "chord_voxels", "cut_ends"} <= set(branches[0])
    assert "longest branches" in (tmp_path / "out" / "report.html").read_text()
    assert run([*words, "--overwrite", "--memory", "9GB"]) == 2
    assert "error[blockwise]" in capsys.readouterr().err
