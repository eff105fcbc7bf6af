"""Extended focus, range, deblurring and resampling block by block give what they give in memory."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile
import zarr
from scipy import ndimage

from devices.cli import run
from processing import blockwise, resample_blocks
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

RNG = np.random.default_rng(71)


def process(what: str, data: Path, out: Path, *words: str) -> int:
    return run(["process", what, str(data), "-o", str(out), "-q", *words])


def report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def same_files(one: Path, other: Path) -> None:
    """The files of two folders are equal byte for byte, but for times and memory in reports."""
    names = report(one)["files"]
    assert report(other)["files"] == names
    assert sorted(p.name for p in other.iterdir()) == sorted(names)
    for name in names:
        if name.endswith(".zarr"):
            pixels = [np.asarray(zarr.open_array(folder / name / "0", mode="r")[:]) for folder in (one, other)]
            np.testing.assert_array_equal(*pixels)
            assert (one / name / "zarr.json").read_bytes() == (other / name / "zarr.json").read_bytes()
        elif name.endswith(".ome.tif"):
            np.testing.assert_array_equal(*(tifffile.imread(folder / name) for folder in (one, other)))
        elif name != "report.json":
            assert (one / name).read_bytes() == (other / name).read_bytes(), name


def test_threads_read_the_planes_they_asked_for(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "stack.tif") as file:
        for k in range(40):
            file.write(np.full((100, 100), k, np.uint16), contiguous=True)
    stack = open_stack(tmp_path / "stack.tif")
    with ThreadPoolExecutor(8) as pool:
        for _ in range(5):
            assert [set(plane.ravel()) for plane in pool.map(stack.plane, range(40))] == [{k} for k in range(40)]


# -- cubic voxels


@pytest.fixture
def uneven(tmp_path: Path) -> Path:
    """A stack whose planes are 2 µm apart, pixels 0.5 µm."""
    grey = np.clip(100 + 400 * ndimage.gaussian_filter(RNG.normal(size=(7, 20, 26)), 1.2), 0, 255).astype(np.uint8)
    np.save(tmp_path / "grey.npy", grey)
    np.save(tmp_path / "colour.npy", np.stack([grey, grey // 2, 255 - grey], -1))
    return tmp_path


SIZES = ["--step-um", "2", "--pixel-um", "0.5"]


@pytest.mark.parametrize(
    ("name", "words"),
    [("grey", ["--method", "cubic", "--side-um", "0.7"]), ("colour", []), ("grey", ["--method", "bin"])],
)
def test_cubic_voxels_are_the_same_slab_by_slab(name: str, words: list[str], uneven: Path, monkeypatch) -> None:
    monkeypatch.setattr(resample_blocks, "MOST_PLANES", 4)
    data = uneven / f"{name}.npy"
    assert process("resample", data, uneven / "whole", *SIZES, *words) == 0
    assert process("resample", data, uneven / "blocks", *SIZES, *words, "--memory", "100GB") == 0
    assert report(uneven / "blocks")["blocks"] == {"memory": "100GB"}
    same_files(uneven / "whole", uneven / "blocks")


def test_resampling_that_was_left_goes_on(uneven: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(resample_blocks, "MOST_PLANES", 4)
    monkeypatch.setattr(resample_blocks, "at_once", lambda _: 1)
    linear = [*SIZES, "--method", "linear"]
    data, out, words = uneven / "grey.npy", uneven / "out", [*linear, "--memory", "100GB"]
    done: list[int] = []
    honest = resample_blocks.CubicSlabs.do

    def do(self, k):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(k)
        return honest(self, k)

    monkeypatch.setattr(resample_blocks.CubicSlabs, "do", do)
    assert process("resample", data, out, *words) == 130
    assert {path.name for path in out.iterdir()} == {".blocks"}
    assert process("resample", data, out, *words) == 2
    assert "blocks-left" in capsys.readouterr().err
    assert process("resample", data, out, *words, "--side-um", "1", "--resume") == 2
    assert "different: side_um" in capsys.readouterr().err
    torn = out / ".blocks/resampled/resampled.ome.zarr/0/c/0/0/8/0/0"
    torn.parent.mkdir(parents=True, exist_ok=True)
    torn.write_bytes(b"half a shard")
    monkeypatch.setattr(blockwise, "COMPILING_MB", 99_000)  # less memory is left now: it is cut as it was
    monkeypatch.setattr(resample_blocks.CubicSlabs, "do", lambda self, k: done.append(k) or honest(self, k))
    assert process("resample", data, out, *words, "--resume") == 0
    assert sorted(done) == list(range(7))
    assert process("resample", data, uneven / "whole", *linear) == 0
    same_files(uneven / "whole", out)


@pytest.mark.parametrize(("memory", "code"), [("1MB", "memory"), ("much", "memory")])
def test_too_little_memory_for_a_plane_is_told(memory: str, code: str, uneven: Path, capsys) -> None:
    assert process("resample", uneven / "grey.npy", uneven / "out", *SIZES, "--memory", memory) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1
