"""PI and Prior stages on wires that fail: every fault ends in a named error or is recovered from, never in a lie."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from devices.drivers.pi_gcs import PiStage
from devices.drivers.prior import PriorStage
from devices.errors import DeviceError, LinkLost, NoReply, Refused, StageStalled
from devices.link import Link
from devices.rig import AxisSpec
from devices.values import Limits
from devices.wire import pi_gcs, prior
from sim.clock import SimClock
from sim.controllers import prior as prior_twin
from sim.controllers.pi_gcs import PiE709
from sim.controllers.prior import ProScan
from sim.motion import Axis

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.drivers.polled import PolledStage

LIMITS = {"min_um": -500.0, "max_um": 500.0}
TARGET_UM = 123.0
WITHIN_UM = 0.1


class Wire:
    """A transport to a twin: ``spoil`` turns each reply into what arrives and how much later; it can be unplugged."""

    name = "wire"

    def __init__(self, twin: PiE709 | ProScan, clock: SimClock) -> None:
        self.twin, self.clock = twin, clock
        self.plugged = True
        self.spoil: Callable[[bytes], tuple[float, bytes]] = lambda reply: (0.0, reply)
        self.arriving: list[tuple[float, bytes]] = []
        self.sent: list[bytes] = []

    def write(self, data: bytes) -> None:
        self._check()
        self.sent.append(data)
        for reply in self.twin.feed(data):
            delay_s, arrives = self.spoil(reply)
            self.arriving.append((self.clock.now() + delay_s, arrives))

    def read(self, wait_s: float) -> bytes:
        self._check()
        due = [entry for entry in self.arriving if entry[0] <= self.clock.now()]
        self.arriving = [entry for entry in self.arriving if entry not in due]
        if not any(data for _, data in due):
            self.clock.sleep(max(wait_s, 1e-4))
        return b"".join(data for _, data in due)

    def close(self) -> None:
        self.arriving.clear()

    def reopen(self) -> Wire:
        self._check()
        return self

    def _check(self) -> None:
        if not self.plugged:
            raise LinkLost("z stage: the connection over wire broke.")


@dataclass
class Bench:
    stage: PolledStage
    axis: Axis
    twin: PiE709 | ProScan
    wire: Wire
    clock: SimClock

    def arrived(self) -> str:
        """Move and settle; return the code of the error, or make sure that what is told is true."""
        try:
            self.stage.move_to(TARGET_UM)
            told_um = self.stage.settle(60.0)
        except DeviceError as error:
            return error.code
        assert told_um == pytest.approx(TARGET_UM, abs=WITHIN_UM)
        assert self.axis.encoder_um() == pytest.approx(told_um, abs=WITHIN_UM)
        return "arrived"

    def underway(self) -> None:
        """Be in the middle of a slow move."""
        self.axis.set_speed(50.0)
        self.stage.move_to(TARGET_UM)
        self.clock.sleep(1.0)
        assert self.axis.moving()

    def rest(self) -> float:
        self.clock.sleep(60.0)
        return self.axis.encoder_um()


def piezo() -> Bench:
    return of_pi(PiE709, 1.0)


def motor() -> Bench:
    return of_pi(PiE709.c863, 0.001)


def of_pi(make: Callable[[Axis], PiE709], units_per_um: float) -> Bench:
    clock = SimClock()
    axis = Axis(clock, Limits(**LIMITS))
    twin = make(axis)
    twin.feed(b"SVO 1 1\nFRF 1\nERR?\n")
    return bench(PiStage, axis, twin, clock, pi_gcs.TERMINATOR, units_per_um)


def proscan() -> Bench:
    clock = SimClock()
    axis = Axis(clock, Limits(**LIMITS))
    return bench(PriorStage, axis, ProScan(axis), clock, prior.TERMINATOR, 10.0)


def proscan_r_at_the_end() -> Bench:
    clock = SimClock()
    axis = Axis(clock, Limits(**LIMITS))
    return bench(PriorStage, axis, ProScan(axis, says_r="finished"), clock, prior.TERMINATOR, 10.0)


def bench(driver, axis, twin, clock, terminator, units_per_um) -> Bench:
    wire = Wire(twin, clock)
    table = {"driver": "asi-ms2000", "port": "wire", "baud": 115200, "limits": LIMITS, "units_per_um": units_per_um}
    link = Link(wire, clock, terminator=terminator, reopen=wire.reopen)
    stage = driver(link, AxisSpec.model_validate(table), clock)
    stage.greet()
    return Bench(stage, axis, twin, wire, clock)


MAKERS = [piezo, motor, proscan, proscan_r_at_the_end]
every_stage = pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)

SPOILED = {
    "dropped": lambda reply: (0.0, b""),
    "late": lambda reply: (0.7, reply),
    "slow": lambda reply: (0.3, reply),
    "cut": lambda reply: (0.0, reply[: len(reply) // 2]),
    "garbled": lambda reply: (0.0, bytes(byte ^ 0xA5 for byte in reply[:-1]) + reply[-1:]),
    "doubled": lambda reply: (0.0, reply + reply),
}


@every_stage
@pytest.mark.parametrize("number", [1, 2, 3, 6])
@pytest.mark.parametrize("fault", SPOILED)
def test_one_spoiled_reply_is_recovered_from(make, fault: str, number: int):
    stand, count = make(), 0

    def spoil(reply: bytes) -> tuple[float, bytes]:
        nonlocal count
        count += 1
        return SPOILED[fault](reply) if count == number else (0.0, reply)

    stand.wire.spoil = spoil
    assert stand.arrived() == "arrived"
    assert stand.stage.position_known


@every_stage
@pytest.mark.parametrize("fault", ["dropped", "cut", "garbled"])
def test_a_line_that_stays_bad_is_named(make, fault: str):
    stand = make()
    stand.wire.spoil = SPOILED[fault]
    assert stand.arrived() in ("device-silent", "device-garbled")


@every_stage
def test_a_controller_that_falls_silent_moves_again_only_after_a_reconnection(make):
    stand = make()
    stand.underway()
    stand.wire.spoil = SPOILED["dropped"]
    with pytest.raises(NoReply):
        stand.stage.settle(60.0)
    stand.wire.spoil = lambda reply: (0.0, reply)
    assert not stand.stage.position_known
    assert stand.arrived() == "position-unknown"
    assert stand.stage.reconnect() == pytest.approx(stand.axis.encoder_um(), abs=WITHIN_UM)
    assert stand.arrived() == "arrived"


@every_stage
def test_after_the_plug_was_pulled_nothing_moves_before_it_reconnected(make):
    stand = make()
    stand.underway()
    stand.wire.plugged = False
    with pytest.raises(LinkLost):
        stand.stage.settle(60.0)
    with pytest.raises(LinkLost):
        stand.stage.halt()
    rest_um = stand.rest()
    stand.wire.plugged = True
    assert stand.arrived() in ("position-unknown", "device-lost")
    assert stand.rest() == rest_um
    assert stand.stage.reconnect() == pytest.approx(rest_um, abs=WITHIN_UM)
    assert stand.arrived() == "arrived"


@every_stage
@pytest.mark.parametrize("at_um", [TARGET_UM, TARGET_UM + 1.0, float("nan")])
def test_it_comes_back_only_where_it_was(make, at_um: float):
    stand = make()
    assert stand.arrived() == "arrived"
    stand.wire.plugged = False
    with pytest.raises(LinkLost):
        stand.stage.position_um()
    stand.wire.plugged = True
    if at_um == TARGET_UM:
        assert stand.stage.reconnect(0.0, at_um=at_um) == pytest.approx(TARGET_UM, abs=WITHIN_UM)
        assert stand.arrived() == "arrived"
        return
    with pytest.raises(DeviceError, match="was read last, and it says") as caught:
        stand.stage.reconnect(0.0, at_um=at_um)
    assert caught.value.code == stand.arrived() == "position-unknown"
    assert stand.rest() == pytest.approx(TARGET_UM, abs=WITHIN_UM)


@pytest.mark.parametrize("make", [proscan, proscan_r_at_the_end])
@pytest.mark.parametrize("before_um", [0.0, TARGET_UM])
def test_a_controller_that_says_0_may_have_been_off_and_stays_where_it_is(make, before_um: float):
    stand = make()
    stand.stage.move_to(before_um)
    stand.stage.settle(60.0)
    stand.wire.plugged = False
    with pytest.raises(LinkLost):
        stand.stage.position_um()
    stand.twin.power_cycle()
    stand.wire.plugged = True
    with pytest.raises(DeviceError) as caught:
        stand.stage.reconnect(0.0, at_um=before_um)
    assert "It says 0 as after its power was off" in caught.value.message()
    assert stand.arrived() == "position-unknown"


@every_stage
def test_a_plug_that_stays_out_is_not_waited_for_without_end(make):
    stand = make()
    stand.wire.plugged = False
    before_s = stand.clock.now()
    with pytest.raises(LinkLost):
        stand.stage.reconnect(timeout_s=3.0)
    assert stand.clock.now() - before_s < 4.0
    stand.wire.plugged = True
    assert stand.arrived() == "position-unknown"


@every_stage
def test_another_controller_at_the_same_port_is_not_driven(make, monkeypatch: pytest.MonkeyPatch):
    stand = make()
    monkeypatch.setattr(prior_twin, "DATE", ("PRIOR SCIENTIFIC INSTRUMENTS LTD. OPTISCAN", "VERSION 2"))
    if isinstance(stand.twin, PiE709):
        stand.wire.twin = PiE709(stand.axis, model="E-727.3CD")
    with pytest.raises(DeviceError) as caught:
        stand.stage.reconnect(timeout_s=1.0)
    assert caught.value.code == "device-other"
    assert stand.arrived() == "position-unknown"
    assert stand.rest() == pytest.approx(0)


@every_stage
def test_an_obstacle_is_a_stall_where_it_is(make):
    stand = make()
    stand.axis.obstruct(40.0)
    assert stand.arrived() == "stage-stalled"
    assert stand.stage.position_um() == pytest.approx(40.0, abs=WITHIN_UM)


@every_stage
def test_a_limit_of_the_controller_inside_ours_is_named(make):
    stand = make()
    stand.axis.limits = Limits(-500.0, 60.0)
    assert stand.arrived() in ("device-refused", "stage-stalled")
    assert stand.stage.position_um() == pytest.approx(stand.rest(), abs=WITHIN_UM)


@every_stage
def test_power_that_goes_between_two_moves_is_noticed_before_anything_moves(make):
    stand = make()
    assert stand.arrived() == "arrived"
    stand.twin.power_cycle()
    with pytest.raises(DeviceError) as caught:
        stand.stage.move_to(-50.0)
    assert caught.value.code in ("position-unknown", "device-refused")
    assert stand.rest() == pytest.approx(TARGET_UM, abs=WITHIN_UM)


@every_stage
def test_power_that_goes_during_a_move_never_ends_in_an_arrival(make):
    stand = make()
    stand.underway()
    stand.twin.power_cycle()
    with pytest.raises(StageStalled):
        stand.stage.settle(60.0)


@every_stage
def test_a_halt_leaves_it_where_it_says(make):
    stand = make()
    stand.underway()
    stand.stage.halt()
    with pytest.raises(StageStalled, match="halted"):
        stand.stage.settle(60.0)
    assert 0 < stand.rest() < TARGET_UM
    assert stand.stage.position_um() == pytest.approx(stand.axis.encoder_um(), abs=WITHIN_UM)
    assert stand.arrived() == "arrived"


@every_stage
def test_a_halt_whose_first_reply_is_lost_is_sent_again(make):
    stand = make()
    stand.underway()
    replies = iter([(0.0, b"")])
    stand.wire.spoil = lambda reply: next(replies, (0.0, reply))
    stand.stage.halt()
    assert stand.rest() < TARGET_UM


@every_stage
@pytest.mark.parametrize("z_um", [500.1, math.nan, math.inf])
def test_what_is_outside_the_limits_is_not_sent(make, z_um: float):
    stand = make()
    stand.wire.sent.clear()
    with pytest.raises(DeviceError) as caught:
        stand.stage.move_to(z_um)
    assert caught.value.code == "limit"
    assert stand.wire.sent == []


@pytest.mark.parametrize("make", [piezo, motor])
def test_an_alarm_in_the_middle_of_a_move_is_named(make):
    stand = make()
    stand.underway()
    stand.twin.motion_error()
    with pytest.raises(StageStalled) as caught:
        stand.stage.settle(60.0)
    assert "(1024)" in caught.value.message()
    with pytest.raises(Refused, match="servo is off"):
        stand.stage.move_to(TARGET_UM)


@pytest.mark.parametrize("make", [piezo, motor])
@pytest.mark.parametrize("left", [b"NIX?\n", b"\xff\n"])
def test_an_error_left_over_from_a_damaged_line_is_not_taken_for_a_refusal(make, left: bytes):
    stand = make()
    stand.twin.feed(left)
    assert stand.arrived() == "arrived"


def test_a_motor_without_reference_is_not_driven():
    stand = motor()
    stand.twin.power_cycle()
    with pytest.raises(DeviceError, match="not referenced"):
        stand.stage.reconnect(timeout_s=1.0)
    assert stand.arrived() == "position-unknown"


def test_firmware_without_absolute_moves_is_moved_by_the_way_it_has_to_go_once():
    stand = proscan()
    del stand.twin._handlers["V"]
    assert stand.arrived() == "arrived"
    replies = iter([(0.0, f"{TARGET_UM * 10:.0f}\r".encode()), (0.0, b""), (0.0, b"")])
    stand.wire.spoil = lambda reply: next(replies, (0.0, reply))
    with pytest.raises(NoReply):
        stand.stage.move_to(100.0)
    assert stand.rest() == pytest.approx(100.0, abs=WITHIN_UM)
