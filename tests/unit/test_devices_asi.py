"""The ASI driver beyond moving: what it reads of the controller, what it names, and the Tiger's own ways."""

from __future__ import annotations

import logging
from contextlib import closing, suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.drivers import asi as opener
from devices.drivers import asi_tiger
from devices.drivers.asi_triggered import AsiTriggeredStage
from devices.errors import DeviceError, LimitError, MalformedReply, Refused, SequenceBroken, StageStalled
from devices.link import Link
from devices.protocols import HandControls, SequencedStage
from devices.registry import DeviceContext, drivers
from devices.rig import AxisSpec
from devices.transport.loopback import Loopback
from devices.values import Limits
from devices.wire import asi, asi_triggered
from devices.wire.asi_identity import MS2000, Card, ring_slots, tiger_card
from sim.clock import SimClock
from sim.controllers.asi import Ms2000
from sim.controllers.asi_tiger import Tiger
from sim.faults import Faults, FaultyTwin
from sim.motion import Axis
from sim.serial_line import SerialLine

LIMITS = {"min_um": -500.0, "max_um": 500.0}


class Controller:
    """A twin on simulated time; ``answers`` replace what it says to single commands."""

    def __init__(self, make=Ms2000) -> None:
        self.clock = SimClock(100.0)
        self.axes = {letter: Axis(self.clock, Limits(**LIMITS)) for letter in "XYZ"}
        self.twin = make(self.axes)
        self.answers: dict[bytes, bytes] = {}
        self.heard: list[bytes] = []

    def feed(self, data: bytes) -> list[bytes]:
        self.heard.append(data)
        return [self.answers[data]] if data in self.answers else self.twin.feed(data)

    def ask(self, words: str) -> str:
        return b"".join(self.twin.feed(words.encode() + b"\r")).decode()

    def stage(self, card: Card = MS2000, slots: int = 50, **changes: object) -> AsiTriggeredStage:
        link = Link(Loopback(self.feed, self.clock), self.clock, terminator=asi.TERMINATOR)
        return AsiTriggeredStage(link, table("loopback", **changes), self.clock, card, slots=slots)


def table(port: str, **changes: object) -> AxisSpec:
    made = {"driver": "asi-ms2000", "port": port, "baud": 115200, "limits": LIMITS}
    return AxisSpec.model_validate({**made, **changes})


@pytest.fixture
def controller() -> Controller:
    return Controller()


@pytest.fixture
def on_a_line():
    """Serve a twin on a pseudo-terminal and return the name of its port."""
    lines = []

    def serve(make) -> str:
        clock = SystemClock()
        twin = make({letter: Axis(clock, Limits(**LIMITS)) for letter in "XYZ"})
        lines.append(SerialLine(FaultyTwin(twin.feed, Faults((), clock), "z").feed, 115200, clock))
        return lines[-1].port

    yield serve
    for line in lines:
        line.unplug()


def test_both_drivers_are_installed():
    assert {"asi-ms2000", "asi-tiger"} <= set(drivers("stage"))


@pytest.mark.parametrize(("driver", "make"), [(opener, Ms2000), (asi_tiger, Tiger)])
def test_it_opens_over_a_line_with_its_limits_speed_and_ring(on_a_line, driver, make):
    with closing(driver.open_stage(table(on_a_line(make), speed_um_s=500.0), DeviceContext(SystemClock()))) as stage:
        assert isinstance(stage, SequencedStage)
        assert isinstance(stage, HandControls)
        assert (stage.limits.min_um, stage.limits.max_um) == (-500, 500)
        stage.move_to(12.3)
        assert stage.settle(5.0) == pytest.approx(12.3, abs=0.05)
        assert stage.identity()
        assert stage.load_sequence([1.0, 2.0], 10.0).positions_um == (1.0, 2.0, 2.0)


def test_an_ms2000_is_no_tiger(on_a_line):
    with pytest.raises(DeviceError) as caught:
        asi_tiger.open_stage(table(on_a_line(Ms2000)), DeviceContext(SystemClock()))
    assert caught.value.code == "device-unknown"


def test_the_controllers_own_limits_hold_where_they_are_narrower(controller, caplog):
    controller.ask("SU Z=0.1")
    stage = controller.stage()
    assert stage.limits.max_um == 500
    with caplog.at_level(logging.WARNING):
        assert stage.heed_controller_limits().max_um == pytest.approx(100, abs=1)
    assert "narrower" in caplog.text
    controller.heard.clear()
    with pytest.raises(LimitError):
        stage.move_to(150.0)
    assert controller.heard == []


def test_limits_of_an_axis_that_counts_downwards_are_turned_round(controller):
    controller.ask("SU Z=0.1")
    stage = controller.stage(invert=True)
    assert stage.heed_controller_limits() == Limits(pytest.approx(-100, abs=1), 500.0)
    stage.move_to(-90.0)
    assert stage.settle(5.0) == pytest.approx(-90)
    assert controller.ask("W Z") == ":A 900 \r\n"


def test_after_naming_a_new_zero_the_limits_are_read_anew(controller):
    stage = controller.stage()
    stage.move_to(100.0)
    stage.settle(5.0)
    stage.zero_here()
    assert stage.limits.max_um == pytest.approx(400, abs=1.5)


def test_firmware_that_tells_no_limits_is_left_to_its_own(controller):
    controller.answers[b"SL Z?\r"] = b":N-1\r\n"
    assert controller.stage().heed_controller_limits() == Limits(-500, 500)


def test_a_speed_that_was_clipped_is_said(controller, caplog):
    with caplog.at_level(logging.WARNING):
        assert controller.stage().set_speed_um_s(9000.0) == 2000.0
    assert "asked for 9000 µm/s, the controller takes 2000 µm/s" in caplog.text


def test_backlash_of_the_controller_is_read(controller):
    assert controller.stage().controller_backlash_um() == pytest.approx(40)


def test_the_joystick_is_dead_until_it_is_given_back(controller):
    stage = controller.stage()
    stage.hand_controls(enabled=False)
    assert controller.ask("RS Z") == ":A 2\r\n"
    stage.hand_controls(enabled=True)
    assert controller.ask("RS Z") == ":A 10\r\n"


def test_firmware_that_cannot_switch_the_joystick_is_no_failure(controller):
    controller.answers[b"J Z-\r"] = b":N-4\r\n"
    controller.stage().hand_controls(enabled=False)
    assert controller.heard == [b"J Z-\r"]


@pytest.mark.parametrize(("target_um", "words"), [(400.0, "upper"), (-400.0, "lower")])
def test_a_move_into_the_controllers_limit_names_it(controller, target_um, words):
    controller.ask("SU Z=0.05")
    controller.ask("SL Z=-0.05")
    stage = controller.stage()
    stage.move_to(target_um)
    with pytest.raises(StageStalled) as caught:
        stage.settle(20.0)
    assert caught.value.why == f"It is at the controller's {words} limit."


def test_a_ring_that_did_not_take_all_positions_is_noticed(controller):
    controller.answers[b"RM X?\r"] = b":A X=2\r\n"
    with pytest.raises(SequenceBroken, match="2 of 4 positions"):
        controller.stage().load_sequence([1.0, 2.0, 3.0], 10.0)


def test_old_firmware_that_cannot_count_the_ring_is_used_all_the_same(controller):
    controller.answers[b"RM X?\r"] = b":N-1\r\n"
    assert controller.stage().load_sequence([1.0, 2.0], 10.0).frames == 2


def test_a_sequence_leaves_the_controller_as_it_was(controller):
    controller.ask("WT Z=7")
    stage = controller.stage(settle_ms=3.0)
    stage.load_sequence([1.0, 2.0], 10.0)
    assert (controller.ask("WT Z?"), controller.ask("TTL X? Y?")) == (":Z=3 A\r\n", ":A X=1 Y=2\r\n")
    assert stage.end_sequence(5.0) == pytest.approx(1.0)
    assert (controller.ask("WT Z?"), controller.ask("TTL X? Y?")) == (":Z=7 A\r\n", ":A X=0 Y=0\r\n")


def test_backlash_is_taken_up_before_the_first_plane(controller):
    stage = controller.stage(backlash_um=1.0)
    assert stage.load_sequence([10.0, 11.0], 10.0).lead_frames == 0
    assert [bytes(h) for h in controller.heard if h.startswith(b"M ")] == [b"M Z=80.000\r", b"M Z=100.000\r"]
    linear = controller.stage(backlash_um=1.0, slots=0).load_sequence([10.0, 10.5, 11.0], 10.0)
    assert linear.positions_um == (9.75, 8.0, 8.5, 9.0, 9.5, 10.0, 10.5, 11.0, 11.5)
    assert linear.positions_um[linear.lead_frames] == 10.0


def test_without_pulses_the_linear_stack_goes_home_by_itself_unless_it_is_ended(controller):
    stage = controller.stage(slots=0)
    stage.load_sequence([10.0, 11.0, 12.0], 2.0)
    controller.twin.ttl_in()
    controller.clock.sleep(1.0)
    assert stage.position_um() == pytest.approx(10.0)
    controller.clock.sleep(1.5)
    stage.position_um()
    controller.clock.sleep(1.0)
    assert stage.position_um() == pytest.approx(11.5)
    controller.twin.ttl_in()
    controller.clock.sleep(0.5)
    rest_um = stage.end_sequence(5.0)
    controller.clock.sleep(10.0)
    assert stage.position_um() == rest_um == pytest.approx(10.0)


# -- the Tiger -------------------------------------------------------------------------------------------------------


def test_a_tiger_answers_both_ways_of_addressing_a_card():
    tiger = Controller(Tiger)
    for prefix in ("2", "32", "2 "):
        assert tiger.ask(f"{prefix}TTL X=1") == ":A\r\n"
        assert "RING BUFFER 250" in tiger.ask(f"{prefix}BU X")
    assert tiger.ask("BU X") == tiger.ask("0 BU X")
    assert tiger.ask("BU X").startswith(
        "TIGER_COMM\rMotor Axes: X Y Z\rAxis Types: x x z\rAxis Addr: 1 1 2\rHex Addr: 31 31 32"
    )
    assert tiger.ask("7BU X") == ":N-7\r\n"
    assert tiger.ask("TTL X=1") == ":N-1\r\n"


def test_a_tiger_tells_positions_with_as_many_decimals_as_asked_for():
    tiger = Controller(Tiger)
    assert tiger.ask("W Z") == ":A 0.0 \r\n"
    assert tiger.ask("2VB Z=3") == ":A\r\n"
    assert tiger.ask("W X Z") == ":A 0.000 0.000 \r\n"
    assert tiger.ask("V") == ":A v3.50\r\n"


def test_a_tiger_is_halted_by_the_word_and_tells_motion_by_letters():
    tiger = Controller(Tiger)
    assert tiger.ask("M Z=4000") == ":A\r\n"
    tiger.clock.sleep(0.05)
    assert tiger.ask("RS X? Y? Z?") == ":A NNB\r\n"
    assert tiger.ask("2\\") == ":N-1\r\n"
    assert tiger.ask("HALT") == ":N-21\r\n"
    stage = tiger.stage(Card("2", 1, "HALT"))
    stage.halt()
    assert tiger.heard == [b"HALT\r"]


def test_the_card_of_z_is_found_with_its_bit():
    told = ("TIGER_COMM", "Motor Axes: X Y P Z", "Axis Addr: 1 1 2 2", "Hex Addr: 31 31 32 32")
    assert tiger_card(told) == Card("2", 2, "HALT")
    assert tiger_card(("STD_XYZ", "Motor Axes: X Y Z")) is None
    assert tiger_card(("TIGER_COMM", "Motor Axes: X Y", "Axis Addr: 1 1")) is None
    assert ring_slots(("STD_Z", "RING BUFFER 250")) == 250
    assert ring_slots(("STD_Z",)) == 0


# -- the codec -------------------------------------------------------------------------------------------------------

REQUESTS = [
    asi.where(),
    asi.is_moving(),
    asi.status_byte(),
    asi.halt(),
    asi.speed(),
    asi.backlash(),
    asi.wait(),
    asi.version(),
    asi.build("2"),
    asi.joystick(enabled=False),
    asi_triggered.clear_ring(),
    asi_triggered.ring_count("2"),
    asi_triggered.linear_stack(5, 10, 1000),
]


@given(st.binary(max_size=40), st.sampled_from(REQUESTS))
def test_any_bytes_decode_or_raise_one_of_ours(reply, request_):
    with suppress(MalformedReply, Refused):
        request_.decode(reply)


def test_what_moves_twice_when_sent_twice_is_never_repeated():
    moving = [asi.move_by(1), asi_triggered.load_ring(1), asi_triggered.step_ring(), asi.here(0)]
    assert not any(request.repeatable for request in moving)
