"""Simulated specimens are what their truth says, as measured."""

from __future__ import annotations

import json

import pytest

from devices.cli import run
from processing.grey_volume import GreyVolume, read_volume
from processing.measuring import Question, measure_volume
from sim.scenes import specimens


@pytest.mark.parametrize("name", ["knot", "braid", "hollow"])
def test_specimens_have_the_size_and_topology_they_claim(name: str, tmp_path, capsys) -> None:
    file = tmp_path / f"{name}.ome.tif"
    assert run(["sim", "specimen", name, "-o", str(file)]) == 0
    truth = json.loads((tmp_path / f"{name}.ome.json").read_text())
    volume = read_volume(file)
    assert volume.spacing_um == (1, 1, 1)
    found = measure_volume(volume, Question("127"))
    assert len(found.table["feature"]) == truth["features"]
    assert found.numbers["euler_number"].value == truth["euler"]
    assert found.table["volume_facets_um3"].sum() == pytest.approx(truth["volume_um3"], rel=0.01)
    assert found.table["surface_um2"].sum() == pytest.approx(truth["surface_um2"], rel=0.015)
    assert run(["sim", "specimen", name, "-o", str(file)]) == 2
    assert "output-exists" in capsys.readouterr().err


def test_two_phases_have_the_surface_of_a_random_field() -> None:
    grey, truth = specimens.phases()
    found = measure_volume(GreyVolume(grey, (1.0, 1.0, 1.0)), Question("127"))
    assert found.numbers["volume_fraction"].value == pytest.approx(0.5, abs=0.03)
    surface = found.numbers["surface_per_volume_facets_per_um"].value
    assert surface == pytest.approx(truth["surface_per_volume_per_um"], rel=0.05)


@pytest.mark.parametrize("name", ["vessels", "dendrites"])
def test_trees_are_one_part_without_loops(name: str) -> None:
    shape = specimens.SHAPES[name]()
    found = measure_volume(GreyVolume(specimens.drawn(shape, (1.0, 1.0, 1.0), size_um=72)), Question("127"))
    assert found.numbers["parts"].value == 1
