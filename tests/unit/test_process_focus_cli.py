"""``stereotome process focus`` through the real command: good stacks, and one clear line for each bad one."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.outputs import FILES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

PLANES = 9


def tilted_stack(dtype: type[np.unsignedinteger] = np.uint8) -> tuple[np.ndarray, np.ndarray]:
    """A textured plane that rises from plane 2 to plane 6 along x, and the planes a camera sees of it."""
    texture = np.random.default_rng(3).normal(size=(64, 96)).astype(np.float32)
    depth = np.linspace(2, 6, 96, dtype=np.float32)[np.newaxis].repeat(64, 0)
    blurred = [cv2.GaussianBlur(texture, (0, 0), s) if s else texture for s in np.arange(0, 5, 0.5)]
    scale = np.iinfo(dtype).max / 255
    planes = []
    for k in range(PLANES):
        level = np.abs(k - depth)
        low = np.clip((level * 2).astype(int), 0, 8)
        part = level * 2 - low
        stack = np.stack(blurred)
        near = np.take_along_axis(stack, low[np.newaxis], 0)[0]
        far = np.take_along_axis(stack, low[np.newaxis] + 1, 0)[0]
        planes.append(np.clip((128 + 30 * (near * (1 - part) + far * part)) * scale, 0, np.iinfo(dtype).max))
    return np.array(planes).astype(dtype), depth


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    planes, _ = tilted_stack()
    folder = tmp_path / "stack"
    folder.mkdir()
    for k, plane in enumerate(planes):
        cv2.imwrite(str(folder / f"plane_{k}.png"), plane)
    return folder


def focus(*arguments: object) -> int:
    return run(["process", "focus", *map(str, arguments)])


def test_a_folder_becomes_all_files_and_the_range_is_right(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert focus(stack, "-o", tmp_path / "out", "--step-um", 2.5) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    range_um = tifffile.imread(tmp_path / "out" / "range.tif")
    error = range_um[8:-8, 8:-8] - 2.5 * tilted_stack()[1][8:-8, 8:-8]
    assert np.median(np.abs(error)) < 0.25 * 2.5
    said = capsys.readouterr()
    assert "µm, sure in" in said.out
    assert str(tmp_path / "out" / "range.png") in said.out
    assert "100%" in said.err


def test_filled_holes_are_marked_and_a_stale_mark_goes(stack: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert focus(stack, "-o", out, "-q", "--method", "threshold", "--threshold", 190, "--fill") == 0
    marked, confidence = (tifffile.imread(out / f"{name}.tif") for name in ("filled", "confidence"))
    np.testing.assert_array_equal(marked == 255, confidence < 0.8)
    assert marked.any()
    assert np.isfinite(tifffile.imread(out / "range.tif")).all()
    assert focus(stack, "-o", out, "-q", "--method", "threshold", "--threshold", 190, "--overwrite") == 0
    assert not (out / "filled.tif").exists()
    assert np.isnan(tifffile.imread(out / "range.tif")).any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "threshold"], "needs a threshold"),
        (["--tilt-deg", 30], "cannot be measured from the side"),
        (["--tilt-deg", "nan", "--method", "confocal"], "angles that are no numbers"),
    ],
)
def test_senseless_methods_are_one_clear_line(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[object], words: str
) -> None:
    assert focus(stack, "-o", tmp_path / "out", *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_spacing_the_range_is_in_planes_and_said_so(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert focus(stack, "-o", tmp_path / "out", "--json") == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["unit"] == "plane"
    assert report["input"]["planes"] == PLANES
    assert "note: no spacing of planes is known" in said.err
    assert report["notes"] == [
        "no spacing of planes is known: depth is in planes counted from 0; give --step-um for µm."
    ]
    assert report["seconds"] >= 0
    assert report["peak_memory_mb"] > 10


def test_progress_off_a_terminal_is_a_plain_line_each_5_percent_and_quiet_is_quiet(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    focus(stack, "-o", tmp_path / "a")
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("measuring focus")]
    assert 2 < len(lines) <= 20
    assert lines[-1] == "measuring focus: 9 of 9 (100%)"
    focus(stack, "-o", tmp_path / "b", "--quiet")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("method", ["brightfield", "confocal"])
def test_colour_16_bit_and_both_methods(tmp_path: Path, method: str) -> None:
    planes, _ = tilted_stack(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", np.stack([planes] * 3, axis=-1), photometric="rgb")
    assert focus(tmp_path / "a.tif", "-o", tmp_path / "out", "--method", method) == 0
    image = tifffile.imread(tmp_path / "out" / "extended_focus.tif")
    assert (image.shape, image.dtype) == ((64, 96, 3), np.uint16)


def test_pixel_size_of_the_file_goes_into_the_results(tmp_path: Path) -> None:
    planes, _ = tilted_stack()
    metadata = {"axes": "ZYX", "PhysicalSizeX": 0.5, "PhysicalSizeZ": 2.0}
    tifffile.imwrite(tmp_path / "a.ome.tif", planes, ome=True, metadata=metadata)
    assert focus(tmp_path / "a.ome.tif", "-o", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["unit"], report["pixel_um"]) == ("um", 0.5)
    assert report["input"]["z_um"] == [2.0 * k for k in range(PLANES)]


def test_one_plane_is_its_own_extended_focus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plane = tilted_stack()[0][4]
    cv2.imwrite(str(tmp_path / "only.png"), plane)
    assert focus(tmp_path / "only.png", "-o", tmp_path / "out") == 0
    assert np.array_equal(tifffile.imread(tmp_path / "out" / "extended_focus.tif"), plane)
    assert "nothing can be said about depth" in capsys.readouterr().err


def cut_tiff(folder: Path) -> list[object]:
    tifffile.imwrite(folder / "cut.tif", tilted_stack()[0], photometric="minisblack")
    content = (folder / "cut.tif").read_bytes()
    (folder / "cut.tif").write_bytes(content[: len(content) // 2])
    return [folder / "cut.tif"]


def two_sizes(folder: Path) -> list[object]:
    cv2.imwrite(str(folder / "a1.png"), np.zeros((20, 30), np.uint8))
    cv2.imwrite(str(folder / "a2.png"), np.zeros((20, 31), np.uint8))
    return [folder]


def not_numbers(folder: Path) -> list[object]:
    np.save(folder / "a.npy", np.full((3, 20, 30), np.nan))
    return [folder / "a.npy"]


def two_series(folder: Path) -> list[object]:
    for name in ("w1_z1", "w1_z2", "w2_z1", "w2_z2"):
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((20, 30), np.uint8))
    return [folder]


def nan_step(folder: Path) -> list[object]:
    np.save(folder / "a.npy", np.zeros((3, 20, 30), np.uint8))
    return [folder / "a.npy", "--step-um", "nan"]


def minus_step(folder: Path) -> list[object]:
    return [*nan_step(folder)[:1], "--step-um=-2"]


def nothing_there(folder: Path) -> list[object]:
    return [folder / "nothing"]


def no_images(folder: Path) -> list[object]:
    return [folder]


BAD: dict[Callable[[Path], list[object]], str] = {
    cut_tiff: "input-damaged",
    two_sizes: "stack-shape",
    not_numbers: "stack-nan",
    two_series: "stack-channel",
    nan_step: "stack-spacing",
    minus_step: "stack-spacing",
    nothing_there: "input-missing",
    no_images: "stack-empty",
}


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.__name__)
def test_bad_input_is_one_clear_line_with_a_fix(
    bad: Callable[[Path], list[object]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    assert focus(*bad(tmp_path / "in"), "-o", tmp_path / "out") == 2
    said = capsys.readouterr()
    error = [line for line in said.err.splitlines() if line.startswith("error")]
    assert len(error) == 1
    assert error[0].startswith(f"error[{BAD[bad]}]: ")
    assert "  fix: " in said.err
    assert "Traceback" not in said.err
    assert said.out == ""
    assert not (tmp_path / "out").exists()


def test_results_in_the_way_are_noticed_before_the_work(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    focus(stack, "-o", tmp_path / "out")
    capsys.readouterr()
    assert focus(stack, "-o", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert said.startswith("error[output-exists]: ")
    assert "measuring" not in said
    assert focus(stack, "-o", tmp_path / "out", "--overwrite", "-q") == 0


def program(*arguments: object, limit_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run the program by itself, on request with a limit of file size in place of a full disk.

    The limit refuses the same writes and needs no mount; it must never hold for the tests' own process, whose report
    may go to a file.
    """
    limit = "" if limit_bytes is None else f"import resource as r; r.setrlimit(r.RLIMIT_FSIZE, ({limit_bytes},) * 2); "
    start = [sys.executable, "-c", f"{limit}from devices.cli import main; main()"]
    return subprocess.run([*start, "process", "focus", *map(str, arguments)], capture_output=True, text=True)


def test_a_full_disk_is_one_clear_line_and_leaves_earlier_results(stack: Path, tmp_path: Path) -> None:
    results = tmp_path / "out"
    assert program(stack, "-o", results, "-q").returncode == 0  # compiled kernels are on disk before it is full
    before = {path.name: path.read_bytes() for path in results.iterdir()}
    done = program(stack, "-o", results, "-q", "--overwrite", limit_bytes=6000)
    assert done.returncode == 6
    assert done.stderr.startswith("error[disk-full]: the disk of ")
    assert {path.name: path.read_bytes() for path in results.iterdir()} == before


def test_the_program_itself(stack: Path, tmp_path: Path) -> None:
    done = program(stack, "-o", tmp_path / "out", "-q")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1 + len(FILES)
