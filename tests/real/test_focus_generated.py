"""Range error on the published generated stacks, whose depth is known; one parameter set for all."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from processing.focus import focus_stack

DATA = os.environ.get("STEREOTOME_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="STEREOTOME_DATA does not name the folder of example data")


@pytest.mark.parametrize(("stack", "limit"), [(1, 0.13), (2, 0.13), (3, 0.16)])
def test_range_error_in_frames(stack, limit):
    folder = Path(str(DATA)) / "focus_generated"
    planes = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted((folder / f"stack{stack}").glob("*.jpg"))]
    with np.load(folder / "truth" / f"stack{stack}_depth_in_frames.npz") as truth:
        row, column = truth["crop_origin_rc"]
        depth = truth["depth_frames"]
    found = focus_stack(planes).range[row : row + depth.shape[0], column : column + depth.shape[1]]
    error = found - depth
    assert np.sqrt(np.mean(error**2)) <= limit
    assert abs(error.mean()) <= 0.01
