"""The monitor of a run: what it keeps of each picture, when it speaks, and that its slice shows seen levels only."""

from types import SimpleNamespace

import numpy as np
import pytest

from acquire.frame import FrameHeader
from display.console.eyes import look
from display.console.monitor import MOST_COLUMNS, MOST_STEPS, Monitor


def run(number=1, sections=1):
    return SimpleNamespace(number=number, sections=sections)


def frame(count, level, *, plane=0, z_um=0.0, section=0, attempt=0, band=0, spread=0):
    """Return a frame of one grey level, or of two that lie `spread` to both sides of it."""
    pixels = np.full((8, 16), level, np.uint16)
    pixels[:, :8] += spread
    pixels[:, 8:] -= spread
    header = FrameHeader(plane, z_um, z_um, 1.0, section=section, attempt=attempt, band=band)
    return look(count, pixels, header, 4095)


def fed(*frames, sections=1, monitor=None):
    monitor = monitor or Monitor()
    return monitor, [monitor.take(each, run(sections=sections)) for each in frames]


def test_mean_and_spread_are_those_of_all_pixels():
    pixels = np.random.default_rng(0).integers(0, 4096, (40, 60, 3)).astype(np.uint16)
    seen = look(1, pixels, FrameHeader(0, 0.0, 0.0, 1.0), 4095)
    assert (seen.mean, seen.sd) == (pytest.approx(pixels.mean()), pytest.approx(pixels.std()))


def test_a_slice_shows_at_every_height_the_plane_nearest_in_z():
    planes = [frame(k + 1, 100 * (k + 1), plane=k, z_um=z_um) for k, z_um in enumerate((0.0, 1.0, 4.0))]
    monitor, _ = fed(*planes)
    assert monitor.reslice(5, 12)[:, 2].tolist() == [300] * 5 + [200] * 4 + [100] * 3
    assert monitor.places().tolist() == [4.0, 1.0, 0.0]


def test_of_a_section_the_sharpest_plane_is_kept_and_of_one_that_was_cut_anew_the_newest():
    blurred, sharp = frame(1, 500, spread=1), frame(2, 600, plane=1, spread=50)
    worse, anew = frame(3, 700, plane=2, spread=2), frame(4, 800, spread=3, attempt=1)
    monitor, _ = fed(blurred, sharp, worse, frame(5, 900, section=1), sections=2)
    assert [step.mean for step in monitor.steps.values()] == [600, 900]
    monitor, _ = fed(blurred, sharp, worse, anew, sections=2)
    assert monitor.steps[0].mean == 800
    assert monitor.of_sections


def test_a_picture_outside_its_limits_is_told_once_it_is_over():
    frames = [frame(k + 1, level, section=k, spread=5) for k, level in enumerate((500, 510, 300, 505, 505))]
    monitor, _ = fed(*frames[:2], sections=9)
    monitor.watch_around()
    assert monitor.limits == {"mean": (404, 606), "sd": (4, 6)}
    _, told = fed(*frames[2:], monitor=monitor, sections=9)
    assert told == ["", "mean grey level 300 of section 3 is outside 404 … 606", ""]


def test_the_last_picture_of_a_run_is_judged_when_it_is_over_and_none_goes_into_the_next_run():
    monitor, _ = fed(frame(1, 500), frame(2, 900, plane=1))
    monitor.limits = {"mean": (400, 600)}
    late = frame(3, 505, plane=2)  # came when the run was over
    assert monitor.rest(late) == "mean grey level 900 of plane 2 is outside 400 … 600"
    assert not monitor.rest(late)
    assert not monitor.take(late, run(number=2))
    assert not monitor.steps


def test_another_run_begins_anew_and_live_frames_and_other_bands_are_left_out():
    monitor, _ = fed(frame(1, 500), frame(2, 500, plane=-1), frame(3, 500, plane=1, band=1))
    assert list(monitor.steps) == [0]
    assert not monitor.take(frame(4, 700, plane=7), run(number=2))
    assert list(monitor.steps) == [7]


def test_a_long_run_takes_no_more_memory_than_its_bound():
    monitor = Monitor()
    wide = np.zeros((2, 3 * MOST_COLUMNS), np.uint16)
    first = look(1, wide, FrameHeader(0, 0.0, 0.0, 1.0), 4095)
    monitor.take(first, run())
    assert monitor.steps[0].row.size == MOST_COLUMNS
    for k in range(1, 3 * MOST_STEPS):
        monitor.take(frame(k + 1, 5, plane=k, z_um=float(k)), run())
    assert len(monitor.steps) <= MOST_STEPS
    assert {0, 3 * MOST_STEPS - 1} <= set(monitor.steps)
