"""Pictures made of two views: every pixel where it belongs, every colour by its matrix, in linear light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DisplayError
from display.compose import LAID, MATRICES, PICTURES, WOVEN, compose
from display.light import LUMINANCE, encoded, encoded_share, linear, linear_of

if TYPE_CHECKING:
    from display.stereo import Mode

WHITE, BLACK = np.full((2, 2, 3), 255, np.uint8), np.zeros((2, 2, 3), np.uint8)
LEFT = np.random.default_rng(0).integers(0, 256, (108, 20, 3), np.uint8)
RIGHT = np.random.default_rng(1).integers(0, 256, (108, 20, 3), np.uint8)
FILTERS = {  # what the glasses let through: left, right
    "grey": ([1, 0, 0], [0, 1, 1]),
    "colour": ([1, 0, 0], [0, 1, 1]),
    "half-colour": ([1, 0, 0], [0, 1, 1]),
    "optimised": ([1, 0, 0], [0, 1, 1]),
    "red-green": ([1, 0, 0], [0, 1, 0]),
    "red-blue": ([1, 0, 0], [0, 0, 1]),
}


def colour(*rgb: int) -> np.ndarray:
    return np.array([[rgb]], np.uint8)


def test_light_and_grey_levels_are_the_standards_curve_and_its_inverse() -> None:
    levels = np.arange(256, dtype=np.uint8)
    assert np.array_equal(encoded(linear(levels)), levels)
    assert linear(levels) == pytest.approx(linear_of(levels / 255), abs=1e-7)
    assert encoded_share(linear_of(levels / 255)) == pytest.approx(levels / 255, abs=1e-6)
    assert encoded(np.array([-1.0, 2.0, np.nan, np.inf])).tolist() == [0, 255, 0, 255]


@given(st.floats(0, 1))
def test_a_grey_level_is_never_off_by_more_than_half_and_a_little(light: float) -> None:
    assert abs(int(encoded(np.array(light))) - 255 * float(encoded_share(np.array(light)))) <= 0.6


@pytest.mark.parametrize("kind", MATRICES)
def test_rows_sum_to_one_and_white_stays_white(kind: str) -> None:
    shown = MATRICES[kind].any(axis=1)
    assert MATRICES[kind].sum(axis=1)[shown] == pytest.approx(1.0, abs=1e-12)
    mode: Mode = f"anaglyph-{kind}"  # type: ignore[assignment]
    assert compose(WHITE, WHITE, mode)[0, 0].tolist() == (255 * shown).tolist()
    assert compose(BLACK, BLACK, mode).max() == 0


@pytest.mark.parametrize("kind", sorted(set(MATRICES) - {"red-green", "red-blue", "optimised"}))
def test_equal_grey_views_give_a_grey_anaglyph(kind: str) -> None:
    levels = np.arange(256, dtype=np.uint8)[np.newaxis]
    picture = compose(levels, levels, f"anaglyph-{kind}")  # type: ignore[arg-type]
    assert picture.shape == (1, 256, 3)
    assert np.abs(picture.astype(int) - levels[..., np.newaxis]).max() <= 1


@pytest.mark.parametrize("kind", FILTERS)
def test_each_eye_gets_its_own_light_alone(kind: str) -> None:
    left, right = np.array(FILTERS[kind])
    mode: Mode = f"anaglyph-{kind}"  # type: ignore[assignment]
    assert compose(WHITE, BLACK, mode)[0, 0].tolist() == (255 * left).tolist()
    assert compose(BLACK, WHITE, mode)[0, 0].tolist() == (255 * right).tolist()
    assert compose(BLACK, WHITE, mode, swap=True)[0, 0].tolist() == (255 * left).tolist()


def test_primaries_follow_the_published_matrices_in_linear_light() -> None:
    green, none = colour(0, 255, 0), colour(0, 0, 0)
    assert compose(none, green, "anaglyph-dubois")[0, 0].tolist() == encoded(np.array([0, 0.7336, 0])).tolist()
    assert compose(green, none, "anaglyph-dubois")[0, 0].tolist() == encoded(np.array([0.5005, 0, 0])).tolist()
    assert compose(none, green, "anaglyph-dubois-lcd")[0, 0].tolist() == encoded(np.array([0, 0.7618, 0.0])).tolist()
    assert compose(green, none, "anaglyph-green-magenta")[0, 0, 1] == encoded(np.array(0.668 / 0.999))
    assert compose(none, colour(0, 0, 255), "anaglyph-amber-blue")[0, 0, 2] == encoded(np.array(0.911 / 1.001))


def test_colours_go_through_where_they_should() -> None:
    left, right = colour(200, 10, 20), colour(30, 120, 220)
    grey = encoded(linear(np.array([[200, 10, 20], [30, 120, 220]], np.uint8)) @ LUMINANCE).tolist()
    assert compose(left, right, "anaglyph-colour")[0, 0].tolist() == [200, 120, 220]
    assert compose(left, right, "anaglyph-half-colour")[0, 0].tolist() == [grey[0], 120, 220]
    assert compose(left, right, "anaglyph-grey")[0, 0].tolist() == [grey[0], grey[1], grey[1]]
    assert compose(colour(255, 0, 0), right, "anaglyph-optimised")[0, 0, 0] == 0


@pytest.mark.parametrize("mode", PICTURES)
def test_light_and_grey_levels_are_composed_alike(mode: Mode) -> None:
    of_light = encoded(compose(linear(LEFT), linear(RIGHT), mode))
    assert np.abs(of_light.astype(int) - compose(LEFT, RIGHT, mode)).max() <= 1
    assert np.array_equal(compose(LEFT, RIGHT, mode, swap=True), compose(RIGHT, LEFT, mode))


def test_whole_views_lie_where_they_should() -> None:
    assert np.array_equal(compose(LEFT, RIGHT, "parallel")[:, :20], LEFT)
    assert np.array_equal(compose(LEFT, RIGHT, "crossed")[:, :20], RIGHT)
    assert np.array_equal(compose(LEFT, RIGHT, "over-under")[108:], RIGHT)


@pytest.mark.parametrize(("rows", "packed"), [(1080, 2205), (720, 1470)])
def test_frame_packing_has_the_rows_of_hdmi(rows: int, packed: int) -> None:
    left, right = np.full((rows, 2), 7, np.uint8), np.full((rows, 2), 9, np.uint8)
    picture = compose(left, right, "frame-packed")
    assert picture.shape == (packed, 2)
    assert (picture[:rows] == 7).all()
    assert (picture[-rows:] == 9).all()
    assert not picture[rows:-rows].any()


@pytest.mark.parametrize("mode", WOVEN)
@given(row=st.integers(0, 9), column=st.integers(0, 9))
@settings(max_examples=10, deadline=None)
def test_what_is_woven_follows_the_screen_and_not_the_window(mode: Mode, row: int, column: int) -> None:
    left, right = np.zeros((30, 30), np.uint8), np.full((30, 30), 255, np.uint8)
    screen = compose(left, right, mode)
    window = compose(left[:8, :8], right[:8, :8], mode, origin=(row, column))
    assert np.array_equal(window, screen[row : row + 8, column : column + 8])
    assert screen.mean() == 127.5
    assert not screen[0, 0]


def test_views_that_do_not_fit_and_modes_that_are_no_picture_are_refused() -> None:
    with pytest.raises(DisplayError, match="the left view is 108 × 20 × 3 uint8, the right one 107"):
        compose(LEFT, RIGHT[1:], "rows")
    with pytest.raises(DisplayError, match="page-flip"):
        compose(LEFT, RIGHT, "page-flip")
    assert len(PICTURES) == len(LAID) + len(WOVEN) + len(MATRICES)
