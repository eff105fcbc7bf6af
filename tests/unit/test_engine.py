"""The engine: every plane where the plan says, no frame exposed while moving, and the stage halted whatever happens."""

import threading

import numpy as np
import pytest

from acquire.engine import Policy, Run, RunState
from acquire.plan import StackPlan
from acquire.store import RunEnd
from devices.errors import CameraTimeout, DeviceError, LimitError, LinkLost, StageStalled, StoreError
from devices.values import CameraCaps, FrameStamp, Limits

PLAN = StackPlan(start_nm=-4000, step_nm=2000, count=5, exposure_ms=10.0, overshoot_nm=500, return_nm=0)


class ScriptedClock:
    """A clock that only `sleep` moves."""

    def __init__(self):
        self.t = 100.0

    def now(self):
        return self.t

    def sleep(self, seconds):
        self.t += seconds

    @property
    def ns(self):
        return round(self.t * 1e9)


class ScriptedStage:
    """Moves at 100 µm/s in the scripted time and writes down what it was asked."""

    def __init__(self, clock, error_um=0.0):
        self.clock, self.error_um = clock, error_um
        self.z_um, self.log, self.moving = 0.0, [], []
        self.limits = Limits(-10, 10)
        self.faults = {}

    def move_to(self, z_um):
        self.limits.check(z_um)
        self.log.append(z_um)
        self.target = z_um

    def settle(self, timeout_s):
        if fault := self.faults.pop(len(self.log), None):
            raise fault
        start = self.clock.t
        self.clock.sleep(abs(self.target - self.z_um) / 100)
        self.moving.append((round(start * 1e9), self.clock.ns))
        self.z_um = self.target + self.error_um
        return self.z_um

    def position_um(self):
        return self.z_um

    def halt(self):
        self.log.append("halt")

    def close(self):
        pass


class ScriptedCamera:
    """Exposes when triggered; ``script`` may replace single triggers by something else."""

    def __init__(self, clock, stage):
        self.clock, self.stage, self.script, self.triggers = clock, stage, {}, 0
        self.sink = None

    def caps(self):
        return CameraCaps("scripted", 4, 6, 1, "uint16", 16, timed=True)

    def configure(self, *, exposure_ms):
        self.exposure_s = exposure_ms / 1000

    def arm(self, frames, sink):
        self.sink = sink

    def deliver(self, start_ns):
        pixels = np.full((4, 6), round(self.stage.z_um * 1000) % 65536, np.uint16)
        self.sink(pixels, FrameStamp(self.clock.ns, self.triggers, start_ns, self.clock.ns))

    def trigger(self):
        self.triggers += 1
        act = self.script.get(self.triggers, "expose")
        if callable(act):
            act = act()
        if act == "expose":
            start = self.clock.ns
            self.clock.sleep(self.exposure_s)
            self.deliver(start)

    def stop(self, timeout_s):
        self.sink = None

    def close(self):
        pass


class Memory:
    """Keeps frames in a list; may refuse."""

    def __init__(self):
        self.frames, self.gaps, self.end, self.refuse = [], [], None, {}

    @property
    def durable(self):
        return len(self.frames)

    def check(self):
        if error := self.refuse.get(len(self.frames)):
            raise error

    def put(self, pixels, header):
        self.frames.append((header, pixels.copy()))

    def missed(self, missed):
        self.gaps.append(missed)

    def finish(self, end, reason=""):
        self.end = (end, reason)
        return RunEnd.COMPLETED_WITH_GAPS if self.gaps and end is RunEnd.COMPLETED else end


class Bench:
    def __init__(self, plan=PLAN, error_um=0.01, **options):
        self.clock = ScriptedClock()
        self.stage = ScriptedStage(self.clock, error_um)
        self.camera = ScriptedCamera(self.clock, self.stage)
        self.out = Memory()
        self.told = []
        self.run = Run(plan, self.stage, self.camera, self.out, self.clock, tell=self.told.append, **options)

    @property
    def planes(self):
        return [header.plane for header, _ in self.out.frames]


def test_every_plane_is_taken_once_with_setpoint_and_readback():
    bench = Bench()
    assert bench.run.execute() is RunState.COMPLETED
    assert bench.planes == [0, 1, 2, 3, 4]
    assert [h.setpoint_um for h, _ in bench.out.frames] == [-4, -2, 0, 2, 4]
    assert [h.z_um for h, _ in bench.out.frames] == pytest.approx([-3.99, -1.99, 0.01, 2.01, 4.01])


def test_no_frame_is_exposed_while_the_stage_moves():
    bench = Bench()
    bench.run.execute()
    for header, _ in bench.out.frames:
        assert all(
            end <= header.exposure_start_ns or start >= header.exposure_end_ns for start, end in bench.stage.moving
        )


def test_planes_are_approached_from_one_side_and_the_stage_comes_back():
    bench = Bench()
    bench.run.execute()
    assert bench.stage.log == [-4.5, -4.0, -2.0, 0.0, 2.0, 4.0, "halt", 0.0]


def test_a_frame_that_began_before_the_stage_settled_belongs_to_no_plane():
    bench = Bench()
    stale = bench.clock.ns - 1

    def old_then_new():
        bench.camera.deliver(stale)
        return "expose"

    bench.camera.script = {2: old_then_new}
    assert bench.run.execute() is RunState.COMPLETED
    assert bench.planes == [0, 1, 2, 3, 4]
    assert all(header.exposure_start_ns > stale for header, _ in bench.out.frames)


def test_an_untimed_camera_is_judged_by_its_earliest_possible_beginning():
    bench = Bench()
    caps = CameraCaps("untimed", 4, 6, 1, "uint16", 16, timed=False, readout_ms=5.0)
    bench.camera.caps = lambda: caps
    bench.run = Run(PLAN, bench.stage, bench.camera, bench.out, bench.clock)
    arrivals = []

    def frames_at_camera_rate():
        for _ in range(4):
            bench.clock.sleep(0.008)
            arrivals.append(bench.clock.ns)
            bench.camera.deliver(None)

    bench.camera.script = dict.fromkeys(range(1, 6), frames_at_camera_rate)
    assert bench.run.execute() is RunState.COMPLETED
    # settled, then frames 8, 16, 24 ms later: only the one 16 ms later cannot have begun before
    assert [header.arrival_ns for header, _ in bench.out.frames] == arrivals[1::4]


def test_a_camera_that_misses_once_is_asked_again_for_the_same_plane():
    bench = Bench()
    bench.camera.script = {3: lambda: None}
    assert bench.run.execute() is RunState.COMPLETED
    assert bench.planes == [0, 1, 2, 3, 4]
    assert [header.attempt for header, _ in bench.out.frames] == [0, 0, 1, 0, 0]


def dead_camera(bench, triggers):
    def silent():
        raise CameraTimeout("no frame")

    bench.camera.script = dict.fromkeys(triggers, silent)


def test_a_camera_that_stays_silent_ends_the_run():
    bench = Bench()
    dead_camera(bench, range(3, 99))
    assert bench.run.execute() is RunState.FAILED
    assert bench.planes == [0, 1]
    assert bench.run.error.code == "camera-timeout"
    assert bench.out.end[0] is RunEnd.FAILED
    assert bench.stage.log[-2:] == ["halt", 0.0]


def test_or_leaves_a_gap_in_its_place_if_the_recipe_says_so():
    bench = Bench(policy=Policy(gap_on_error=True))
    dead_camera(bench, range(3, 6))
    assert bench.run.execute() is RunState.COMPLETED_WITH_GAPS
    assert bench.planes == [0, 1, 3, 4]
    assert [(gap.plane, gap.reason) for gap in bench.out.gaps] == [(2, "camera-timeout")]


def test_a_plane_out_of_tolerance_is_approached_again_then_the_run_ends():
    bench = Bench(error_um=0.3)
    assert bench.run.execute() is RunState.FAILED
    assert bench.out.frames == []
    assert bench.run.error.code == "stage-stalled"
    assert bench.stage.log == [-4.5, -4.0, "halt", -4.5, -4.0, "halt", "halt"]


@pytest.mark.parametrize("fault", [LinkLost("z stage: gone"), StageStalled("z stage: stuck")])
def test_a_stage_that_fails_is_halted_and_not_sent_anywhere(fault):
    bench = Bench()
    bench.stage.faults = {4: fault}
    assert bench.run.execute() is RunState.FAILED
    assert bench.run.error is fault
    assert bench.stage.log == [-4.5, -4.0, -2.0, 0.0, "halt"]
    assert bench.planes == [0, 1]


def test_the_disk_is_asked_before_each_exposure():
    bench = Bench()
    bench.out.refuse = {2: StoreError("data: the disk is full.", code="disk-full")}
    assert bench.run.execute() is RunState.FAILED
    assert bench.camera.triggers == 2
    assert bench.run.error.code == "disk-full"
    assert bench.stage.log[-1] == 0.0


def test_nothing_moves_when_a_plane_is_outside_the_limits():
    bench = Bench(plan=StackPlan(start_nm=0, step_nm=2000, count=7, exposure_ms=10.0))
    assert bench.run.execute() is RunState.FAILED
    assert isinstance(bench.run.error, LimitError)
    assert bench.stage.log == ["halt"]


def test_cancel_keeps_what_was_taken_and_goes_back():
    bench = Bench()
    bench.camera.script = {3: lambda: bench.run.cancel() or "expose"}
    assert bench.run.execute() is RunState.CANCELLED
    assert bench.planes == [0, 1, 2]
    assert bench.stage.log[-2:] == ["halt", 0.0]


def test_cancel_during_a_move_halts_it():
    bench = Bench()
    settle = bench.stage.settle

    def cancelled_move(timeout_s):
        if bench.stage.log[-1] == 2.0:
            bench.run.cancel()
            raise StageStalled("z stage: the move was halted")
        return settle(timeout_s)

    bench.stage.settle = cancelled_move
    assert bench.run.execute() is RunState.CANCELLED
    assert bench.run.error is None
    assert bench.stage.log == [-4.5, -4.0, -2.0, 0.0, 2.0, "halt", "halt", 0.0]


def test_stop_leaves_the_stage_where_it_is():
    bench = Bench()
    bench.camera.script = {2: lambda: bench.run.stop() or "expose"}
    assert bench.run.execute() is RunState.CANCELLED
    assert bench.stage.log == [-4.5, -4.0, -2.0, "halt", "halt"]


def test_pause_waits_before_the_next_plane():
    bench = Bench()
    paused = []

    def pause():
        bench.run.pause()
        return "expose"

    def watch(event):
        if event.get("state") == "PAUSED":
            paused.append((list(bench.planes), bench.run.status.state))
            bench.run.resume()

    bench.run._tell = watch
    bench.camera.script = {2: pause}
    assert bench.run.execute() is RunState.COMPLETED
    assert paused == [([0, 1], RunState.PAUSED)]


def test_the_stage_is_halted_when_the_caller_breaks_off():
    bench = Bench()

    def break_off(event):
        if event.get("plane") == 1:
            raise KeyboardInterrupt

    bench.run._tell = break_off
    with pytest.raises(KeyboardInterrupt):
        bench.run.execute()
    assert "halt" in bench.stage.log
    assert bench.out.end[0] is RunEnd.FAILED


def test_a_frame_of_another_size_is_refused():
    bench = Bench()
    wrong = FrameStamp(bench.clock.ns + 10**12, 1, bench.clock.ns + 10**12)
    bench.camera.script = {1: lambda: bench.camera.sink(np.zeros((5, 6), np.uint16), wrong)}
    assert bench.run.execute() is RunState.FAILED
    assert "(5, 6)" in str(bench.run.error)
    assert bench.out.frames == []


def test_status_is_read_from_another_thread_while_the_run_goes_on():
    bench = Bench()
    seen = []

    def look():
        reader = threading.Thread(target=lambda: seen.append(bench.run.status))
        reader.start()
        reader.join()
        return "expose"

    bench.camera.script = {4: look}
    bench.run.execute()
    assert (seen[0].state, seen[0].plane, seen[0].taken, seen[0].planned) == (RunState.RUNNING, 3, 3, 5)


def gone():
    raise LinkLost("camera: the connection broke.")


def test_a_camera_that_went_away_is_opened_anew_and_no_plane_is_lost():
    opened = []

    def reopen():
        if len(opened) < 2:
            opened.append(None)
            raise DeviceError("camera: nothing answers.", code="device-missing")
        opened.append(ScriptedCamera(bench.clock, bench.stage))
        return opened[-1]

    bench = Bench(reopen_camera=reopen)
    bench.camera.script[3] = gone
    begin_s = bench.clock.t
    assert bench.run.execute() is RunState.COMPLETED
    assert bench.planes == [0, 1, 2, 3, 4]
    assert bench.camera.triggers == 3
    assert opened[-1].triggers == 3
    assert bench.clock.t - begin_s > 1 + 2 + 5
    assert [event["code"] for event in bench.told if event["event"] == "warn"] == ["camera-gone"] * 3


def test_a_camera_that_stays_away_ends_a_focal_stack_by_name():
    bench = Bench(reopen_camera=gone)
    bench.camera.script[3] = gone
    assert bench.run.execute() is RunState.FAILED
    assert bench.run.error.code == "camera-gone"
    assert bench.planes == [0, 1]
    assert bench.out.end[0] is RunEnd.FAILED
