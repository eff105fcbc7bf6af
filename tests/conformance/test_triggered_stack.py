"""Stacks that stage and camera trigger between themselves, on the simulated bench over its real wires."""

from __future__ import annotations

import threading
from contextlib import closing, contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquire.engine import Policy, Run, RunState
from acquire.plan import StackPlan
from acquire.sequence import PATIENCE, check_triggered
from devices.clock import SystemClock
from devices.drivers import asi, asi_tiger, sim_camera
from devices.errors import LimitError, PlanError
from devices.protocols import SequencedStage, TriggeredCamera
from devices.registry import DeviceContext
from devices.rig import AxisSpec, CameraSpec
from devices.values import CameraCaps, Limits
from sim.camera import Replay, SimCamera
from sim.camera_server import CameraServer
from sim.controllers.asi import Ms2000
from sim.controllers.asi_tiger import Tiger
from sim.faults import Faults, FaultyTwin, parse_faults
from sim.motion import Axis
from sim.serial_line import SerialLine
from sim.stage import SimStage
from sim.triggered_camera import FaultyLines, TriggerLines

if TYPE_CHECKING:
    from collections.abc import Callable

LIMITS = {"min_um": -200.0, "max_um": 200.0}
SHAPE = (6, 8)
EXPOSURE_MS = 10.0
CAPS = CameraCaps("replay", *SHAPE, bands=1, dtype="uint16", bit_depth=16, timed=True)
DRIVERS = {"asi-ms2000": (asi.open_stage, Ms2000), "asi-tiger": (asi_tiger.open_stage, Tiger)}


class Kept:
    """Where frames go; knows nothing of devices."""

    durable = 0

    def __init__(self) -> None:
        self.headers, self.gaps, self.end = {}, [], None

    def check(self) -> None:
        pass

    def put(self, pixels, header) -> None:
        assert header.plane not in self.headers, "a plane was recorded twice"
        self.headers[header.plane] = header

    def missed(self, missed) -> None:
        self.gaps.append(missed.plane)

    def finish(self, end, reason=""):
        self.end = end
        return end


class Setup:
    """A bench in this process, on a pseudo-terminal and a TCP port, with the real drivers at their other ends."""

    def __init__(self, stage, camera, axis, twin, server) -> None:
        self.stage, self.camera, self.axis, self.twin, self.server = stage, camera, axis, twin, server
        self.out, self.told = Kept(), []
        self.on_plane: Callable[[int], None] = lambda plane: None

    def tell(self, event: dict) -> None:
        self.told.append(event)
        if event["event"] == "plane":
            self.on_plane(event["plane"])

    def run(self, plan: StackPlan) -> RunState:
        self.engine = Run(
            plan,
            self.stage,
            self.camera,
            self.out,
            SystemClock(),
            policy=Policy(triggered=True),
            tell=self.tell,
        )
        return self.engine.execute()

    @property
    def warnings(self) -> str:
        return "; ".join(told["message"] for told in self.told if told["event"] == "warn")

    def strayed_um(self, plan: StackPlan) -> float:
        """Largest distance from a plane to where the axis truly was while its frame was exposed."""
        return max(
            np.abs(self.axis.path_um(h.exposure_start_ns / 1e9, h.exposure_end_ns / 1e9) - to_um(plan, h.plane)).max()
            for h in self.out.headers.values()
        )


def to_um(plan: StackPlan, plane: int) -> float:
    return (plan.start_nm + plane * plan.step_nm) / 1000


@contextmanager
def bench(*faults: str, driver: str = "asi-ms2000", baud: int = 115200, settle_ms: float = 0):
    clock = SystemClock()
    open_stage, make_twin = DRIVERS[driver]
    axis = Axis(clock, Limits(**LIMITS))
    twin = make_twin({"X": Axis(clock, Limits(**LIMITS)), "Y": Axis(clock, Limits(**LIMITS)), "Z": axis})
    struck = Faults(parse_faults(faults), clock)
    line = SerialLine(FaultyTwin(twin.feed, struck, "z").feed, baud, clock)
    maker = Replay(np.zeros((1, *SHAPE), np.uint16), CAPS)
    server = CameraServer(maker, axis, struck, exposure_ms=EXPOSURE_MS, lines=FaultyLines(twin, struck))
    threading.Thread(target=server.serve, daemon=True).start()
    table = {"driver": "asi-ms2000", "port": line.port, "baud": baud, "limits": LIMITS, "settle_ms": settle_ms}
    try:
        with closing(server):
            stage = open_stage(AxisSpec.model_validate(table), DeviceContext(clock))
            camera = sim_camera.open_camera(CameraSpec(driver="sim", address=server.address), DeviceContext(clock))
            with closing(stage), closing(camera):
                yield Setup(stage, camera, axis, twin, server)
    finally:
        line.unplug()


def plan(planes: int, **changes: object) -> StackPlan:
    made = {"start_nm": -20_000, "step_nm": 300, "count": planes, "exposure_ms": EXPOSURE_MS, "return_nm": 0}
    return StackPlan(**{**made, **changes})


@pytest.mark.parametrize(("driver", "planes"), [("asi-ms2000", 12), ("asi-ms2000", 100), ("asi-tiger", 100)])
def test_no_plane_is_lost_and_each_is_where_it_should_be(driver: str, planes: int):
    with bench(driver=driver) as setup:
        assert isinstance(setup.stage, SequencedStage)
        assert isinstance(setup.camera, TriggeredCamera)
        assert setup.run(plan(planes)) is RunState.COMPLETED
        assert setup.warnings == ""
        headers = [setup.out.headers[k] for k in range(planes)]
        assert all(b.hw_id - a.hw_id == 1 for a, b in pairwise(headers)), "each frame was triggered by the hardware"
        assert setup.strayed_um(plan(planes)) < 0.01
        assert all(abs(h.z_um - h.setpoint_um) <= 0.1 for h in headers)
        assert {h.attempt for h in headers} == {0}


def test_the_frames_wait_until_the_stage_has_settled():
    with bench(settle_ms=5) as setup:
        assert setup.run(plan(8)) is RunState.COMPLETED
        before = [setup.axis.load_um(h.exposure_start_ns / 1e9 - 0.004) for h in setup.out.headers.values()]
        assert before == pytest.approx([to_um(plan(8), k) for k in range(8)], abs=0.01)


@pytest.mark.parametrize("planes", [12, 60])
def test_a_stack_downwards(planes: int):
    down = plan(planes, step_nm=-500)
    with bench() as setup:
        assert setup.run(down) is RunState.COMPLETED
        assert setup.warnings == ""
        assert setup.strayed_um(down) < 0.01


NAMED = ("stage-sequence", "stage-stalled", "device-silent", "device-garbled", "device-refused")
FAULTS: dict[str, Callable[[], object]] = {
    "a frame lost on its way": lambda: bench("camera.drop@5"),
    "the first frame lost": lambda: bench("camera.drop@1"),
    "the last frame lost": lambda: bench("camera.drop@12"),
    "a pulse to the stage lost": lambda: bench("z.pulse-lost@4"),
    "the first pulse lost": lambda: bench("z.pulse-lost@1"),
    "a pulse brought twice": lambda: bench("z.pulse-doubled@6"),
    "a pulse to the camera lost": lambda: bench("camera.pulse-lost@5"),
    "the first pulse to the camera lost": lambda: bench("camera.pulse-lost@1"),
    "a frame with holes": lambda: bench("camera.half@4"),
    "replies garbled": lambda: bench("z.garble@5%"),
    "replies lost": lambda: bench("z.drop@4%"),
}


@pytest.mark.parametrize("planes", [12, 51], ids=["ring", "linear"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_never_shifts_a_plane(fault: str, planes: int):
    """A stack with a fault is completed plane by plane, or fails by name; what was recorded is where it says."""
    stack = plan(planes)
    with FAULTS[fault]() as setup:
        state = setup.run(stack)
        assert state in (RunState.COMPLETED, RunState.FAILED)
        if state is RunState.COMPLETED:
            assert sorted(setup.out.headers) == list(range(planes))
            assert setup.strayed_um(stack) < 0.3
        else:
            assert setup.engine.error.code in NAMED


def test_what_was_lost_is_named_and_taken_one_by_one():
    with bench("camera.drop@5") as setup:
        assert setup.run(plan(12)) is RunState.COMPLETED
        assert setup.warnings == "triggered stack: frames were lost; taken one by one: [4]"
    with bench("z.pulse-lost@4") as setup:
        assert setup.run(plan(12)) is RunState.COMPLETED
        assert "no frame came after number 4: a pulse or frames were lost" in setup.warnings
        assert "[4, 5, 6, 7, 8, 9, 10, 11]" in setup.warnings


def test_cancelled_it_stops_at_the_next_frame_and_pulses_move_nothing_afterwards():
    with bench() as setup:
        setup.on_plane = lambda plane: setup.engine.cancel()
        assert setup.run(plan(40)) is RunState.CANCELLED
        assert 1 <= len(setup.out.headers) < 40
        rest_um = setup.stage.position_um()
        setup.twin.ttl_in()
        assert setup.stage.settle(5.0) == rest_um


@pytest.mark.parametrize("planes", [12, 51], ids=["ring", "linear"])
def test_stopped_it_ends_where_it_is(planes: int):
    with bench() as setup:
        setup.on_plane = lambda plane: setup.engine.stop()
        assert setup.run(plan(planes)) is RunState.CANCELLED
        assert 1 <= len(setup.out.headers) < planes
        assert setup.stage.position_um() < -10


def test_a_blocked_axis_is_a_stall_by_name():
    with bench() as setup:
        stack = plan(12, start_nm=0)
        setup.axis.obstruct(2.0)
        assert setup.run(stack) is RunState.FAILED
        assert setup.engine.error.code == "stage-stalled"
        assert max(setup.out.headers) == 6
        assert setup.strayed_um(stack) < 0.01


def test_an_armed_controller_left_by_a_dead_program_is_disarmed_on_opening():
    with bench() as setup:
        for command in (b"RM X=0\r", b"LD Z=500\r", b"RM Y=4 Z=0\r", b"TTL X=1\r"):
            setup.twin.feed(command)
        setup.stage.disarm()
        setup.twin.ttl_in()
        assert setup.stage.settle(5.0) == 0.0


def test_the_stage_does_not_go_home_before_the_program_gives_up():
    """The linear stack's timeout is longer than the engine waits for any frame."""
    with bench() as setup:
        sequence = setup.stage.load_sequence([k * 0.5 for k in range(60)], PATIENCE * 3)
        assert sequence.lead_frames == 1
        assert sequence.frames == 61
        assert setup.twin.feed(b"ZS F?\r") == [b":A F=6000\r\n"]


def test_what_cannot_be_done_is_refused_before_anything_moves():
    with bench() as setup:
        with pytest.raises(LimitError):
            setup.stage.load_sequence([199.0, 201.0], 1.0)
        with pytest.raises(LimitError):  # the linear stack goes one step further than its last plane
            setup.stage.load_sequence([140.0 + k for k in range(61)], 1.0)
        with pytest.raises(PlanError, match="unequal steps do not fit"):
            setup.stage.load_sequence([float(k * k) / 100 for k in range(60)], 1.0)
        with pytest.raises(PlanError, match="cannot wait 40 s"):
            setup.stage.load_sequence([float(k) for k in range(60)], 40.0)
        assert setup.axis.encoder_um() == 0.0
        against = plan(5, step_nm=-500, overshoot_nm=1000)
        assert setup.run(against) is RunState.FAILED
        assert "against the side" in str(setup.engine.error)


def test_devices_that_cannot_are_named_before_anything_is_armed():
    with bench() as setup:
        plain = SimStage(setup.axis)
        for stage, camera in (
            (plain, setup.camera),
            (setup.stage, SimCamera(Replay(np.zeros((1, *SHAPE)), CAPS), setup.axis)),
        ):
            with pytest.raises(PlanError) as caught:
                check_triggered(plan(5), stage, camera)
            assert caught.value.code == "no-trigger"


def test_a_bench_without_cables_says_so():
    with bench() as setup:
        setup.server._lines = None
        assert setup.run(plan(5)) is RunState.FAILED
        assert "no trigger lines" in str(setup.engine.error)
        setup.twin.ttl_in()
        assert setup.stage.settle(5.0) == 0.0


def test_the_twin_has_the_lines():
    clock = SystemClock()
    assert isinstance(Ms2000({"Z": Axis(clock, Limits(**LIMITS))}), TriggerLines)
