"""A coarse, breathing colour stack: the result is nowhere softer than the best registered input."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from processing.focus import focus_stack
from processing.registration import RegisteredPlanes, placements

DATA = os.environ.get("STEREOTOME_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="STEREOTOME_DATA does not name the folder of example data")
BLOCK = 64
TEXTURED = 20  # (grey levels per pixel)²; blocks below it show nothing that could be soft


def block_energy(image: np.ndarray) -> np.ndarray:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    gx, gy = (cv2.Sobel(grey, -1, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return cv2.resize(gx * gx + gy * gy, None, fx=1 / BLOCK, fy=1 / BLOCK, interpolation=cv2.INTER_AREA)


def test_extended_focus_is_as_sharp_as_the_best_plane_everywhere():
    files = sorted((Path(str(DATA)) / "focus_pcb").glob("pcb_*.jpg"))
    planes = [cv2.cvtColor(cv2.imread(str(f)), cv2.COLOR_BGR2RGB) for f in files]
    result = focus_stack(planes)
    assert result.parameters["registration"]["applied"]
    _, places = placements(planes)
    placed = RegisteredPlanes(planes, places)
    best = np.max([block_energy(placed[k]) for k in range(len(placed))], axis=0)
    ratio = (block_energy(result.extended_focus) / best)[best > TEXTURED]
    assert ratio.min() > 0.7
    assert np.percentile(ratio, 1) > 0.97
    assert np.median(ratio) > 0.98
