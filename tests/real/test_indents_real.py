"""A Vickers indent in steel under three backscatter detectors, read by hand: 18.93 and 18.77 µm ± 0.15."""

import os
from pathlib import Path

import numpy as np
import pytest

from processing.indents import measured_indents
from processing.indents_cli import opened_face

DATA = os.environ.get("STEREOTOME_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="STEREOTOME_DATA does not name the folder of example data")
BY_HAND_UM, HAND_ERROR_UM = np.array([18.93, 18.77]), 0.15
DEPTH_UM = 18.85 / 7.0006


def measured(detector: str):
    (path,) = (Path(str(DATA)) / "sem_vickers").glob(f"*multiBSE_{detector}_05.tif")
    image, pixel_um = opened_face(path, None)
    assert image.shape == (1024, 1536)
    assert pixel_um == pytest.approx(0.0651042)
    (found,) = measured_indents(image, pixel_um)
    return found


@pytest.mark.parametrize("detector", ["A", "B", "C"])
def test_one_indent_is_found_and_its_depth_is_that_of_the_hand_reading(detector):
    found = measured(detector)
    assert found.shape == "vickers"
    assert found.depth_um == pytest.approx(DEPTH_UM, abs=0.035)
    assert found.depth_error_um < 0.06


def test_the_diagonals_agree_with_the_hand_reading_where_no_burr_hides_a_corner():
    found = measured("C")
    np.testing.assert_allclose(found.diagonals_um, BY_HAND_UM, atol=HAND_ERROR_UM)
    assert max(found.diagonal_errors_um) < 0.2


def test_a_burr_over_a_corner_is_noticed():
    (note,) = measured("B").notes
    assert "the diagonals differ" in note


@pytest.mark.parametrize("detector", ["A", "B", "C"])
def test_the_stated_error_covers_the_difference(detector):
    found = measured(detector)
    allowed = np.hypot(found.diagonal_errors_um, HAND_ERROR_UM)
    assert np.all(np.abs(np.array(found.diagonals_um) - BY_HAND_UM) < allowed)
