"""Regions, balloons and central features: against scikit-image, and on shapes that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from skimage.segmentation import flood

from devices.errors import InputError
from processing.growing import balloon, region
from processing.masks import central

RNG = np.random.default_rng(45)
GREY = np.rint(100 + 300 * ndimage.gaussian_filter(RNG.normal(size=(9, 20, 24)), 1.5)).astype(np.uint8)


@pytest.mark.parametrize("rule", [6, 18, 26])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_region_equals_scikit_images_flood(rule: int, dtype: type) -> None:
    for seed in [(0, 0, 0), (4, 10, 12), (8, 19, 23)]:
        grey = GREY.astype(dtype)
        expected = flood(grey, seed, connectivity={6: 1, 18: 2, 26: 3}[rule], tolerance=12)
        np.testing.assert_array_equal(region(grey, seed=seed, tolerance=12, rule=rule) > 0, expected)


def test_a_region_much_larger_than_the_first_look_is_found_whole() -> None:
    maze = np.zeros((3, 90, 91), np.uint8)
    maze[1, ::2] = 9
    maze[1, 1::4, 90] = maze[1, 3::4, 0] = 9  # one way to and fro through all rows
    for seed in [(1, 0, 0), (1, 44, 45), (1, 88, 90)]:
        np.testing.assert_array_equal(region(maze, seed=seed, tolerance=1, rule=6) > 0, maze > 0)


def test_seeds_are_united() -> None:
    one, other = (region(GREY, seed=seed, tolerance=5) for seed in [(0, 0, 0), (8, 19, 23)])
    np.testing.assert_array_equal(region(GREY, seed=(0, 0, 0, 8, 19, 23), tolerance=5), np.maximum(one, other))


def test_a_slope_is_followed_from_neighbour_to_neighbour_and_ends_at_a_step() -> None:
    slope = np.zeros((1, 3, 40), np.uint8)
    slope[:] = 3 * np.arange(40)
    slope[:, :, 30:] += 60
    for dtype in (np.uint8, np.uint16, np.float32):
        inside = region(slope.astype(dtype), seed=(0, 1, 0), tolerance=3, like="neighbour") > 0
        np.testing.assert_array_equal(inside[0, 0], np.arange(40) < 30)
    assert region(slope, seed=(0, 1, 0), tolerance=3)[0, 1].argmin() == 2


def test_the_mean_forgets_an_odd_seed() -> None:
    even = np.full((5, 9, 9), 100, np.uint8) + RNG.integers(0, 5, (5, 9, 9)).astype(np.uint8)
    even[:, :, 6:] = 200
    even[2, 4, 3] = 109
    inside = region(even, seed=(2, 4, 3), tolerance=10, like="mean") > 0
    np.testing.assert_array_equal(inside, even < 150)


def chambers(gap: int) -> tuple[np.ndarray, np.ndarray]:
    """Two balls of radius 9 joined by a pipe of width ``gap``, and the left one alone."""
    z, y, x = np.mgrid[:24, :24, :52]
    left, right = ((z - 11.5) ** 2 + (y - 11.5) ** 2 + (x - c) ** 2 <= 81 for c in (12, 39))
    pipe = (abs(z - 11.5) < gap / 2) & (abs(y - 11.5) < gap / 2) & (x > 12) & (x < 39)
    return np.uint8(200) * (left | right | pipe), left


def test_a_balloon_fills_its_chamber_and_not_the_next() -> None:
    grey, left = chambers(gap=2)
    assert np.count_nonzero(region(grey, seed=(11, 11, 12), tolerance=10)) > 2 * left.sum()
    inside = balloon(grey, seed=(11, 11, 12), low=150, high=255) > 0
    assert np.count_nonzero(inside & ~left) <= 8
    assert inside.sum() == pytest.approx(left.sum(), rel=0.03)
    wide = balloon(chambers(gap=8)[0], seed=(11, 11, 12), low=150, high=255) > 0
    assert wide.sum() > 2 * left.sum()


def test_a_balloon_counts_in_um() -> None:
    z, y, x = np.mgrid[:13, :24, :24]
    grey = np.uint8(200) * (4 * (z - 6) ** 2 + (y - 11.5) ** 2 + (x - 11.5) ** 2 <= 81)
    inside = balloon(grey, (2.0, 1.0, 1.0), seed=(6, 11, 11), low=150, high=255)
    assert np.count_nonzero(inside) == pytest.approx(np.count_nonzero(grey), rel=0.04)


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (lambda: region(GREY, seed=(0, 0), tolerance=3), "seed"),
        (lambda: region(GREY, seed=(), tolerance=3), "seed"),
        (lambda: region(GREY, seed=(0, 0, 24), tolerance=3), "seed"),
        (lambda: region(GREY, seed=(-1, 0, 0), tolerance=3), "seed"),
        (lambda: region(GREY, seed=(0, 0, 0), tolerance=-1), "operator-params"),
        (lambda: region(GREY, seed=(0, 0, 0), tolerance=1, rule=4), "neighbours"),
        (lambda: balloon(GREY, seed=(4, 4, 4), low=250, high=255), "seed"),
    ],
)
def test_wrong_seeds_are_told(wrong, code: str) -> None:
    with pytest.raises(InputError) as refused:
        wrong()
    assert refused.value.code == code


def head(scale: float) -> tuple[np.ndarray, np.ndarray]:
    """A bright ellipse with a dark hole within a bright ring, bridged, bright corners; and the ellipse."""
    y, x = np.mgrid[:80, :90]
    r = np.hypot((y - 38) / 30, (x - 45) / 36)
    brain = r < 0.7
    plane = 20.0 + 100 * brain + 120 * ((r > 0.85) & (r < 1))
    plane[37:39, 60:84] = 140
    plane[:12, :12] = 250
    plane[34:40, 40:48] = 10
    return plane * scale, brain


def test_the_brain_is_found_within_its_skull() -> None:
    planes = [head(scale) for scale in (0.9, 1.0)]
    grey = np.array([plane for plane, _ in planes] + [np.full((80, 90), 5.0)]).astype(np.uint8)
    masked, mask = central(grey)
    for k, (_, brain) in enumerate(planes):
        wrong = (mask[k] > 0) ^ brain
        assert wrong.sum() < 0.02 * brain.sum()
    assert not mask[2].any()
    np.testing.assert_array_equal(masked, np.where(mask > 0, grey, 0))
