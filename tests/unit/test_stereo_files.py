"""Anaglyph and stereo pair of results in a folder."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.errors import InputError
from display.stereo_files import write_stereo

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def results(tmp_path: Path) -> Path:
    image = np.random.default_rng(1).integers(0, 256, (40, 300), np.uint8)
    tifffile.imwrite(tmp_path / "extended_focus.tif", image)
    tifffile.imwrite(tmp_path / "range.tif", np.tile(np.linspace(0, 30, 300, dtype=np.float32), (40, 1)))
    (tmp_path / "report.json").write_text(json.dumps({"unit": "um", "pixel_um": 0.5}))
    return tmp_path


def shown(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path)))[..., ::-1]


def test_both_pictures_show_the_views(results: Path) -> None:
    pair = write_stereo(results, results, angle_deg=8.0)
    picture = shown(results / "anaglyph.png")[:40]
    assert np.array_equal(picture[..., 0], pair.left)
    assert np.array_equal(picture[..., 1], pair.right)
    beside = shown(results / "stereo_pair.png")[:40, :, 0]
    assert np.array_equal(beside, np.hstack([pair.left, pair.right]))
    assert pair.parallax_px[1] == pytest.approx(2 * 15 * np.sin(np.radians(4)) / 0.5, rel=1e-4)
    assert not list(results.glob("*.part"))


def test_without_units_depth_is_what_is_comfortable(results: Path) -> None:
    (results / "report.json").write_text(json.dumps({"unit": "plane", "pixel_um": None}))
    pair = write_stereo(results, results)
    assert pair.parallax_px[1] == pytest.approx(300 / 30, rel=0.03)
    assert pair.warnings == ()


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no results"):
        write_stereo(tmp_path, tmp_path)
