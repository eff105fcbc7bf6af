"""The plain simulated stage and camera, on simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from devices.errors import DeviceError, LimitError, StageStalled, StageTimeout
from devices.protocols import Camera, Stage
from devices.values import CameraCaps, Limits
from sim.camera import Replay, SimCamera
from sim.clock import SimClock
from sim.motion import Axis, Ringing
from sim.stage import SimStage

CAPS = CameraCaps("replay", 2, 3, 1, "uint16", 12, timed=True)


class Recording:
    """A frame maker that notes the path of every exposure."""

    def __init__(self, meanwhile=lambda: None) -> None:
        self.paths: list[list[float]] = []
        self.meanwhile = meanwhile

    def caps(self) -> CameraCaps:
        return CAPS

    def expose(self, path_um, exposure_ms, out) -> None:
        self.paths.append(path_um.tolist())
        self.meanwhile()
        out.fill(len(self.paths))


@pytest.fixture
def axis() -> Axis:
    return Axis(SimClock(), Limits(-100.0, 100.0), ringing=Ringing(decay_s=0.002))


def test_they_are_devices(axis):
    assert isinstance(SimStage(axis), Stage)
    assert isinstance(SimCamera(Recording(), axis), Camera)


def test_stage_arrives_and_rests(axis):
    stage = SimStage(axis)
    stage.move_to(42.0)
    assert stage.position_um() == 0.0
    assert stage.settle(5.0) == 42.0
    assert axis.commanded.at_rest(axis.clock.now())


def test_stage_refuses_what_is_outside_and_stays(axis):
    stage = SimStage(axis)
    with pytest.raises(LimitError, match=r"100\.50"):
        stage.move_to(100.5)
    assert not axis.moving()


def test_stage_says_when_it_is_late_halted_or_blocked(axis):
    stage = SimStage(axis)
    stage.move_to(90.0)
    with pytest.raises(StageTimeout, match="still moving"):
        stage.settle(0.02)
    stage.halt()
    with pytest.raises(StageStalled, match=r"on the way to \+90\.00"):
        stage.settle(5.0)
    axis.obstruct(95.0)
    stage.move_to(99.0)
    with pytest.raises(StageStalled, match=r"\+95\.00"):
        stage.settle(5.0)


def test_camera_delivers_frames_with_their_times(axis):
    got = []
    camera = SimCamera(Recording(), axis)
    camera.configure(exposure_ms=20.0)
    camera.arm(2, lambda pixels, stamp: got.append((int(pixels[0, 0]), stamp)))
    camera.trigger()
    camera.trigger()
    (first, stamp), (second, later) = got
    assert (first, second) == (1, 2)
    assert (stamp.exposure_start_ns, stamp.exposure_end_ns, stamp.arrival_ns) == (0, 20_000_000, 20_000_000)
    assert (stamp.hw_id, later.hw_id, later.exposure_start_ns) == (1, 2, 20_000_000)
    with pytest.raises(DeviceError, match="armed"):
        camera.trigger()


def test_pixels_cannot_be_written_by_the_sink(axis):
    def scribble(pixels, stamp):
        pixels[:] = 0

    camera = SimCamera(Recording(), axis)
    camera.arm(1, scribble)
    with pytest.raises(ValueError, match="read-only"):
        camera.trigger()


def test_no_frame_after_stop(axis):
    camera = SimCamera(Recording(), axis)
    camera.arm(None, lambda pixels, stamp: pytest.fail("delivered"))
    camera.stop(1.0)
    with pytest.raises(DeviceError, match="armed"):
        camera.trigger()


def test_camera_refuses_impossible_exposures(axis):
    for exposure_ms in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(LimitError):
            SimCamera(Recording(), axis).configure(exposure_ms=exposure_ms)


def test_exposure_sees_the_true_path_also_when_the_target_changes_meanwhile(axis):
    maker = Recording()
    camera = SimCamera(maker, axis)
    camera.configure(exposure_ms=100.0)
    camera.arm(None, lambda pixels, stamp: None)
    camera.trigger()
    assert maker.paths == [[0.0]]
    maker.meanwhile = lambda: axis.move_to(50.0) if len(maker.paths) == 2 else None
    camera.trigger()
    expected, seen_last = maker.paths[1:]
    assert expected == [0.0]
    assert seen_last[0] < 1.0
    assert seen_last[-1] > 49.0


def test_replay_hands_out_its_frames_in_turn(axis):
    frames = np.arange(12, dtype=np.uint16).reshape(2, 2, 3)
    got = []
    camera = SimCamera(Replay(frames, CAPS), axis)
    camera.arm(None, lambda pixels, stamp: got.append(pixels.copy()))
    for _ in range(3):
        camera.trigger()
    assert np.array_equal(got, frames[[0, 1, 0]])
