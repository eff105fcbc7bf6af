"""Stereo pairs against what geometry says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from devices.errors import DisplayError
from display.shifted import (
    comfortable_pixel,
    middle_plane,
    shifted_views,
    stereo_pair,
    tilt_parallax_px,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

HEIGHT, WIDTH = 24, 160


def texture(seed: int = 0, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(128 + 100 * smooth / np.abs(smooth).max(), np.uint8)


def found_shift(view: np.ndarray, image: np.ndarray, column: int, reach: int = 12) -> float:
    """How far to the right a 31 px wide piece of the image lies in the view, by least squares, to sub-pixel."""
    piece = image[:, column - 15 : column + 16].astype(np.float64)
    errors = [
        np.sum((view[:, column + s - 15 : column + s + 16].astype(np.float64) - piece) ** 2)
        for s in range(-reach, reach + 1)
    ]
    best = int(np.argmin(errors))
    before, at, after = errors[best - 1 : best + 2]
    return best - reach + 0.5 * (before - after) / (before - 2 * at + after)


def flat(parallax_px: float) -> NDArray[np.float32]:
    return np.full((HEIGHT, WIDTH), parallax_px, np.float32)


def test_parallax_is_twice_height_times_sine_of_half_the_angle() -> None:
    range_um = np.linspace(-50, 50, WIDTH)[np.newaxis].repeat(HEIGHT, 0)
    parallax = tilt_parallax_px(range_um, pixel_um=0.5, angle_deg=8.0)
    assert parallax == pytest.approx(2 * range_um * np.sin(np.radians(4)) / 0.5, abs=1e-4)
    assert tilt_parallax_px(range_um, pixel_um=0.5, angle_deg=8, depth_scale=-2) == pytest.approx(-2 * parallax)


def test_the_middle_plane_lies_in_the_screen() -> None:
    range_um = np.where(np.arange(WIDTH) < WIDTH // 2, 10.0, 30.0)[np.newaxis].repeat(HEIGHT, 0)
    parallax = tilt_parallax_px(range_um, pixel_um=1.0, angle_deg=10)
    assert parallax.min() == pytest.approx(-parallax.max())
    assert middle_plane(range_um) == 20


@pytest.mark.parametrize("shift", [1, 3, -2])
def test_whole_shifts_move_every_pixel_exactly(shift: int) -> None:
    image = texture()
    pair = shifted_views(image, flat(2.0 * shift))
    inside = slice(8, -8)
    assert np.array_equal(np.roll(image, shift, axis=1)[:, inside], pair.left[:, inside])
    assert np.array_equal(np.roll(image, -shift, axis=1)[:, inside], pair.right[:, inside])


@pytest.mark.parametrize("parallax", [0.5, 3.3, -4.7])
def test_fractions_of_a_pixel_are_interpolated(parallax: float) -> None:
    image = texture()
    pair = shifted_views(image, flat(parallax))
    columns = np.arange(20, WIDTH - 20) - parallax / 2
    low = np.floor(columns).astype(int)
    expected = image[:, low] * (1 - (columns - low)) + image[:, low + 1] * (columns - low)
    assert pair.left[:, 20 : WIDTH - 20] == pytest.approx(expected, abs=0.51)


def test_disparity_found_by_matching_equals_the_formula_on_a_tilted_plane() -> None:
    image = texture(3)
    range_um = np.linspace(0.0, 16.0, WIDTH)[np.newaxis].repeat(HEIGHT, 0)
    pair = stereo_pair(image, range_um, pixel_um=0.4, angle_deg=8.0)
    for column in (40, 80, 120):
        height = range_um[0, column] - middle_plane(range_um)
        expected = 2 * height * np.sin(np.radians(4.0)) / 0.4
        measured = found_shift(pair.left, image, column) - found_shift(pair.right, image, column)
        assert measured == pytest.approx(expected, abs=0.1)


def test_a_step_hides_what_is_behind_it_and_marks_what_nobody_saw() -> None:
    image = texture()
    parallax = flat(0.0)
    parallax[:, 60:100] = 8.0  # before the screen: 4 px to the right for the left eye
    pair = shifted_views(image, parallax)
    assert np.array_equal(pair.left[:, 64:104], image[:, 60:100])
    assert np.array_equal(pair.left[:, 104:], image[:, 104:])
    assert np.array_equal(pair.right[:, 56:96], image[:, 60:100])
    marked = np.flatnonzero(pair.filled_left[0])
    assert marked.tolist() == [60, 61, 62, 63]
    assert np.flatnonzero(pair.filled_right[0]).tolist() == [96, 97, 98, 99]


def test_gaps_are_filled_from_the_farther_side() -> None:
    image = np.full((2, 60), 50, np.uint8)
    image[:, 20:40] = 200
    parallax = np.zeros((2, 60), np.float32)
    parallax[:, 20:40] = 10.0
    pair = shifted_views(image, parallax)
    assert set(pair.left[pair.filled_left].tolist()) == {50}
    assert set(pair.right[pair.filled_right].tolist()) == {50}


def test_eyes_swap_when_depth_changes_its_sign() -> None:
    image = np.dstack([texture(k) for k in range(3)])
    range_um = 20 * texture(9).astype(float) / 255
    near = stereo_pair(image, range_um, pixel_um=0.5)
    far = stereo_pair(image, 2 * middle_plane(range_um) - range_um, pixel_um=0.5)
    mirrored = stereo_pair(image, range_um, pixel_um=0.5, depth_scale=-1)
    assert np.array_equal(near.left, mirrored.right)
    assert np.array_equal(near.right, mirrored.left)
    assert np.mean(np.abs(far.left.astype(int) - near.right)) < 0.01


def test_no_depth_gives_two_equal_views_and_nothing_filled() -> None:
    image = np.random.default_rng(1).integers(0, 65536, (HEIGHT, WIDTH, 3), np.uint16)
    pair = stereo_pair(image, flat(7.0), pixel_um=1.0)
    assert np.array_equal(pair.left, image)
    assert np.array_equal(pair.right, image)
    assert not pair.filled_left.any()
    assert pair.warnings == ()


@given(arrays(np.float32, (3, 40), elements=st.floats(-60, 60, width=32)))
@settings(max_examples=60, deadline=None)
def test_every_pixel_is_seen_or_marked_and_no_colour_is_invented(parallax: np.ndarray) -> None:
    image = texture(2, 3, 40)
    pair = shifted_views(image, parallax)
    for view in (pair.left, pair.right):
        assert view.min() >= image.min()
        assert view.max() <= image.max()
    nearest = np.unravel_index(np.argmax(parallax), parallax.shape)
    for view, filled, share in ((pair.left, pair.filled_left, 0.5), (pair.right, pair.filled_right, -0.5)):
        at = int(np.floor(nearest[1] + share * parallax[nearest] + 0.5))
        assert filled.shape == view.shape
        if 1 <= at < 39 and parallax[nearest] > 2:
            assert not filled[nearest[0], at - 1 : at + 2].all()


def test_too_much_parallax_and_angle_are_told() -> None:
    pair = stereo_pair(texture(), np.linspace(0, 80, WIDTH)[np.newaxis].repeat(HEIGHT, 0), pixel_um=0.5, angle_deg=14)
    assert any("1/30 of the width" in words for words in pair.warnings)
    assert any("hard to fuse" in words for words in pair.warnings)


def test_a_comfortable_pixel_gives_no_warning() -> None:
    planes = np.linspace(0, 11, WIDTH)[np.newaxis].repeat(HEIGHT, 0)
    pixel = comfortable_pixel(planes)
    assert stereo_pair(texture(), planes, pixel_um=pixel).warnings == ()
    low, high = tilt_parallax_px(planes, pixel_um=pixel, angle_deg=8)[0, [2, -3]]
    assert high - low == pytest.approx(2 * WIDTH / 30, rel=0.02)


@pytest.mark.parametrize(
    "wrong",
    [{"pixel_um": 0.0}, {"pixel_um": np.nan}, {"pixel_um": 1, "angle_deg": 90}, {"pixel_um": 1, "angle_deg": -1}],
)
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(DisplayError):
        stereo_pair(texture(), flat(1.0), **wrong)


def test_sizes_that_differ_and_holes_are_refused() -> None:
    with pytest.raises(DisplayError, match="the range image"):
        stereo_pair(texture(), flat(1.0)[:-1], pixel_um=1.0)
    with pytest.raises(DisplayError, match="not numbers"):
        stereo_pair(texture(), flat(np.nan), pixel_um=1.0)
