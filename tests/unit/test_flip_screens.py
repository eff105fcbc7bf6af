"""What is flipped, drawn by OpenGL: every pixel of views and sync codes; and test pictures for two eyes."""

from __future__ import annotations

import numpy as np
import pytest

from display.flip_screens import ClockedScreen
from display.gl.flip_painter import fitted
from display.glasses_patterns import LEAKS, PATTERNS, pattern
from display.light import encoded
from display.mailbox import Mailbox
from display.pacing import Turn
from display.sync_codes import BLACK, BLUE, CODES, GREEN, MAGENTA, WHITE, marks
from sim.clock import SimClock

WIDTH, HEIGHT = 80, 64
LEFT = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
RIGHT = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
RGB = {BLACK: (0, 0, 0), WHITE: (255, 255, 255), BLUE: (0, 0, 255), GREEN: (0, 255, 0), MAGENTA: (255, 0, 255)}


@pytest.fixture
def screen_of():
    opened = []

    def make(code="none"):
        box = Mailbox.create((WIDTH, HEIGHT))
        screen = ClockedScreen(box, SimClock(), 120.0, code)
        opened.append((screen, box))
        return screen, box

    yield make
    for screen, box in opened:
        screen.close()
        box.remove()


def drawn(screen, turn):
    screen.draw(turn)
    assert screen._painter._context.error == "GL_NO_ERROR"
    return np.frombuffer(screen.pixels(), np.uint8).reshape(HEIGHT, WIDTH, 3)[::-1]


def turn(eye, number=0):
    return Turn(number, eye, 0.0)


def test_each_eye_gets_its_view_of_the_newest_pair_pixel_by_pixel(screen_of):
    screen, box = screen_of()
    assert not drawn(screen, turn("left")).any(), "dark before the first pair"
    box.publish(LEFT, RIGHT)
    assert np.array_equal(drawn(screen, turn("left")), LEFT)
    assert np.array_equal(drawn(screen, turn("right")), RIGHT)
    box.publish(RIGHT, LEFT)
    assert np.array_equal(drawn(screen, turn("left")), RIGHT)
    assert not drawn(screen, None).any()


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("eye", ["left", "right"])
def test_sync_codes_are_where_they_should_be_and_nowhere_else(screen_of, code, eye):
    screen, box = screen_of(code)
    box.publish(LEFT, RIGHT)
    expected = (LEFT if eye == "left" else RIGHT).copy()
    for mark in marks(code, eye, 2, (WIDTH, HEIGHT)):
        expected[mark.y : mark.y + mark.height, mark.x : mark.x + mark.width] = RGB[mark.colour]
    assert np.array_equal(drawn(screen, turn(eye, 2)), expected)


@pytest.mark.parametrize(("code", "colour"), [("white-line", WHITE), ("blue-line", BLUE)])
def test_a_line_is_lit_by_a_quarter_for_the_left_eye_and_three_quarters_for_the_right_one(code, colour):
    for eye, lit in (("left", 20), ("right", 60)):
        first, second = marks(code, eye, 7, (WIDTH, HEIGHT))
        assert (first.x, first.y, first.width, first.height, first.colour) == (0, HEIGHT - 3, lit, 3, colour)
        assert (second.x, second.width, second.colour) == (lit, WIDTH - lit, BLACK)


def test_the_dlp_line_changes_with_every_pair_and_a_pair_begins_with_the_left_eye():
    plain = [("left", 0), ("right", 1), ("left", 2), ("right", 3), ("left", 4)]
    swapped = [("left", 1), ("right", 2), ("left", 3), ("right", 4), ("left", 5)]
    for turns in (plain, swapped):
        colours = [marks("dlp-ready", eye, number, (WIDTH, HEIGHT))[0].colour for eye, number in turns]
        assert colours == [GREEN, GREEN, MAGENTA, MAGENTA, GREEN]
    mark = marks("dlp-ready", "left", 0, (WIDTH, HEIGHT))[0]
    assert (mark.x, mark.y, mark.width, mark.height) == (0, HEIGHT - 1, WIDTH, 1)


def test_one_trigger_box_is_lit_and_the_boxes_do_not_touch():
    lit = {eye: marks("trigger-boxes", eye, 0, (WIDTH, HEIGHT))[1] for eye in ("left", "right")}
    assert lit["left"].colour == lit["right"].colour == WHITE
    assert lit["left"].x + lit["left"].width < lit["right"].x
    assert lit["left"].y == lit["right"].y
    assert marks("trigger-boxes", "left", 0, (2, 1)) == ()


@pytest.mark.parametrize(
    ("inner", "outer", "place"),
    [
        ((80, 60), (160, 120), (0, 0, 160, 120)),
        ((80, 60), (200, 120), (20, 0, 160, 120)),
        ((5, 5), (1, 1), (0, 0, 1, 1)),
    ],
)
def test_a_view_fills_what_it_can_and_keeps_its_shape(inner, outer, place):
    assert fitted(inner, outer) == place


def test_a_clock_in_the_place_of_a_display_keeps_its_rate_and_skips_what_is_over(screen_of):
    screen, _ = screen_of()
    clock = screen._clock
    screen.swap()
    assert clock.now() == pytest.approx(1 / 120)
    clock.sleep(2.5 / 120)
    screen.swap()
    assert clock.now() * 120 == pytest.approx(4)


@pytest.mark.parametrize("kind", PATTERNS)
def test_patterns_fill_the_picture_and_differ_between_the_eyes(kind):
    left, right = pattern(kind, (320, 180))
    assert left.shape == right.shape == (180, 320, 3)
    assert not np.array_equal(left, right)


def test_the_ghost_patch_of_one_eye_is_black_for_the_other_and_the_ladder_is_of_known_light():
    left, right = pattern("crosstalk", (320, 180))
    middle = 90
    assert left[middle, 5, 0] == 255
    assert right[middle, 5, 0] == 0
    assert right[middle, -5, 0] == 255
    assert left[middle, -5, 0] == 0
    for leak in LEAKS:
        assert (left[middle - 14] == encoded(np.array(leak))).any()
        assert (right[middle - 14] == encoded(np.array(leak))).any()


def test_a_disc_is_seen_by_two_eyes_only():
    left, right = (view[..., 0] > 0 for view in pattern("depth", (360, 180)))
    centre = (slice(70, 110), slice(160, 200))
    assert np.array_equal(np.roll(left, -2, axis=1)[centre], np.roll(right, 2, axis=1)[centre])
    assert np.array_equal(left[:20], right[:20])
