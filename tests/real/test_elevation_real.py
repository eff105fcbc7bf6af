"""Published pairs with known answers: a garage scene with its disparity, and a measured surface tilted by ± 4°."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from processing.elevation import Geometry, elevation
from processing.stereo_geometry import tilted_pair
from processing.stereo_match import match_area

DATA = os.environ.get("STEREOTOME_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="STEREOTOME_DATA does not name the folder of example data")
RELIEF_UM = 34.951


def test_motorcycle_is_matched_better_than_by_the_block_matcher_of_opencv():
    folder = Path(str(DATA)) / "stereo_motorcycle"
    views = [cv2.imread(str(folder / f"motorcycle_{side}.png")) for side in ("left", "right")]
    with np.load(folder / "truth" / "disparity_left.npz") as file:
        truth = file[file.files[0]]
    found = match_area(*views)
    known = np.isfinite(truth)
    matched = known & found.valid
    assert matched.sum() / known.sum() >= 0.85
    assert np.mean(np.abs(found.parallax_px - truth)[matched] > 2) < 0.04


def tilted_surface():
    folder = Path(str(DATA)) / "stereo_tilt"
    names = ("al3d_left_plus4deg.png", "al3d_right_minus4deg.png")
    views = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    with np.load(folder / "truth" / "al3d_height_um.npz") as truth:
        height = truth["height_um"] - float(truth["mean_height_um"])
        pixel_um, half_deg = float(truth["pixel_um"]), float(truth["half_angle_deg"])
    x = np.arange(height.shape[1])
    middle, half = (x.size - 1) / 2, np.radians(half_deg)
    seen = middle + (x - middle) * np.cos(half) + height / pixel_um * np.sin(half)
    on_left = np.array([np.interp(x, *row) for row in zip(seen, height, strict=True)])
    return views, Geometry(tilted_pair(2 * half_deg), pixel_um), on_left


@pytest.mark.parametrize(("method", "share"), [("area", 0.95), ("points", 0.85)])
def test_height_of_the_tilted_surface_is_right_to_a_percent_of_its_relief(method, share):
    views, geometry, truth = tilted_surface()
    found = elevation(*views, geometry, method=method)
    error = (found.elevation_um - truth)[found.valid]
    assert found.valid.mean() >= share
    assert np.sqrt(np.mean(error**2)) <= 0.01 * RELIEF_UM


def test_the_stated_error_is_that_of_the_surface_and_the_border_is_left_open():
    views, geometry, truth = tilted_surface()
    found = elevation(*views, geometry)
    sure = found.valid
    ratio = np.median(np.abs(found.elevation_um - truth)[sure] / found.sigma_um[sure]) / 0.6745
    assert 0.7 < ratio < 1.5
    height = views[0].shape[0]
    partner = np.arange(views[0].shape[1]) - found.parallax_px
    assert np.nanmin(partner) >= 0
    assert not found.valid[: height // 4, :4].any()  # stands high, so the right view has it beyond its border
