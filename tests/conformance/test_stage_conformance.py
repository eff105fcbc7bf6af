"""What every stage must do, asked of every implementation there is."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import pytest
from small_twin import OnPty, OnTcp, SmallAxis, SteppingClock

from devices.clock import SystemClock
from devices.drivers.asi import AsiStage, open_stage
from devices.drivers.pi_gcs import PiStage
from devices.drivers.pi_gcs import open_stage as open_pi
from devices.drivers.prior import PriorStage
from devices.drivers.prior import open_stage as open_prior
from devices.errors import LimitError, StageStalled, StageTimeout
from devices.link import Link
from devices.protocols import Clock, Stage
from devices.registry import DeviceContext
from devices.rig import AxisSpec
from devices.transport.loopback import Loopback
from devices.transport.transcript import Replay
from devices.values import Limits
from devices.wire import asi, pi_gcs, prior
from sim.clock import SimClock
from sim.controllers.asi import Ms2000
from sim.controllers.pi_gcs import PiE709
from sim.controllers.prior import ProScan
from sim.motion import Axis
from sim.stage import SimStage

TRANSCRIPT = Path(__file__).parent.parent / "transcripts" / "asi_three_planes.jsonl"
LIMITS = {"min_um": -500.0, "max_um": 500.0}


def axis(port: str, **changes: object) -> AxisSpec:
    return AxisSpec.model_validate({"driver": "asi-ms2000", "port": port, "baud": 115200, "limits": LIMITS, **changes})


def by_itself():
    clock = SimClock()
    yield SimStage(Axis(clock, Limits(**LIMITS))), clock


def over_loopback_to_the_small_twin():
    clock = SteppingClock()
    yield driver(SmallAxis(clock.now), clock), clock


def over_loopback_to_the_bench_s_twin():
    clock = SimClock()
    yield driver(Ms2000({"Z": Axis(clock, Limits(**LIMITS))}), clock), clock


def over_a_pty_to_the_bench_s_twin():
    clock = SystemClock()
    with closing(OnPty(Ms2000({"Z": Axis(clock, Limits(**LIMITS))}).feed)) as far:
        yield open_stage(axis(far.port), DeviceContext(clock)), clock


def over_loopback_to_a_piezo_of_pi():
    clock = SimClock()
    yield pi_driver(PiE709(Axis(clock, Limits(**LIMITS))), clock, 1.0), clock


def over_loopback_to_a_motor_of_pi_that_counts_mm():
    clock = SimClock()
    twin = PiE709.c863(Axis(clock, Limits(**LIMITS)))
    twin.feed(b"SVO 1 1\nFRF 1\n")
    yield pi_driver(twin, clock, 0.001), clock


def over_a_pty_to_a_piezo_of_pi():
    clock = SystemClock()
    with closing(OnPty(PiE709(Axis(clock, Limits(**LIMITS))).feed)) as far:
        yield open_pi(axis(far.port, driver="pi-gcs2", units_per_um=1.0), DeviceContext(clock)), clock


def over_loopback_to_a_proscan_that_says_r_at_once():
    clock = SimClock()
    yield prior_driver(ProScan(Axis(clock, Limits(**LIMITS))), clock), clock


def over_loopback_to_a_proscan_that_says_r_at_the_end():
    clock = SimClock()
    yield prior_driver(ProScan(Axis(clock, Limits(**LIMITS)), says_r="finished"), clock), clock


def over_loopback_to_a_proscan_that_counts_downwards():
    clock = SimClock()
    yield prior_driver(ProScan(Axis(clock, Limits(**LIMITS)), step_um=-0.1), clock), clock


def over_a_pty_to_a_proscan():
    clock = SystemClock()
    with closing(OnPty(ProScan(Axis(clock, Limits(**LIMITS))).feed)) as far:
        yield open_prior(axis(far.port, driver="prior-proscan"), DeviceContext(clock)), clock


def pi_driver(twin: PiE709, clock: Clock, units_per_um: float) -> PiStage:
    link = Link(Loopback(twin.feed, clock), clock, terminator=pi_gcs.TERMINATOR)
    stage = PiStage(link, axis("loopback", driver="pi-gcs2", units_per_um=units_per_um), clock)
    stage.greet()
    return stage


def prior_driver(twin: ProScan, clock: Clock) -> PriorStage:
    link = Link(Loopback(twin.feed, clock), clock, terminator=prior.TERMINATOR)
    stage = PriorStage(link, axis("loopback", driver="prior-proscan"), clock)
    stage.greet()
    return stage


def driver(twin: SmallAxis | Ms2000, clock: Clock) -> AsiStage:
    return AsiStage(Link(Loopback(twin.feed, clock), clock, terminator=asi.TERMINATOR), axis("loopback"), clock)


MAKERS = [
    by_itself,
    over_loopback_to_the_small_twin,
    over_loopback_to_the_bench_s_twin,
    over_a_pty_to_the_bench_s_twin,
    over_loopback_to_a_piezo_of_pi,
    over_loopback_to_a_motor_of_pi_that_counts_mm,
    over_a_pty_to_a_piezo_of_pi,
    over_loopback_to_a_proscan_that_says_r_at_once,
    over_loopback_to_a_proscan_that_says_r_at_the_end,
    over_loopback_to_a_proscan_that_counts_downwards,
    over_a_pty_to_a_proscan,
]


@pytest.fixture(params=MAKERS, ids=lambda make: make.__name__)
def bench(request: pytest.FixtureRequest):
    opened = request.param()
    stage, clock = next(opened)
    yield stage, clock
    stage.close()
    assert list(opened) == []


@pytest.fixture
def stage(bench: tuple[Stage, Clock]) -> Stage:
    return bench[0]


def test_it_is_a_stage(stage: Stage):
    assert isinstance(stage, Stage)
    assert (stage.limits.min_um, stage.limits.max_um) == (-500, 500)


@pytest.mark.parametrize("z_um", [12.3, -7.5, 500.0, -500.0, 0.0])
def test_it_arrives_where_it_was_sent_and_says_so(stage: Stage, z_um: float):
    stage.move_to(z_um)
    assert stage.settle(5.0) == pytest.approx(z_um, abs=0.1)
    assert stage.position_um() == pytest.approx(z_um, abs=0.1)


@pytest.mark.parametrize("z_um", [500.01, -501.0, math.nan, math.inf, -math.inf])
def test_it_refuses_what_is_outside_its_limits_and_stays(stage: Stage, z_um: float):
    stage.move_to(100.0)
    rest_um = stage.settle(5.0)
    with pytest.raises(LimitError):
        stage.move_to(z_um)
    assert stage.settle(5.0) == rest_um


def test_without_a_move_it_is_settled_at_once(stage: Stage):
    assert stage.settle(5.0) == stage.position_um()


def test_a_halt_stops_it_short_of_the_target_and_it_can_move_again(bench: tuple[Stage, Clock]):
    stage, clock = bench
    stage.move_to(-500.0)
    stage.settle(5.0)
    stage.move_to(500.0)
    stage.halt()
    with pytest.raises(StageStalled):
        stage.settle(5.0)
    before_um = math.inf
    while (stopped_um := stage.position_um()) != before_um:
        before_um = stopped_um
        clock.sleep(0.05)
    assert -500 <= stopped_um < 499
    stage.move_to(-490.0)
    assert stage.settle(5.0) == pytest.approx(-490, abs=0.1)


def test_a_halt_at_rest_is_fine(stage: Stage):
    stage.halt()
    stage.halt()
    assert stage.position_um() == pytest.approx(0, abs=0.1)


def test_it_does_not_wait_beyond_its_deadline(stage: Stage):
    stage.move_to(500.0)
    with pytest.raises(StageTimeout):
        stage.settle(0.01)
    assert stage.settle(5.0) == pytest.approx(500, abs=0.1)


def test_a_network_port_is_a_port():
    with closing(OnTcp(SmallAxis(SystemClock().now).feed)) as far:
        stage = open_stage(axis(f"socket://{far.address}"), DeviceContext(SystemClock()))
        stage.move_to(12.0)
        assert stage.settle(5.0) == pytest.approx(12, abs=0.1)
        stage.close()


def test_a_recorded_conversation_replays():
    clock = SteppingClock()
    stage = AsiStage(Link(Replay(TRANSCRIPT, clock), clock, terminator=asi.TERMINATOR), axis("replay"), clock)
    positions = [stage.position_um()]
    for z_um in (0.0, 2.5, 5.0):
        stage.move_to(z_um)
        positions.append(stage.settle(5.0))
    stage.halt()
    assert positions == [0.0, 0.0, 2.5, 5.0]
