"""Extended focus, range, deblurring and resampling block by block give what they give in memory."""

from __future__ import annotations

import errno
import json
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile
import zarr
from scipy import ndimage

from devices.cli import run
from devices.errors import StoreError
from processing import (
    blockwise,
    deblur_blocks,
    deblur_tiles,
    focus_blocks,
    outputs,
    resample_blocks,
    slabs,
)
from processing.pictures import preview
from processing.pieces import percentiles, ranked
from processing.psf import Optics, modelled
from processing.stack import open_stack
from sim.scenes.beads import cells

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


# -- extended focus and range

SIDE = (133, 517)


def relief(colour: bool, planes: int = 5) -> np.ndarray:
    """Rough ground that rises to the right under a lamp that changes; what is off focus is blurred."""
    texture = RNG.normal(size=SIDE)
    texture[40:, 100:250] *= 0.05
    height = np.linspace(0.4, planes - 1.4, SIDE[1])
    seen = []
    levels = np.stack([ndimage.gaussian_filter(texture, s) for s in (0.3, 1, 2, 4)])
    for z in range(planes):
        off = np.clip(np.abs(height - z) * 1.2, 0, 2.999)
        low = off.astype(int)
        rows = np.arange(SIDE[0])[:, None], np.arange(SIDE[1])
        sharp = levels[(low, *rows)] * (1 - off % 1) + levels[(low + 1, *rows)] * (off % 1)
        seen.append((100 + 25 * sharp) * (1 + 0.03 * z) + RNG.normal(size=SIDE))
    grey = np.clip(np.array(seen), 0, 255).astype(np.uint8)
    grey[2, 50:90, 50:90] = 255
    return np.stack([grey, grey // 2, 255 - grey], -1) if colour else grey


FOCUSED = [
    ("brightfield", True, ["--band", "green", "--step-um", "0.5"]),
    ("brightfield", False, ["--register", "on"]),
    ("transparent", False, []),
    ("confocal", True, ["--step-um", "2"]),
    ("threshold", False, ["--threshold", "130"]),
]


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 128 pixels, and maps drawn in a moment."""
    monkeypatch.setattr(focus_blocks, "CORNER_PX", dict.fromkeys(focus_blocks.CORNER_PX, 128))
    monkeypatch.setattr(focus_blocks, "tile_sides", lambda *_: range(128, 0, -128))
    for name in ("range_map", "confidence_map", "width_map"):
        monkeypatch.setattr(outputs, name, lambda values, *_: preview(np.nan_to_num(values)))


@pytest.mark.parametrize(("method", "colour", "words"), FOCUSED)
def test_focus_is_the_same_tile_by_tile(
    method: str, colour: bool, words: list[str], tmp_path: Path, small_tiles: None
) -> None:
    np.save(tmp_path / "stack.npy", relief(colour))
    words = ["--method", method, *words]
    assert process("focus", tmp_path / "stack.npy", tmp_path / "whole", *words) == 0
    assert process("focus", tmp_path / "stack.npy", tmp_path / "blocks", *words, "--memory", "100GB") == 0
    one, other = report(tmp_path / "whole"), report(tmp_path / "blocks")
    assert other.pop("blocks")["tile_px"] == 128
    for numbers in (one, other):
        for name in ("seconds", "peak_memory_mb"):
            numbers.pop(name)
        numbers["range"] = {k: pytest.approx(v, rel=1e-6, abs=1e-6) for k, v in numbers["range"].items()}
    assert {k: v for k, v in one.items() if k != "range"} == {k: v for k, v in other.items() if k != "range"}
    same_files(tmp_path / "whole", tmp_path / "blocks")


def test_focus_that_was_left_goes_on_with_the_tiles_that_are_missing(
    tmp_path: Path, small_tiles: None, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(focus_blocks, "at_once", lambda _: 1)
    np.save(tmp_path / "stack.npy", relief(colour=False)[:3])
    data, out, words = tmp_path / "stack.npy", tmp_path / "out", ["--memory", "100GB", "--register", "off"]
    done: list[int] = []
    honest = focus_blocks.Measured.do

    def do(self, k):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(k)
        return honest(self, k)

    monkeypatch.setattr(focus_blocks.Measured, "do", do)
    assert process("focus", data, out, *words) == 130
    assert process("focus", data, out, *words) == 2
    assert "blocks-left" in capsys.readouterr().err
    (out / ".blocks/measured/range-3.npy").write_bytes(b"half a tile")
    monkeypatch.setattr(focus_blocks.Measured, "do", lambda self, k: done.append(k) or honest(self, k))
    assert process("focus", data, out, *words, "--resume") == 0
    assert sorted(done) == list(range(10))
    assert process("focus", data, tmp_path / "whole", "--register", "off") == 0
    same_files(tmp_path / "whole", out)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--memory", "1MB"], "memory"),
        (["--memory", "100GB", "--fill"], "blockwise"),
        (["--memory", "100GB", "--method", "confocal", "--tilt-deg", "30"], "blockwise"),
        (["--memory", "100GB", "--method", "threshold"], "focus-threshold"),
    ],
)
def test_focus_that_cannot_go_tile_by_tile_is_told(words: list[str], code: str, tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "stack.npy", RNG.integers(0, 200, (3, 40, 50)).astype(np.uint8))
    assert process("focus", tmp_path / "stack.npy", tmp_path / "out", *words) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
def test_percentiles_are_those_of_all_values(count: int) -> None:
    values = np.concatenate([RNG.normal(size=count) * 10.0 ** RNG.integers(-9, 9), [0.0, -0.0]]).astype(np.float32)
    values[: count // 3] = values[0]
    chunks = np.array_split(values, min(count, 5))
    at = [0, 1, 37.5, 50, 99, 100]
    np.testing.assert_allclose(percentiles(lambda: chunks, at), np.percentile(values, at), rtol=1e-6)
    assert ranked(lambda: chunks, range) == sorted(values)


# -- deblurring

LENS = ["--na", "1", "--wavelength-um", "0.525", "--index", "1.33", "--pixel-um", "0.12", "--step-um", "0.3"]


@pytest.fixture
def cells_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A blurred stack, to be cut into six tiles whether in memory or by blocks; one plane of it is lost."""
    psf = modelled(Optics(1.0, 0.525, 1.33), (0.3, 0.12, 0.12), (5, 9, 9))
    stack = cells(3, psf, (11, 50, 70), level=2000).seen
    stack[8] = 100
    np.save(tmp_path / "cells.npy", stack)
    tifffile.imwrite(tmp_path / "psf.tif", psf, photometric="minisblack")
    monkeypatch.setattr(deblur_tiles, "tile_side", lambda *_: 25)
    monkeypatch.setattr(deblur_blocks, "tile_sides", lambda _: [25])
    return tmp_path / "cells.npy"


def deblurred(data: Path, out: Path, *words: str) -> int:
    return process("deblur", data, out, *LENS, "--psf", str(data.parent / "psf.tif"), "--steps", "6", *words)


@pytest.mark.parametrize("method", ["richardson-lucy", "van-cittert"])
def test_tiles_are_deblurred_the_same_by_blocks(method: str, cells_seen: Path) -> None:
    folder = cells_seen.parent
    assert deblurred(cells_seen, folder / "memory", "--method", method) == 0
    assert deblurred(cells_seen, folder / "blocks", "--method", method, "--memory", "100GB") == 0
    one, other = report(folder / "memory"), report(folder / "blocks")
    assert other.pop("blocks") == {"memory": "100GB"}
    for numbers in (one, other):
        for name in ("seconds", "peak_memory_mb"):
            numbers.pop(name)
    assert one == other
    assert one["tiles"] == 6
    assert any("plane 8 is one grey value" in note for note in one["notes"])
    same_files(folder / "memory", folder / "blocks")


def test_deblurring_that_was_left_goes_on(cells_seen: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(deblur_blocks, "at_once", lambda _: 1)
    folder, done = cells_seen.parent, []
    honest = deblur_blocks.Restoring.do

    def do(self, k):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(k)
        return honest(self, k)

    monkeypatch.setattr(deblur_blocks.Restoring, "do", do)
    assert deblurred(cells_seen, folder / "out", "--memory", "100GB") == 130
    assert deblurred(cells_seen, folder / "out", "--memory", "100GB", "--background", "3", "--resume") == 2
    assert "different: background" in capsys.readouterr().err
    monkeypatch.setattr(deblur_blocks.Restoring, "do", lambda self, k: done.append(k) or honest(self, k))
    assert deblurred(cells_seen, folder / "out", "--memory", "100GB", "--resume") == 0
    assert sorted(done) == list(range(6))
    assert deblurred(cells_seen, folder / "memory") == 0
    same_files(folder / "memory", folder / "out")


@pytest.mark.parametrize(
    ("words", "code"), [(["--memory", "100GB", "--method", "wiener"], "blockwise"), (["--memory", "1MB"], "memory")]
)
def test_deblurring_that_cannot_go_tile_by_tile_is_told(words: list[str], code: str, cells_seen: Path, capsys) -> None:
    assert deblurred(cells_seen, cells_seen.parent / "out", *words) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1


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
    taken_mb = 99_500 - blockwise.peak_memory_mb()  # little is left now of what there was: it is cut as before
    monkeypatch.setattr(blockwise, "COMPILING_MB", taken_mb)
    monkeypatch.setattr(resample_blocks.CubicSlabs, "do", lambda self, k: done.append(k) or honest(self, k))
    assert process("resample", data, out, *words, "--resume") == 0
    assert sorted(done) == list(range(7))
    assert process("resample", data, uneven / "whole", *linear) == 0
    same_files(uneven / "whole", out)


@pytest.mark.parametrize(("memory", "code"), [("1MB", "memory"), ("much", "memory")])
def test_too_little_memory_for_a_plane_is_told(memory: str, code: str, uneven: Path, capsys) -> None:
    assert process("resample", uneven / "grey.npy", uneven / "out", *SIZES, "--memory", memory) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1


def test_a_full_disk_is_told_and_what_is_done_is_gone_on_with(uneven: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(resample_blocks, "MOST_PLANES", 1)
    monkeypatch.setattr(resample_blocks, "at_once", lambda _: 1)
    words = [*SIZES, "--method", "bin", "--memory", "100GB"]
    honest, done = slabs.write_plane, []

    def write_plane(image, layout, k, plane):
        if len(done) == 4:
            raise OSError(errno.ENOSPC, "no space")
        done.append(k)
        honest(image, layout, k, plane)

    monkeypatch.setattr(slabs, "write_plane", write_plane)
    assert process("resample", uneven / "grey.npy", uneven / "out", *words) == StoreError.exit_code
    said = capsys.readouterr().err
    assert "disk-full" in said
    assert "--resume" in said
    monkeypatch.setattr(slabs, "write_plane", lambda *a: done.append(a[2]) or honest(*a))
    assert process("resample", uneven / "grey.npy", uneven / "out", *words, "--resume") == 0
    assert sorted(done) == list(range(7))


@pytest.mark.parametrize("command", ["focus", "resample"])
def test_a_store_that_is_half_written_is_one_clear_line(command: str, uneven: Path, capsys) -> None:
    assert process("resample", uneven / "grey.npy", uneven / "made", *SIZES) == 0
    image = uneven / "made" / "resampled.ome.zarr"
    shard = next(path for path in sorted((image / "0" / "c").rglob("0/3/0/0")) if path.is_file())
    shard.write_bytes(shard.read_bytes()[:-9])
    capsys.readouterr()
    assert process(command, image, uneven / "out", "--memory", "100GB") == 2
    assert capsys.readouterr().err.count("error[input-damaged]") == 1


def test_operators_that_have_a_command_of_their_own_name_it(uneven: Path, capsys) -> None:
    words = [
        "process",
        "volume",
        "volume.cubic",
        str(uneven / "grey.npy"),
        "-o",
        str(uneven / "out"),
        "--memory",
        "1GB",
    ]
    assert run([*words, *SIZES]) == 2
    assert "process resample STACK" in capsys.readouterr().err
