"""``stereotome process apply`` through the real command: range images and stacks, steps on the line and in a file."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.relief_picture import exaggeration, relief_picture, shaded

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = (40, 60)


def slope() -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    height = 5 + 0.1 * x - 0.05 * y
    height[20:24, 30:34] += 3
    height[5:8, 5:8] = np.nan
    return height


@pytest.fixture
def result(tmp_path: Path) -> Path:
    folder = tmp_path / "focus"
    folder.mkdir()
    resolution = {"resolution": (1e4 / 0.5, 1e4 / 0.5), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(folder / "range.tif", slope(), **resolution)
    tifffile.imwrite(folder / "confidence.tif", np.where(np.isnan(slope()), 0, 2).astype(np.float32))
    return folder


def apply(source: Path, out: Path, *words: object) -> int:
    return run(["process", "apply", str(source), *map(str, words), "-o", str(out), "-q"])


def test_a_range_image_is_filled_and_levelled(result: Path, tmp_path: Path):
    out = tmp_path / "out"
    assert apply(result, out, "range.fill", "range.level") == 0
    flat, filled = (tifffile.imread(out / f"{name}.tif") for name in ("range", "filled"))
    np.testing.assert_array_equal(filled == 255, np.isnan(slope()))
    away = np.ones(SHAPE, bool)
    away[18:26, 28:36] = away[3:10, 3:10] = False
    assert np.abs(flat[away]).max() < 1e-3
    assert abs(flat[22, 32] - 3) < 1e-3
    report = json.loads((out / "report.json").read_text())
    assert [s["operator"] for s in report["steps"]] == ["range.fill", "range.level"]
    assert report["pixel_um"] == pytest.approx(0.5)
    np.testing.assert_allclose(report["values"]["plane_fit"][1:], [0.2, -0.1], atol=1e-4)
    assert set(report["files"]) == {path.name for path in out.iterdir()}
    assert "relief.png" in report["files"]


def test_steps_from_a_file_do_the_same(result: Path, tmp_path: Path):
    steps = tmp_path / "steps.toml"
    steps.write_text('[[step]]\noperator = "range.median"\nside_px = 3\n[[step]]\noperator = "range.smooth"\n')
    assert apply(result, tmp_path / "a", "--steps", steps) == 0
    assert apply(result, tmp_path / "b", "range.median:side_px=3", "range.smooth") == 0
    a, b = (tifffile.imread(tmp_path / name / "range.tif") for name in "ab")
    np.testing.assert_array_equal(a, b)


def test_a_stack_goes_through_volume_steps(tmp_path: Path):
    path = tmp_path / "stack.npy"
    np.save(path, np.random.default_rng(0).integers(0, 255, (5, 24, 32)).astype(np.uint8))
    sizes = ("--step-um", 2, "--pixel-um", 1)
    assert apply(path, tmp_path / "out", "volume.cubic:method=linear", "focus.stack:method=confocal", *sizes) == 0
    assert tifffile.imread(tmp_path / "out" / "volume.ome.tif").shape == (9, 24, 32)
    assert tifffile.imread(tmp_path / "out" / "range.tif").shape == (24, 32)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["range.medain"], "did you mean 'range.median'"),
        (["range.median:side_px=4"], "has no middle"),
        (["deblur.wiener:noise=1"], "needs volume, psf"),
        ([], "named on the command line or in a file"),
        (["--steps", "nowhere.toml"], "there is no nowhere.toml"),
        (["range.rolling_ball:radius_px=-1"], "must be positive"),
    ],
)
def test_wrong_steps_are_one_clear_line(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
):
    assert apply(result, tmp_path / "out", *words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_map_that_knows_nothing_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "range.tif"
    tifffile.imwrite(path, np.full(SHAPE, np.nan, np.float32))
    assert apply(path, tmp_path / "out", "range.level") == 2
    assert "knows too little" in capsys.readouterr().err


def test_light_falls_as_the_normal_says_and_the_exaggeration_is_stated():
    x = np.mgrid[:30, :40][1]
    for rise in (-1.0, 0.0, 0.5):
        normal = np.array([-rise, 0, 1]) / np.hypot(rise, 1)
        light = np.array([-1, -1, 1.2]) / np.linalg.norm([-1, -1, 1.2])
        assert abs(int(shaded(rise * x)[10, 10]) - 255 * max(0.0, float(normal @ light))) <= 1
    assert exaggeration(0.005 * x) == 100
    assert relief_picture((0.1 * x).astype(np.float32), 0.5).shape[0] > 30
