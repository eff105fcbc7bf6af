"""``stereotome process elevation`` through the real command: right maps, and one clear line for each bad input."""

from __future__ import annotations

import csv
import json
import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.elevation_outputs import FILES

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = (100, 160)
PIXEL_UM, TILT_DEG = 0.5, 10.0
SLOPE = 0.2
ARGUMENTS = ("--tilt-deg", TILT_DEG, "--pixel-um", PIXEL_UM)


def views(tilts_deg: tuple[float, ...] = (TILT_DEG / 2, -TILT_DEG / 2)) -> list[np.ndarray]:
    """Look at a textured plane z = 0.2 x from some sides; x runs from the middle of the picture."""
    grain = np.random.default_rng(7).normal(size=(SHAPE[0], 400)).astype(np.float32)
    scene = 128 + 180 * cv2.GaussianBlur(grain, (0, 0), 1.2)
    middle = (SHAPE[1] - 1) / 2
    out = []
    for half in tilts_deg:
        t = math.radians(half)
        stretch = math.cos(t) + SLOPE * math.sin(t)
        source = (200 + (np.arange(SHAPE[1]) - middle) / stretch).astype(np.float32)
        rows = np.arange(SHAPE[0], dtype=np.float32)[:, np.newaxis].repeat(SHAPE[1], 1)
        seen = cv2.remap(scene, source[np.newaxis].repeat(SHAPE[0], 0), rows, cv2.INTER_CUBIC)
        out.append(np.clip(seen, 0, 255).astype(np.uint8))
    return out


def truth() -> np.ndarray:
    t = math.radians(TILT_DEG / 2)
    seen = (np.arange(SHAPE[1]) - (SHAPE[1] - 1) / 2) * PIXEL_UM
    return SLOPE * seen / (math.cos(t) + SLOPE * math.sin(t))


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, view in zip(paths, views(), strict=True):
        cv2.imwrite(str(path), view)
    return paths


def command(*arguments: object) -> int:
    return run(["process", "elevation", *map(str, arguments)])


@pytest.mark.parametrize("method", ["area", "points"])
def test_a_sloping_plane_comes_out_up_positive_with_all_files(
    pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    out = tmp_path / "out"
    assert command(*pair, "-o", out, *ARGUMENTS, "--method", method, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert {path.name for path in out.iterdir()} == set(FILES)
    found, sigma = (tifffile.imread(out / f"{name}.tif") for name in ("elevation", "elevation_error"))
    valid = tifffile.imread(out / "valid.tif") > 0
    assert found.dtype == np.float32
    np.testing.assert_array_equal(valid, np.isfinite(found))
    error = (found - truth())[valid]
    assert valid.mean() > {"area": 0.8, "points": 0.7}[method]
    assert np.median(np.abs(error)) < 0.2
    assert np.nanmedian(sigma) < 0.5
    assert report["mean_plane"]["slope_x"] == pytest.approx(SLOPE, abs=0.005)
    parallax = tifffile.imread(out / "parallax.tif")
    expected = 2 * math.sin(math.radians(5)) * found / PIXEL_UM
    np.testing.assert_allclose(parallax[valid], expected[valid], atol=0.02)


def test_more_views_make_the_height_surer_and_fill_what_one_pair_leaves_open(pair: list[Path], tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    taken = dict(zip(("l", "r", "a", "b"), views((5, -5, -10, 10)), strict=True))
    for name, view in taken.items():
        noisy = view + rng.normal(0, 12, view.shape)
        if name == "r":
            noisy[30:50, 60:90] = 255  # hidden from the right view alone
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
    two = [str(tmp_path / "l.png"), str(tmp_path / "r.png")]
    more = ["--more", str(tmp_path / "a.png"), "-10", "--more", str(tmp_path / "b.png"), "10"]
    errors, known = [], []
    for k, extra in enumerate(([], more)):
        assert command(*two, "-o", tmp_path / f"out{k}", *ARGUMENTS, *extra, "-q") == 0
        found = tifffile.imread(tmp_path / f"out{k}" / "elevation.tif")
        errors.append(np.sqrt(np.nanmean((found - truth()) ** 2)))
        known.append(np.isfinite(found[35:45, 75:85]).mean())
    assert errors[1] < 0.7 * errors[0]
    assert known[0] < 0.3
    assert known[1] > 0.9


def test_levelling_takes_the_plane_away(pair: list[Path], tmp_path: Path) -> None:
    assert command(*pair, "-o", tmp_path / "out", *ARGUMENTS, "--level", "-q", "--relief-um", 12) == 0
    assert np.nanmedian(np.abs(tifffile.imread(tmp_path / "out" / "elevation.tif"))) < 0.2


def test_points_edited_by_hand_are_taken_as_they_are(pair: list[Path], tmp_path: Path) -> None:
    assert command(*pair, "-o", tmp_path / "a", *ARGUMENTS, "--method", "points", "-q") == 0
    with (tmp_path / "a" / "points.csv").open() as file:
        lines = file.readlines()
    edited = tmp_path / "edited.csv"
    edited.write_text("".join(lines[:9]))
    assert command(*pair, "-o", tmp_path / "b", *ARGUMENTS, "--method", "markers", "--matches", edited, "-q") == 0
    with (tmp_path / "b" / "points.csv").open() as file:
        kept = list(csv.DictReader(file))
    with edited.open() as file:
        for before, after in zip(csv.DictReader(file), kept, strict=True):
            assert float(after["z_um"]) == pytest.approx(float(before["z_um"]), abs=0.02)
    assert len((tmp_path / "b" / "network.csv").read_text().splitlines()) == 8


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--tilt-deg", 0, "--pixel-um", 1), "stereo-tilt"),
        (("--tilt-deg", -8, "--pixel-um", 1), "stereo-tilt"),
        (("--tilt-deg", "nan", "--pixel-um", 1), "stereo-tilt"),
        (("--pixel-um", 1), "stereo-tilt"),
        (("--tilt-deg", 8, "--shift-um", 3, "--pixel-um", 1), "stereo-tilt"),
        (("--tilt-deg", 8), "stereo-pixel"),
        (("--tilt-deg", 8, "--pixel-um", -1), "stereo-pixel"),
        (("--tilt-deg", 8, "--pixel-um", "nan"), "stereo-pixel"),
        (("--shift-um", 3, "--pixel-um", 1), "stereo-distance"),
        ((*ARGUMENTS, "--band-px", 9, -9), "stereo-band"),
        ((*ARGUMENTS, "--relief-um", 0), "stereo-relief"),
        ((*ARGUMENTS, "--more", "left.png", 100), "stereo-tilt"),
        ((*ARGUMENTS, "--more", "left.png", 9, "--method", "points"), "stereo-more"),
    ],
)
def test_numbers_that_make_no_sense_are_one_clear_error(
    pair: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[object, ...],
    code: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*pair, "-o", tmp_path / "out", *arguments) == 2
    said = capsys.readouterr().err
    assert f"error[{code}]" in said
    assert "fix:" in said
    assert not (tmp_path / "out").exists()


def test_results_that_are_there_are_not_replaced_unasked(
    pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "elevation.tif").write_text("mine")
    assert command(*pair, "-o", tmp_path / "out", *ARGUMENTS) == 2
    assert "error[output-exists]" in capsys.readouterr().err
    assert (tmp_path / "out" / "elevation.tif").read_text() == "mine"


def test_clipped_views_are_said_so_and_the_clipped_part_is_left_open(tmp_path: Path, capsys) -> None:
    left, right = views()
    for view in (left, right):
        view[:, 50:100] = 255
    for name, view in (("l.png", left), ("r.png", right)):
        cv2.imwrite(str(tmp_path / name), view)
    assert command(tmp_path / "l.png", tmp_path / "r.png", "-o", tmp_path / "out", *ARGUMENTS) == 0
    assert "of the left view is at its brightest value" in capsys.readouterr().err
    assert tifffile.imread(tmp_path / "out" / "valid.tif")[:, 62:88].mean() < 5


@pytest.mark.parametrize("command", ["focus", "elevation", "align"])
def test_planes_that_memory_cannot_hold_are_refused_with_the_figures(command, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("processing.memory.free_bytes", lambda: 50_000)
    for name in ("left", "right"):
        np.save(tmp_path / f"{name}.npy", np.random.default_rng(len(name)).integers(0, 255, (1, 64, 64), np.uint8))
    views = [str(tmp_path / "left.npy"), *([str(tmp_path / "right.npy")] if command == "elevation" else [])]
    given = ["--tilt-deg", "8", "--pixel-um", "1"] if command == "elevation" else []
    assert run(["process", command, *views, *given, "-o", str(tmp_path / "out"), "-q"]) == 2
    said = capsys.readouterr().err
    assert "error[memory]" in said
    assert "GB can be used" in said
