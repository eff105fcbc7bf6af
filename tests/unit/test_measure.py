"""Measurement of volumes against formulae: sizes, surfaces, topology, and what the command leaves."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import tifffile
from scipy import ndimage
from skimage.measure import euler_number

from devices.cli import run
from devices.errors import InputError
from processing.blocks import euler_table, surface_table
from processing.features import measured
from processing.grey_volume import GreyVolume
from processing.labels import components
from processing.measuring import Question, measure_volume
from processing.stereology import by_boundaries, by_intercepts, volume_fraction
from processing.whole import whole
from sim.scenes import shapes

RNG = np.random.default_rng(8)
CUBES, DEEP = (1.0, 1.0, 1.0), (2.0, 1.0, 1.0)
SOLIDS = {
    "ball": shapes.ball(16),
    "shell": shapes.shell(20, 8),
    "torus": shapes.turned(shapes.torus(22, 8), 1),
    "rod": shapes.turned(shapes.rod(12, 70), 2),
    "box": shapes.turned(shapes.box((60, 66, 70)), 3),
}


@pytest.mark.parametrize("spacing", [CUBES, DEEP])
@pytest.mark.parametrize("name", SOLIDS)
def test_volume_surface_and_topology_of_known_solids(name: str, spacing) -> None:
    solid = SOLIDS[name]
    found = measure_volume(GreyVolume(shapes.drawn(solid, spacing), spacing), Question("127"))
    table = {column: values[0] for column, values in found.table.items()}
    assert len(found.table["feature"]) == 1
    assert table["surface_um2"] == pytest.approx(solid.truth["surface_um2"], rel=0.005)
    assert table["volume_facets_um3"] == pytest.approx(solid.truth["volume_um3"], rel=0.002)
    assert table["euler"] == found.numbers["euler_number"].value == solid.truth["euler"]
    assert found.numbers["loops"].value == solid.truth.get("loops", 0)
    assert found.numbers["cavities"].value == solid.truth.get("cavities", 0)


def test_four_ways_to_measure_surface_agree_on_what_has_no_preferred_direction() -> None:
    solid = shapes.ball(20)
    found = measure_volume(GreyVolume(shapes.drawn(solid), CUBES), Question("127"))
    ways = [number.value for name, number in found.numbers.items() if name.startswith("surface_per_volume")]
    assert len(ways) == 4
    np.testing.assert_allclose(ways, np.mean(ways), rtol=0.004)
    assert not any("preferred" in note for note in found.notes)
    flat = measure_volume(GreyVolume(shapes.drawn(shapes.box((30, 30, 10))), CUBES), Question("127"))
    assert any("preferred" in note for note in flat.notes)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.85])
def test_euler_numbers_equal_those_of_scikit_image(share: float) -> None:
    mask = RNG.random((9, 10, 11)) < share
    assert whole(mask, rule=6).euler == euler_number(mask, 1)
    assert whole(mask, rule=26).euler == euler_number(mask, 3)


def test_the_border_is_taken_off_so_that_tiles_add_up_to_the_whole() -> None:
    pattern = np.tile(RNG.random((6, 5, 7)) < 0.4, (3, 3, 3))
    inner = pattern[6:13, 5:11, 7:15]  # one period and its far side: a tile that shares its sides
    share = whole(inner).euler_share
    grown = np.tile(pattern[:6, :5, :7], (7, 7, 7))
    per_tile = (whole(grown[: 6 * 6 + 1, : 5 * 6 + 1, : 7 * 6 + 1]).euler_share) / 6**3
    assert share == pytest.approx(per_tile, abs=1e-9)


def test_tables_of_blocks_say_what_is_known_of_one_voxel_and_of_a_plane() -> None:
    for rule in (6, 18, 26):
        assert sum(euler_table(rule)[1 << k] for k in range(8)) == 8
    assert surface_table(CUBES)[0] == surface_table(CUBES)[255] == 0


def test_each_feature_has_the_moments_and_densities_that_slow_sums_have() -> None:
    grey = ndimage.gaussian_filter(RNG.random((20, 24, 28)), 2).astype(np.float32)
    labels, count = components(grey > np.quantile(grey, 0.8), rule=26)
    spacing = (2.0, 0.5, 0.7)
    table = measured(labels, grey, spacing)
    assert len(table["feature"]) == count > 5
    for row, label in enumerate(table["feature"]):
        places = np.argwhere(labels == label)
        at = places * spacing
        values = grey[labels == label].astype(np.float64)
        assert table["voxels"][row] == len(places)
        assert table["integrated_density"][row] == pytest.approx(values.sum())
        assert table["density_sd"][row] == pytest.approx(values.std(), abs=1e-6)
        centroid = [table[f"{axis}_um"][row] for axis in "zyx"]
        np.testing.assert_allclose(centroid, at.mean(axis=0))
        spread = np.cov(at.T, bias=True).reshape(3, 3) + np.diag(np.square(spacing)) / 12
        axes = 2 * np.sqrt(5 * np.linalg.eigvalsh(spread)[::-1])
        np.testing.assert_allclose([table[f"axis{k}_um"][row] for k in (1, 2, 3)], axes)
        at_border = (places == 0).any() or (places == np.array(labels.shape) - 1).any()
        assert table["at_border"][row] == at_border
        assert table["euler"][row] == euler_number(labels == label, 3)


def test_length_and_breadth_of_a_box_and_of_a_turned_rod() -> None:
    labels = np.zeros((14, 28, 50), np.uint8)
    labels[2:12, 4:24, 5:45] = 1
    table = measured(labels, None, (2.0, 1.0, 1.0))
    assert table["length_um"][0] == pytest.approx(np.linalg.norm([20, 20, 40]), rel=0.02)
    assert table["breadth_um"][0] == pytest.approx(20)
    rod = shapes.drawn(shapes.turned(shapes.rod(5, 60), 5)) > 127
    table = measured(rod.astype(np.uint8))
    assert table["length_um"][0] == pytest.approx(np.hypot(60, 10), rel=0.015)
    assert table["breadth_um"][0] == pytest.approx(10, abs=1)  # a voxel


def test_lines_and_planes_of_one_voxel_thickness_are_no_trouble() -> None:
    plane = RNG.random((1, 12, 12)) < 0.5
    assert set(by_intercepts(whole(plane))) == {"y", "x"}
    assert set(by_boundaries(whole(plane))) == {"z"}
    found = measure_volume(GreyVolume(plane.astype(np.uint8)), Question())
    assert found.numbers["volume_fraction"].value == plane.mean()
    assert "diameter_voxels" in found.table


def test_the_counting_error_is_the_scatter_of_independent_specimens() -> None:
    estimates = []
    for seed in range(20):
        places = np.zeros((48, 48, 48), bool)
        rng = np.random.default_rng(seed)
        spots = rng.integers(0, 48, (rng.poisson(120), 3))
        places[tuple(spots.T)] = True
        estimates.append(volume_fraction(whole(ndimage.distance_transform_edt(~places) < 4)))
    scatter = np.std([estimate.value for estimate in estimates], ddof=1)
    claimed = np.median([estimate.error for estimate in estimates])
    assert 0.5 < claimed / scatter < 2


def test_features_are_counted_once_by_the_tiles_they_lie_on() -> None:
    mask = np.zeros((24, 24, 24), bool)
    mask[tuple(RNG.integers(1, 22, (40, 3)).T)] = True
    mask = ndimage.binary_dilation(mask)
    labels, count = components(mask, rule=26)
    counted = 0
    for z in (0, 12):
        tile, _ = components(mask[z : z + 13], rule=26)  # tiles share the plane between them
        counted += int(measured(tile)["counted"].sum())
    assert counted <= count
    assert counted == int(measured(labels)["counted"].sum()) + _split_by_plane(labels, 12)


def _split_by_plane(labels, z: int) -> int:
    """How many more parts there are when the volume is cut, of those that count."""
    whole_ones = set(np.unique(labels[:13])) & set(np.unique(labels[12:])) - {0}
    return sum(
        int(measured(components(labels[a:b] == k, rule=26)[0])["counted"].sum())
        for k in whole_ones
        for a, b in ((0, 13), (12, 24))
    ) - sum(int(measured((labels == k).astype(np.uint8))["counted"].sum()) for k in whole_ones)


def measure(tmp_path, values, *options: str) -> int:
    np.save(tmp_path / "data.npy", values)
    return run(["measure", str(tmp_path / "data.npy"), "-o", str(tmp_path / "out"), "--quiet", *options])


def test_the_command_leaves_tables_pictures_and_a_page(tmp_path, capsys) -> None:
    two = shapes.together([shapes.moved(shapes.ball(6), (-9, 0, 0)), shapes.moved(shapes.ball(4), (9, 3, 2))])
    grey = shapes.drawn(two, (1.0, 0.5, 0.5), size_um=40, noise=3)
    assert (
        measure(
            tmp_path, grey, "--pixel-um", "0.5", "--step-um", "1", "--threshold", "127", "--smallest", "20", "--json"
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["features"] == 2
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == sorted(report["files"])
    rows = list(csv.DictReader((out / "features.csv").read_text().splitlines()))
    table = pq.read_table(out / "features.parquet").to_pydict()
    assert [float(row["volume_um3"]) for row in rows] == pytest.approx(table["volume_um3"], rel=1e-5)
    truth = sorted(4 / 3 * np.pi * r**3 for r in (4, 6))
    assert sorted(table["volume_facets_um3"]) == pytest.approx(truth, rel=0.02)
    labels = tifffile.imread(out / "labels.ome.tif")
    assert np.bincount(labels.ravel())[1:].tolist() == table["voxels"]
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 4
    assert "µm" in page
    assert "http" not in page
    assert run(["measure", str(tmp_path / "data.npy"), "-o", str(out), "--quiet"]) == 2
    assert "output-exists" in capsys.readouterr().err


def test_labels_are_measured_as_they_are_and_densities_from_another_file(tmp_path, capsys) -> None:
    labels = np.zeros((6, 12, 12), np.uint32)
    labels[1:3, 1:4, 1:4], labels[3:5, 6:9, 6:9] = 7, 70000
    np.save(tmp_path / "grey.npy", np.full(labels.shape, 0.25, np.float32))
    grey = str(tmp_path / "grey.npy")
    assert measure(tmp_path, labels, "--labels", "--grey", grey, "--json") == 0
    assert json.loads(capsys.readouterr().out)["features"] == 2
    table = pq.read_table(tmp_path / "out" / "features.parquet").to_pydict()
    assert table["feature"] == [7, 70000]
    assert table["integrated_density"] == [18 * 0.25] * 2
    assert tifffile.imread(tmp_path / "out" / "labels.ome.tif").max() == 70000


def test_what_fills_the_frame_is_flagged(tmp_path, capsys) -> None:
    assert measure(tmp_path, np.full((5, 6, 7), 9, np.uint8), "--threshold", "3", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert any("fills the volume" in note for note in report["notes"])
    assert any("voxels" in note and "not known" in note for note in report["notes"])


NOISE = RNG.integers(0, 200, (6, 7, 8)).astype(np.uint8)
GAPS = np.where(NOISE > 190, np.nan, NOISE).astype(np.float32)


@pytest.mark.parametrize(
    ("values", "options", "code"),
    [
        (NOISE, ["--threshold", "250"], "mask-empty"),
        (np.full((4, 5, 6), 7, np.uint8), [], "threshold"),
        (NOISE, ["--threshold", "otus"], "operator-params"),
        (GAPS, [], "volume-nan"),
        (NOISE, ["--smallest", "100000"], "mask-empty"),
        (NOISE.astype(np.float32) + 0.5, ["--labels"], "labels-needed"),
        (np.full((2, 3, 5), 5_000_000, np.uint32), ["--labels"], "labels-many"),
        (NOISE, ["--pixel-um", "0", "--step-um", "1"], "spacing"),
        (np.zeros((4, 5, 6, 3), np.uint8), [], "volume-shape"),
        (NOISE.astype(np.complex128), [], "volume-shape"),
        (NOISE * 1e300, [], "volume-nan"),
        (NOISE, ["--smallest", "0"], "operator-params"),
        (NOISE, ["--threshold", "nan"], "threshold"),
    ],
)
def test_bad_input_is_one_clear_line(values, options, code: str, tmp_path, capsys) -> None:
    assert measure(tmp_path, values, *options) == 2
    assert f"error[{code}]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("shape", [(8, 1, 1), (1, 1, 8), (1, 9, 1), (1, 1, 1)])
def test_parts_of_a_line_are_those_that_touch_along_it(shape: tuple[int, int, int]) -> None:
    line = np.resize([1, 0, 1, 1, 0, 0, 1, 0, 1], shape)
    assert components(line, rule=26)[1] == components(line, rule=6)[1] == np.sum(np.diff(line.ravel(), prepend=0) == 1)


def test_features_that_large_triangles_miss_are_measured() -> None:
    values = np.zeros((9, 9, 9), np.uint8)
    values[3, 3, 3], values[5, 5, 7] = 90, 200
    found = measure_volume(GreyVolume(values, CUBES), Question("50"))
    assert found.table["voxels"].tolist() == [1, 1]
    assert found.numbers["surface_per_volume_facets_per_um"].value > 0


def test_features_of_few_voxels_have_no_shape() -> None:
    labels = np.zeros((8, 8, 12), np.uint8)
    labels[3, 3, 3], labels[2:5, 2:5, 6:9] = 1, 2
    assert np.isnan(measured(labels)["sphericity"]).tolist() == [True, False]


def test_wildly_uneven_voxels_and_tiny_features_are_flagged() -> None:
    values = np.zeros((6, 9, 9), np.uint8)
    values[2, 3, 3], values[4, 6, 6] = 200, 200
    found = measure_volume(GreyVolume(values, (40.0, 1.0, 1.0)), Question())
    assert any("40 times longer" in note for note in found.notes)
    assert any("fewer than 27" in note for note in found.notes)
    assert found.table["volume_um3"].tolist() == [40.0, 40.0]
    assert np.isfinite(found.table["length_um"]).all()


def test_too_many_labels_are_refused() -> None:
    with pytest.raises(InputError) as refused:
        measured(np.full((1, 2, 2), 3_000_000, np.uint32))
    assert refused.value.code == "labels-many"
