"""Samples along a ray: many side by side equal interpolation written out, and no brick is left out on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from display.cpu import fast
from display.cpu.bricks import SIDE, make_bricks
from display.cpu.sampling import RUN, Grid, Room, draw, grid, ray, room, walk

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.sampling import Line

RAYS = st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(0.05, 4), st.sampled_from([0.05, 0.3, 1.0, 2.5]))


@fast
def drawn(volume: Grid, space: Room, line: Line, first: int, count: int) -> None:
    """Draw samples from machine code, as rays do."""
    draw(volume, space, line, first, count)


@fast
def walked(space: Room, bounds: NDArray[np.float32], line: Line) -> int:
    """Walk from machine code."""
    return int(walk(space, bounds, line))


def through(shape: tuple[int, ...], way: tuple[float, float, float], step: float) -> Line:
    """Return a ray through the middle of a volume."""
    middle = (np.array(shape[::-1]) - 1) / 2
    direction = np.array(way) / np.linalg.norm(way)
    low, high = np.full(3, -0.5), np.array(shape[::-1]) - 0.5
    corner = middle + np.array([0.3, -0.2, 0.1])
    geometry = np.stack([corner, np.zeros(3), np.zeros(3), direction, np.zeros(3), np.ones(3), low, high])
    return ray(geometry, 0, 0, np.array([0.0, 1.0, step, 0.0]))  # type: ignore[no-any-return]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@settings(deadline=None, max_examples=40)
@given(RAYS)
def test_runs_equal_interpolation(dtype: type, going: tuple[float, float, float, float]) -> None:
    shape = (19, 23, 31)
    values = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    bricks, line = make_bricks(values), through(shape, going[:3], going[3])
    space, full = room(bricks), float(np.iinfo(dtype).max)
    for first in range(0, int(line[0]), RUN):
        count = min(int(line[0]) - first, RUN)
        drawn(grid(bricks), space, line, first, count)
        steps = np.arange(first, first + count)
        places = [line[3 + a] + steps * line[6 + a] for a in (2, 1, 0)]
        wanted = ndimage.map_coordinates(bricks.padded.astype(np.float64), places, order=1)
        np.testing.assert_allclose(space.found[:count], wanted, atol=2e-5 * full)


@settings(deadline=None, max_examples=60)
@given(RAYS)
def test_a_walk_knows_every_step(going: tuple[float, float, float, float]) -> None:
    shape = (40, 22, 33)
    values = np.random.default_rng(4).integers(0, 255, shape).astype(np.uint8)
    bricks, line = make_bricks(values), through(shape, going[:3], going[3])
    space = room(bricks)
    count = walked(space, bricks.high, line)
    stops, held = space.stops[:count], space.held[:count]
    assert (np.diff(stops) > 0).all()
    assert stops[-1] == int(line[0])
    steps = np.arange(int(line[0]))
    place = np.stack([line[3 + a] + steps * line[6 + a] for a in (2, 1, 0)])
    within = held[np.searchsorted(stops, steps, side="right")]
    around = np.array([values_around(bricks.padded, point) for point in place.T])
    assert (within >= around).all()  # nothing a step touches is more than its brick is said to hold
    assert len(bricks.high) == -(-(shape[0] + 2) // SIDE)


def values_around(padded: NDArray[np.uint8], point: NDArray[np.float64]) -> int:
    """Return the largest of the eight voxels around a point."""
    z, y, x = np.floor(point).astype(int)
    return int(padded[z : z + 2, y : y + 2, x : x + 2].max())
