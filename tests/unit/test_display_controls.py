"""Keys, mouse, wheel and time as functions of what is shown."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from display import controls
from display.controls import STEREOS, Shown, drag, grown, press, tick, wheel
from display.scene import View

START = Shown(("mip", "slice", "first"), planes=10, plane=4.0)

EVENTS = [*sorted(controls._KEYS), "f", "drag", "wheel", "tick"]


def after(*keys: str, start: Shown = START) -> Shown:
    for key in keys:
        start = press(start, key)
    return start


def test_modes_and_stereo_go_round_both_ways():
    assert [after(*["m"] * n).mode for n in range(4)] == ["mip", "slice", "first", "mip"]
    assert after("n").mode == "first"
    assert after(*["s"] * len(STEREOS)).stereo.mode == "mono"
    assert after("a").stereo.mode == STEREOS[-1]
    assert after("e").stereo.swap


def test_steps_stop_at_the_ends_and_end_playing():
    assert after("right").plane == 5
    assert after("end", "right").plane == 9
    assert after("home", "left").plane == 0
    assert after("space").playing == 1
    assert after("space", "left").playing == 0
    assert after("space", "space").playing == 0


@pytest.mark.parametrize(("bounce", "expected"), [(False, 0.0), (True, 9.0)])
def test_playing_begins_anew_or_turns_back(bounce, expected):
    start = after(*(["b"] if bounce else []), "end", "space")
    start = tick(start, 0.2)
    assert start.plane == expected
    assert start.playing == (-1 if bounce else 1)
    assert tick(after("end", "backspace"), 0.2).plane == pytest.approx(7.0)


def test_speed_counts_planes_a_second():
    assert tick(after("home", "space"), 0.3).plane == pytest.approx(3.0)
    assert tick(after("home", "space", "up"), 0.3).plane == pytest.approx(4.5)
    assert tick(START, 5.0) == START


def test_the_plane_shown_is_the_middle_of_the_voxel():
    assert after("m").look.at == pytest.approx((0.5, 0.5, 0.45))


def test_mouse_and_wheel():
    turned = drag(START, -10, 5, "left", 2.0).view
    assert (turned.azimuth_deg, turned.elevation_deg) == pytest.approx((4.0, 2.0))
    assert drag(START, 10, 5, "right", 2.0).view.centre_um == pytest.approx((-20.0, -10.0, 0.0))
    assert drag(START, 10, 0, "middle", 2.0).slices.turn_deg == pytest.approx(-4.0)
    assert wheel(START, 2).view.zoom > START.view.zoom > wheel(START, -2).view.zoom


def test_looking_along_axes_keeps_the_zoom():
    near = wheel(START, 3)
    assert after("x", start=near).view == View(azimuth_deg=90, zoom=near.view.zoom)
    assert after("y", "r", start=near).view == View()


def test_whoever_looks_at_the_newest_plane_still_does_when_one_comes():
    assert grown(after("end"), 11).plane == 10
    assert grown(START, 11).plane == 4


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.sampled_from([*sorted(controls._KEYS), "f", "drag", "wheel", "tick"]), max_size=30),
    st.floats(-500, 500),
)
def test_whatever_is_pressed_leaves_something_that_can_be_shown(keys, amount):
    shown = START
    for key in keys:
        if key == "drag":
            shown = drag(shown, amount, -amount, "left", 1.0)
        elif key == "wheel":
            shown = wheel(shown, amount)
        else:
            shown = tick(shown, abs(amount) / 100) if key == "tick" else press(shown, key)
    assert 0 <= shown.plane <= 9
    assert shown.mode in shown.modes
    assert np.isfinite([shown.view.azimuth_deg, shown.view.zoom, shown.speed]).all()
    assert 0 < shown.view.zoom < 1e3
