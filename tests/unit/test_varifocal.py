"""Planes before a simulated mirror: each where it belongs, all of them in every pass, dark otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.cli import run
from devices.errors import DisplayError
from display.pacing import Beat
from display.varifocal import FLYBACK, Mirror, Sweep, even_planes
from sim.mirror import SimMirror

HZ, REACH_UM, FRAMES_HZ = 31.0, 100.0, 2880.0


def swept(mirror: Mirror, truth: SimMirror, planes: int, seconds: float = 2.0):
    """Show frames as the scheduler says; returns (plane, time, true depth in the frame's middle) of lit ones."""
    sweep = Sweep(mirror, even_planes(planes, mirror), 1 / FRAMES_HZ)
    beat, number, shown = Beat(0.0, 1 / mirror.hz), 0, []
    for frame in range(round(seconds * FRAMES_HZ)):
        begin_s = frame / FRAMES_HZ
        while truth.pulse_s(number) <= begin_s:
            beat, number = beat.followed(truth.pulse_s(number)), number + 1
        plane = sweep.due(beat, begin_s)
        if plane is not None:
            shown.append((plane, begin_s, truth.depth_um(begin_s + 0.5 / FRAMES_HZ)))
    return sweep, shown


@pytest.mark.parametrize("lag_s", [0.0, 2.7e-3])
def test_every_plane_is_where_it_belongs_and_none_is_missed(lag_s):
    truth = SimMirror(HZ, REACH_UM, off_ppm=300, lag_s=lag_s, jitter_s=40e-6, seed=3)
    mirror = Mirror(HZ, REACH_UM, lag=lag_s * HZ)
    sweep, shown = swept(mirror, truth, 12)
    settled = [entry for entry in shown if entry[1] > 1.0]
    off = np.array([depth - sweep.depths_um[plane] for plane, _, depth in settled])
    assert np.abs(off).max() <= 0.5 * sweep.blur_um.max() + 1.5
    counts = np.bincount([plane for plane, _, _ in settled], minlength=12)
    assert counts == pytest.approx(np.full(12, HZ * 2), abs=2)
    assert mirror.volumes_hz >= 30


def test_a_wrong_lag_shows_planes_in_the_wrong_place():
    truth = SimMirror(HZ, REACH_UM, lag_s=2.0e-3)
    sweep, shown = swept(Mirror(HZ, REACH_UM), truth, 12, 1.5)
    off = np.array([depth - sweep.depths_um[plane] for plane, _, depth in shown])
    assert np.abs(off).max() > 20


@given(
    hz=st.floats(15.1, 100),
    lag=st.floats(0, 1, exclude_max=True),
    share=st.floats(-0.99, 0.99),
    waveform=st.sampled_from(["sine", "triangle"]),
)
def test_a_crossing_is_where_the_mirror_is_at_that_depth(hz, lag, share, waveform):
    mirror = Mirror(hz, REACH_UM, waveform, lag)
    phases = mirror.crossings(np.array([share * REACH_UM]))
    assert mirror.depth_um(phases) == pytest.approx(np.full((2, 1), share * REACH_UM), abs=1e-6)


def test_a_sawtooth_shows_nothing_on_its_way_back():
    mirror = Mirror(30.0, REACH_UM, "sawtooth")
    assert mirror.volumes_hz == 30
    sweep = Sweep(mirror, even_planes(10, mirror), 1 / FRAMES_HZ)
    phases, planes = sweep.timetable
    assert planes.tolist() == list(range(10))
    assert phases.max() < 1 - FLYBACK
    assert mirror.depth_um(phases) == pytest.approx(sweep.depths_um)


def test_frames_between_planes_are_dark_and_order_turns_around():
    mirror = Mirror(HZ, REACH_UM)
    sweep = Sweep(mirror, even_planes(5, mirror), 1 / FRAMES_HZ)
    frames = [sweep.due(Beat(0.0, 1 / HZ), n / FRAMES_HZ) for n in range(92)]
    assert [plane for plane in frames if plane is not None] == [2, 3, 4, 4, 3, 2, 1, 0, 0, 1]
    assert frames.count(None) > 70


def test_blur_is_the_way_of_the_mirror_while_a_plane_is_lit():
    mirror = Mirror(HZ, REACH_UM)
    sweep = Sweep(mirror, even_planes(5, mirror), 1 / FRAMES_HZ)
    assert sweep.blur_um[2] == pytest.approx(2 * np.pi * HZ * REACH_UM / FRAMES_HZ, rel=1e-3)
    assert sweep.blur_um[0] < sweep.blur_um[2]


def test_what_cannot_be_shown_is_refused_and_says_what_can():
    with pytest.raises(DisplayError, match="24 volumes a second; they flicker"):
        Mirror(12.0, REACH_UM)
    with pytest.raises(DisplayError, match="no mirror"):
        Mirror(np.nan, REACH_UM)
    mirror = Mirror(HZ, REACH_UM)
    with pytest.raises(DisplayError, match="do not lie within"):
        Sweep(mirror, np.array([0.0, 100.0]), 1e-4)
    with pytest.raises(DisplayError) as refused:
        Sweep(mirror, even_planes(60, mirror), 1 / 1000.0)
    assert "at most " in refused.value.fix[0]
    most = int(refused.value.fix[0].split()[2])
    assert Sweep(mirror, even_planes(most, mirror), 1 / 1000.0).shortest_s >= 1 / 1000.0
    with pytest.raises(DisplayError):
        Sweep(mirror, even_planes(most + 1, mirror), 1 / 1000.0)
    assert Sweep(mirror, np.zeros(1), 1e-3).due(Beat(0.0, 1 / HZ), -0.2e-3) == 0


def test_the_command_writes_a_picture_and_a_table(tmp_path, capsys):
    out = tmp_path / "sweep.png"
    assert run(["varifocal", "-o", str(out), "--planes", "8"]) == 0
    assert "60 volumes a second, 8 planes" in capsys.readouterr().out
    rows = out.with_suffix(".csv").read_text().splitlines()
    assert len(rows) == 1 + 16
    assert run(["varifocal", "-o", str(tmp_path / "b.png"), "--planes", "500"]) == 10
    assert "error[sweep]" in capsys.readouterr().err
