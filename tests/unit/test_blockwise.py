"""Slab by slab equals the whole, bit for bit, by threads and by workers of which one is killed; left and resumed."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import tifffile
import zarr
from scipy import ndimage

from acquire.ome_zarr import FocalArray
from devices.cli import run
from devices.errors import InputError
from processing import block_runners, blockwise, marked, slabs
from processing.labels import components
from processing.masks import threshold
from processing.stack import open_stack
from processing.volume_files import create_volume, levels_of, write_plane
from processing.volume_filters import sobel

RNG = np.random.default_rng(48)
SHAPE = (23, 20, 26)
GREY = np.clip(100 + 400 * ndimage.gaussian_filter(RNG.normal(size=SHAPE), 1.2), 0, 255).astype(np.uint8)
SIZES = ["--step-um", "1", "--pixel-um", "0.5"]
SPACING = (1.0, 0.5, 0.5)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    path = tmp_path / "grey.npy"
    np.save(path, GREY)
    return path


def process(data: Path, out: Path, *words: str) -> int:
    return run(["process", "volume", words[0], str(data), "-o", str(out), *SIZES, "-q", *words[1:]])


def image(out: Path, name: str = "volume", level: int = 0) -> np.ndarray:
    return np.asarray(zarr.open_array(out / f"{name}.ome.zarr" / str(level), mode="r")[0, 0])


@pytest.fixture
def small_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blockwise, "MOST_PLANES", 4)


PIPELINES = [
    ["filter.sobel"],
    ["filter.median:rule=6", "--then", "morphology.open:radius=2", "--then", "filter.variance"],
    ["mask.threshold:method=li", "--then", "label.components:rule=6"],
    ["filter.variance", "--then", "mask.threshold", "--then", "label.components:rule=18:least=4"],
    ["mask.threshold:above=120", "--then", "label.components", "--then", "label.components:by_value=true"],
    ["filter.frei_chen"],
]


@pytest.mark.parametrize("words", PIPELINES)
def test_slabs_equal_the_whole_bit_for_bit(words: list[str], data: Path, tmp_path: Path, small_slabs: None) -> None:
    assert process(data, tmp_path / "whole", *words) == 0
    assert process(data, tmp_path / "slabs", *words, "--memory", "100GB") == 0
    whole, slabs = (json.loads((tmp_path / name / "report.json").read_text()) for name in ("whole", "slabs"))
    assert slabs["blocks"]["planes"] == 4
    assert slabs["values"] == whole["values"]
    assert slabs["results"].keys() == whole["results"].keys()
    for name in whole["results"]:
        np.testing.assert_array_equal(image(tmp_path / "slabs", name), image(tmp_path / "whole", name))
        assert (tmp_path / "slabs" / f"{name}.png").exists()
    assert not list((tmp_path / "slabs").glob(".*"))


def test_bands_go_slab_by_slab(tmp_path: Path, small_slabs: None) -> None:
    path = tmp_path / "bands.ome.tif"
    tifffile.imwrite(path, np.stack([GREY, 255 - GREY], 1), ome=True, metadata={"axes": "ZCYX"})
    words = ["bands.boundaries:weights=1,2", "--bands", "0,1"]
    assert process(path, tmp_path / "whole", *words) == 0
    assert process(path, tmp_path / "slabs", *words, "--memory", "100GB") == 0
    np.testing.assert_array_equal(image(tmp_path / "slabs"), image(tmp_path / "whole"))


def test_a_job_that_was_left_goes_on_where_it_was(
    data: Path, tmp_path: Path, small_slabs: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = tmp_path / "out", ["filter.sobel", "--then", "mask.threshold", "--memory", "100GB"]
    done: list[Path] = []
    honest = slabs.LocalSteps.compute

    def compute(self, tile):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(tile.write[0])
        return honest(self, tile)

    monkeypatch.setattr(slabs.LocalSteps, "compute", compute)
    monkeypatch.setattr(blockwise, "plan_slabs", lambda *_: blockwise.Plan(side=4, workers=1))
    assert process(data, out, *words) == 130
    assert {path.name for path in out.iterdir()} == {".blocks"}
    monkeypatch.setattr(slabs.LocalSteps, "compute", honest)
    capsys.readouterr()
    assert process(data, out, *words) == 2
    assert "blocks-left" in capsys.readouterr().err
    assert process(data, out, "filter.median", "--memory", "100GB", "--resume") == 2
    assert "different: steps" in capsys.readouterr().err
    marks = {path: path.stat().st_mtime_ns for path in out.glob(".blocks/1-steps/part-*.json")}
    assert marks
    half = next(k for k in range(6) if not (out / ".blocks" / "1-steps" / f"part-{k}.json").exists())
    torn = out / ".blocks" / "1-steps" / "volume.ome.zarr" / "0" / "c" / "0" / "0" / str(4 * half) / "0"
    torn.mkdir(parents=True, exist_ok=True)
    (torn / "0").write_bytes(b"half a shard")
    redone: list[int] = []

    def counted(self, tile):
        redone.append(tile.write[0].start)
        return honest(self, tile)

    monkeypatch.setattr(slabs.LocalSteps, "compute", counted)
    assert process(data, out, *words, "--resume") == 0
    assert len(redone) == 6 - len(marks) + 6
    np.testing.assert_array_equal(image(out), threshold(sobel(GREY, SPACING))[0])


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["distance.map", "--memory", "100GB"], "blockwise"),
        (["filter.sobel", "--memory", "much"], "memory"),
        (["filter.sobel", "--memory", "1MB"], "memory"),
        (["filter.sobel", "--scheduler", "tcp://127.0.0.1:9"], "scheduler"),
    ],
)
def test_what_cannot_go_slab_by_slab_is_told(
    words: list[str], code: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(block_runners, "ANSWER_S", 0.5)
    assert process(data, tmp_path / "out", *words) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1


def test_slabs_are_cut_so_that_they_fit(data: Path) -> None:
    from processing.step_inputs import Choices, open_layers

    given = open_layers(data, Choices())
    base = (blockwise.peak_memory_mb() + blockwise.COMPILING_MB) * 1e6
    plane = SHAPE[1] * SHAPE[2] * (1 + blockwise.BYTES_PER_VOXEL)
    plan = blockwise.plan_slabs(given, 1, base + 2 * 5.5 * plane, 2)
    assert (plan.side, plan.workers) == (3, 2)
    assert blockwise.plan_slabs(given, 1, base + 3.5 * plane, 2).workers == 1
    with pytest.raises(InputError, match="do not hold a plane"):
        blockwise.plan_slabs(given, 1, base + 2.5 * plane, 2)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "uint32"])
def test_a_pyramid_halves_pixels_and_says_where_they_lie(dtype: str, tmp_path: Path) -> None:
    plane = RNG.integers(0, 250, (301, 530)).astype(dtype)
    layout = FocalArray(2, plane.shape, dtype, 0.0, 2.0, 0.5, levels=levels_of(plane.shape))
    create_volume(tmp_path / "volume.ome.zarr", "volume", layout)
    for k in range(2):
        write_plane(tmp_path / "volume.ome.zarr", layout, k, plane + k)
    assert [image(tmp_path, level=level).shape for level in range(3)] == [(2, 301, 530), (2, 151, 265), (2, 76, 133)]
    half = image(tmp_path, level=1)[0]
    if dtype == "uint32":
        np.testing.assert_array_equal(half, plane[::2, ::2])
    else:
        mean = plane[:300].reshape(150, 2, 265, 2).mean((1, 3), dtype=np.float64)
        np.testing.assert_allclose(half[:150], mean, atol=0 if dtype == "float32" else 0.51)
    ome = json.loads((tmp_path / "volume.ome.zarr" / "zarr.json").read_text())["attributes"]["ome"]
    scales = [d["coordinateTransformations"] for d in ome["multiscales"][0]["datasets"]]
    assert [s[0]["scale"][-1] for s in scales] == [0.5, 1.0, 2.0]
    assert [s[1]["translation"][-1] for s in scales] == [0.0, 0.25, 0.75]


STACKS = {"deblur": ["--na", "0.8", "--wavelength-um", "0.5", "--steps", "3"], "resample": []}
MADE = ("deblur0/deblurred.ome.tif", "resample0/resampled.ome.tif")


def _kill_the_first(stage, k):
    """Runs in a worker: the first that comes dies before its slab is marked, as if its power was cut."""
    once = Path(os.environ["KILL_ONCE"])
    try:
        once.touch(exist_ok=False)
    except FileExistsError:
        return marked.run_part(stage, k)
    os.kill(os.getpid(), signal.SIGKILL)
    return k


@pytest.mark.filterwarnings("ignore")  # of the cluster, about ports and workers that went
def test_workers_of_which_one_is_killed_give_the_same(
    data: Path, tmp_path: Path, small_slabs: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    monkeypatch.setenv("KILL_ONCE", str(tmp_path / "killed"))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    monkeypatch.setattr(block_runners, "run_part", _kill_the_first)
    words = ["mask.threshold:above=110", "--then", "label.components:rule=6"]
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        assert process(data, tmp_path / "out", *words, "--scheduler", cluster.scheduler_address) == 0
        assert (tmp_path / "killed").exists()
        for command, options in STACKS.items():
            for where in ([], ["--scheduler", cluster.scheduler_address]):
                asked = ["process", command, str(data), "-o", str(tmp_path / f"{command}{len(where)}"), *options]
                assert run([*asked, *SIZES, "-q", *where]) == 0
    mask = threshold(GREY, above=110)[0]
    np.testing.assert_array_equal(image(tmp_path / "out"), components(mask, rule=6)[0])
    for name in MADE:
        there = tmp_path / name.replace("0/", "2/")
        np.testing.assert_array_equal(tifffile.imread(there), tifffile.imread(tmp_path / name))


@pytest.mark.parametrize("memory", [[], ["--memory", "100GB"]])
def test_sizes_that_are_not_known_are_not_written(data: Path, tmp_path: Path, memory: list[str]) -> None:
    out = tmp_path / "out"
    assert run(["process", "volume", "filter.sobel", str(data), "-o", str(out), "-q", *memory]) == 0
    assert json.loads((out / "report.json").read_text())["spacing_um"] is None
    group = json.loads((out / "volume.ome.zarr" / "zarr.json").read_text())
    axes = group["attributes"]["ome"]["multiscales"][0]["axes"]
    assert not any("unit" in axis for axis in axes if axis["type"] == "space")
    again = open_stack(out / "volume.ome.zarr")
    assert again.pixel_um is None
    assert again.z_um is None
    if not memory:
        with tifffile.TiffFile(out / "volume.ome.tif") as file:
            assert "PhysicalSize" not in str(file.ome_metadata)
