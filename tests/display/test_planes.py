"""Planes cut by the processor: seen nearly edge-on they show what lies there, and nothing beside the volume is read."""

import numpy as np
import pytest

from display.cpu.bricks import make_bricks
from display.cpu.planes import cut_planes
from display.rays import Rays

SIDE, SIZE, STEP = 40, (64, 48), 0.4973


@pytest.mark.parametrize("slope", [1e-3, 1e-5, 1e-7, 3e-9])
@pytest.mark.parametrize("smooth", [True, False])
def test_of_a_plane_seen_edge_on_only_the_volume_is_seen(slope, smooth):
    ramp = np.repeat(5 * np.arange(SIDE, dtype=np.uint8), SIDE**2).reshape((SIDE,) * 3)
    bricks = make_bricks(ramp)
    middle = (SIDE - 1) / 2
    right, down, along = np.array([STEP, 0.0, 0.0]), np.array([0.0, STEP, 0.0]), np.array([0.0, 0.0, 1.0])
    # one column meets the plane in the volume, 5 voxels before its middle
    corner = np.array([middle - 32 * STEP + 5 * slope, middle - 11.8, middle])
    normal = np.array([1.0, 0.0, slope])  # x = middle, all but along the line of sight
    plane = np.array([[*normal, normal @ (middle, middle, middle), 0.0, 0.0, 0.0]])
    box = (np.full(3, -0.5), np.full(3, SIDE - 0.5))
    rays = Rays(corner, right, down, along, None, np.ones(3))
    seen = cut_planes(bricks, rays, box, SIZE, plane, limits=(0, 200), transparent=-1e9, smooth=smooth)
    there = seen[..., 2] > 0
    columns = np.flatnonzero(there.any(axis=0))
    assert 32 in columns
    assert len(columns) == 1
    deep = middle - 5 if smooth else np.floor(middle - 5 + 0.5)
    assert seen[there][:, 0] == pytest.approx(5 * deep / 200, abs=0.001 if smooth else 0.026)
