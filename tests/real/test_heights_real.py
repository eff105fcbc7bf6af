"""Range images of real instruments, and a map of a landscape, drawn from start to end."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from devices.cli import run
from processing.heights import read_heights

DATA = Path(os.environ.get("STEREOTOME_DATA", "/nonexistent"))
HEIGHTS, DEM = DATA / "heights_instruments", DATA / "dem_jacksboro" / "jacksboro_fault_dem.npz"
needs_data = pytest.mark.skipif(not DEM.exists(), reason="STEREOTOME_DATA names no folder with dem_jacksboro")
needs_reader = pytest.mark.skipif(
    not HEIGHTS.exists() or find_spec("SurfaceTopography") is None,
    reason="needs STEREOTOME_DATA with heights_instruments, and the extra 'heights'",
)


@needs_reader
@pytest.mark.parametrize("name", ["al3d-1.al3d", "di-3.di", "mi-1.mi", "opd-1.opd"])
def test_instruments_heights_are_those_of_another_reader(name):
    found = read_heights(HEIGHTS / name)
    with np.load(HEIGHTS / "truth" / f"{name}.npz") as truth:
        scale = {"m": 1e6, "mm": 1e3, "nm": 1e-3}.get(str(truth["unit"]), 1.0)
        heights, sizes = truth["heights_xy"].T * scale, truth["physical_sizes"] * scale
    assert found.unit == "µm"
    assert found.values.shape == heights.shape
    assert np.nanmax(np.abs(found.values - heights)) <= 1e-5 * np.nanmax(np.abs(heights))
    assert np.multiply(found.pixel, found.values.shape) == pytest.approx(sizes[::-1], rel=1e-6)


@needs_data
@pytest.mark.parametrize("mode", ["relief", "contour", "profile"])
def test_a_landscape_is_drawn(tmp_path, mode):
    out = tmp_path / "x.png"
    assert (
        run(["relief", str(DEM), "--pixel", "80", "--unit", "m", "--mode", mode, "-o", str(out), "--size", "320x240"])
        == 0
    )
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.std() > 20
    assert out.with_suffix(".csv").exists() == (mode != "relief")
