"""Two volumes of one made specimen, turned, of other voxels and other contrast; and what must not be believed."""

from __future__ import annotations

import csv
import json
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from devices.cli import run
from devices.errors import InputError
from processing.volume_registration import Volume, from_marks, from_pictures, information, judged, resampled

if TYPE_CHECKING:
    from pathlib import Path

VOXEL_UM = (2.0, 1.0, 1.0)
OTHER_UM = (1.5, 1.4, 1.4)


def specimen() -> Volume:
    grain = gaussian_filter(np.random.default_rng(3).normal(size=(30, 60, 60)), (2, 4, 4))
    return Volume((120 + 60 * grain / grain.std()).clip(0, 255).astype(np.float32), VOXEL_UM)


def turned(z_deg: float, shift_um: tuple[float, float, float], scale: float = 1.0) -> np.ndarray:
    t, middle = np.radians(z_deg), specimen().extent_um / 2
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    matrix[:3, 3] = middle - matrix[:3, :3] @ middle + shift_um
    return matrix


def seen(matrix: np.ndarray, *, inverted: bool) -> Volume:
    """Image the specimen anew after it was moved by the matrix, with other voxels."""
    grid = Volume(np.zeros((38, 42, 42), np.float32), OTHER_UM)
    moved = np.nan_to_num(resampled(specimen(), grid, np.linalg.inv(matrix)), nan=120.0)
    shown = 200 - 0.004 * moved**2 if inverted else moved  # falls as the other rises, and not in proportion
    return Volume((shown + np.random.default_rng(5).normal(0, 3, moved.shape)).astype(np.float32), OTHER_UM)


def off_um(found: np.ndarray, true: np.ndarray) -> float:
    points = np.random.default_rng(1).random((40, 3)) * specimen().extent_um
    moved = [points @ m[:3, :3].T + m[:3, 3] for m in (found, true)]
    return float(np.linalg.norm(moved[0] - moved[1], axis=1).mean())


@pytest.mark.parametrize(("method", "inverted"), [("mutual-information", True), ("correlation", False)])
def test_another_contrast_and_other_voxels_are_put_in_place(method, inverted):
    true = turned(7.0, (3.0, -2.0, 2.5))
    moving = seen(true, inverted=inverted)
    found = from_pictures(specimen(), moving, "rigid", method)
    assert off_um(found, true) < 0.5
    said = judged(specimen(), moving, found)
    assert said.believed
    assert said.overlap > 0.6


def test_volumes_of_different_things_are_not_believed():
    other = Volume(np.random.default_rng(9).normal(size=(38, 42, 42)).astype(np.float32), OTHER_UM)
    assert not judged(specimen(), other, from_pictures(specimen(), other, "rigid", "mutual-information")).believed
    away = np.eye(4)
    away[0, 3] = 1000.0
    assert information(specimen(), specimen(), away) == (0.0, 0.0)
    assert not judged(specimen(), specimen(), away).believed


@pytest.mark.parametrize(("model", "true"), [("translation", turned(0, (1, 2, 3))), ("rigid", turned(30, (1, 2, 3)))])
def test_marks_give_the_map_and_their_error(model, true):
    rng = np.random.default_rng(2)
    fixed = rng.random((8, 3)) * 50
    moving = fixed @ true[:3, :3].T + true[:3, 3]
    found, error = from_marks(model, fixed, moving)
    np.testing.assert_allclose(found, true, atol=1e-9)
    assert error == pytest.approx(0, abs=1e-9)
    off = []
    for _ in range(60):
        found, stated = from_marks(model, fixed, moving + rng.normal(0, 0.1, moving.shape))
        at_marks = fixed @ found[:3, :3].T + found[:3, 3] - moving
        off.append(((at_marks**2).sum(axis=1).mean(), stated**2))
    actual, stated = np.mean(off, axis=0)
    assert stated == pytest.approx(actual, rel=0.25)


def test_a_similarity_and_an_affine_map_come_back():
    true = turned(20, (1, 2, 3), 1.3)
    fixed = np.random.default_rng(2).random((8, 3)) * 50
    for model in ("similarity", "affine"):
        np.testing.assert_allclose(from_marks(model, fixed, fixed @ true[:3, :3].T + true[:3, 3])[0], true, atol=1e-9)


def test_marks_in_a_line_do_not_fix_a_turn():
    line = np.outer(np.arange(5.0), (1, 2, 3))
    with pytest.raises(InputError, match="span 1 dimensions"):
        from_marks("rigid", line, line)


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    paths = []
    for name, volume in (("fixed", specimen()), ("moving", seen(turned(5, (2, -1, 1)), inverted=False))):
        paths.append(tmp_path / f"{name}.tif")
        tifffile.imwrite(paths[-1], volume.grey.clip(0, 255).astype(np.uint8), photometric="minisblack")
    return paths


SIZES = ("--fixed-um", "2", "1", "--moving-um", "1.5", "1.4")


def test_the_command_leaves_volume_transform_and_picture(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["process", "register", *map(str, files), "-o", str(out), *SIZES, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {path.name for path in out.iterdir()} == {"registered.tif", "transform.json", "overlay.png", "report.json"}
    matrix = np.array(json.loads((out / "transform.json").read_text())["matrix"])
    assert off_um(matrix, turned(5, (2, -1, 1))) < 0.5
    moved = tifffile.imread(out / "registered.tif").astype(float)[8:-8, 15:-15, 15:-15]
    assert np.corrcoef(moved.ravel(), specimen().grey[8:-8, 15:-15, 15:-15].ravel())[0, 1] > 0.98
    assert report["information"] > report["information_elsewhere"]


def test_marks_through_the_command(files, tmp_path):
    true, fixed = turned(5, (2, -1, 1)), np.random.default_rng(4).random((6, 3)) * 50
    with (tmp_path / "marks.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("volume", "mark", "x_um", "y_um", "z_um"))
        table.writerows([("fixed", k, *p) for k, p in enumerate(fixed)])
        table.writerows([("moving", k, *p) for k, p in enumerate(fixed @ true[:3, :3].T + true[:3, 3])])
    marks = ["--fiducials", str(tmp_path / "marks.csv")]
    assert run(["process", "register", *map(str, files), "-o", str(tmp_path / "out"), *SIZES, *marks, "-q"]) == 0
    matrix = np.array(json.loads((tmp_path / "out" / "transform.json").read_text())["matrix"])
    np.testing.assert_allclose(matrix, true, atol=1e-5)


def test_what_cannot_be_registered_is_one_clear_error(files, tmp_path, capsys, monkeypatch):
    base = ["process", "register", *map(str, files), "-o", str(tmp_path / "out")]
    (tmp_path / "bad.csv").write_text("volume,mark,x_um\nfixed,1,2\n")
    noise = tmp_path / "noise.tif"
    tifffile.imwrite(noise, np.random.default_rng(1).integers(0, 255, (30, 40, 40), np.uint8), photometric="minisblack")
    foreign = ["process", "register", str(files[0]), str(noise), "-o", str(tmp_path / "out"), *SIZES]
    cases = [
        (base, "register-voxel"),
        ([*base, *SIZES, "--fiducials", str(tmp_path / "bad.csv")], "register-marks"),
        (foreign, "register-no-match"),
    ]
    for arguments, code in cases:
        assert run([*arguments, "-q"]) == 2
        assert f"error[{code}]" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    assert run([*base, *SIZES]) == 2
    assert "error[register-extra]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
