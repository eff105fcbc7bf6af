"""The stack so far, from frames of a real ring in any order, with some of them missed."""

from types import SimpleNamespace

import numpy as np
import pytest

from acquire.frame import Frame, FrameHeader
from display.live_stack import MOST_BYTES, LiveStack, range_band


def frame(plane, *, section=0, level=None, z_um=None, shape=(20, 24)):
    pixels = np.full(shape, 10 * plane if level is None else level, np.uint16)
    z = float(plane) if z_um is None else z_um
    return Frame(plane, FrameHeader(plane=plane, setpoint_um=z, z_um=z, exposure_ms=1.0, section=section), pixels)


def test_planes_lie_in_their_places_whatever_was_missed():
    stack = LiveStack()
    for plane in (0, 1, 4):
        stack.take(frame(plane, z_um=-2.0 * plane))
    volume = stack.volume(0.5)
    assert volume.bands[0].values[:, 3, 3].tolist() == [0, 10, 0, 0, 40]
    assert volume.spacing_um == pytest.approx((2.0, 0.5, 0.5))


def test_the_highest_plane_is_nearest():
    stack = LiveStack()
    for plane in range(3):
        stack.take(frame(plane, z_um=2.0 * plane))
    assert stack.volume(0.5).bands[0].values[:, 0, 0].tolist() == [20, 10, 0]


def test_a_new_section_begins_a_new_stack():
    stack = LiveStack()
    for plane in range(3):
        stack.take(frame(plane))
    stack.take(frame(0, section=1, level=7))
    assert stack.count == 1
    assert stack.volume().bands[0].values.shape == (1, 20, 24)


def test_a_live_view_between_runs_is_shown_and_not_stacked():
    stack = LiveStack()
    stack.take(frame(-1, level=5))
    assert stack.newest is not None
    assert stack.volume() is None
    assert stack.focus() is None


def test_more_planes_than_expected_find_room():
    stack = LiveStack()
    for plane in range(70):
        stack.take(frame(plane, level=plane))
    assert stack.volume().bands[0].values.shape[0] == 70
    assert MOST_BYTES > 0


def test_focus_and_range_so_far_follow_the_sharpest_plane():
    texture = np.random.default_rng(0).integers(0, 4000, (40, 40)).astype(np.uint16)
    stack = LiveStack()
    for plane in range(7):
        blur = np.full((40, 40), int(texture.mean()), np.uint16)
        pixels = texture if plane == 4 else (0.7 * blur + 0.3 * texture).astype(np.uint16)
        header = FrameHeader(plane=plane, setpoint_um=plane, z_um=-30 + 2.5 * plane, exposure_ms=1.0)
        stack.take(Frame(plane, header, pixels))
    focused, range_um = stack.focus()
    assert np.median(range_um) == pytest.approx(-30 + 2.5 * 4, abs=0.8)
    assert np.corrcoef(focused.ravel(), texture.ravel())[0, 1] > 0.95
    band = range_band(range_um)
    assert band.values.shape == (1, 40, 40)
    assert (band.stand_for, band.unit) == ((range_um.min(), range_um.max()), "µm")


def test_planes_that_were_missed_come_from_the_folder_of_the_run():
    class Run:
        """Stands in for the run's folder: planes by slot."""

        def __init__(self):
            self.planes = {k: SimpleNamespace(header=frame(k).header) for k in range(5)}

        def refresh(self):
            pass

        def read(self, slot):
            return frame(slot).pixels

    stack = LiveStack()
    stack.take(frame(1))
    stack.take(frame(4))
    assert stack.fill(Run(), 2) == 2
    assert stack.fill(Run(), 9) == 1
    assert stack.fill(Run(), 9) == 0
    assert stack.volume().bands[0].values[:, 0, 0].tolist() == [40, 30, 20, 10, 0]
    assert stack.focus() is not None
