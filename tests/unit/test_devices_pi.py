"""What is particular to PI's controllers: the codec, and what is compared before anything moves."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.drivers import polled
from devices.drivers.pi_gcs import PiStage, open_stage
from devices.errors import DeviceError, MalformedReply, Refused, RigError, StageStalled
from devices.link import Link
from devices.registry import DeviceContext
from devices.rig import AxisSpec
from devices.transport.loopback import Loopback
from devices.values import Limits
from devices.wire import pi_gcs
from sim.clock import SimClock
from sim.controllers.pi_gcs import PiE709
from sim.motion import Axis

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
from small_twin import OnPty

if TYPE_CHECKING:
    from devices.wire.exchange import Request

TRAVEL = Limits(0.0, 400.0)
REQUESTS = [
    pi_gcs.identity(), pi_gcs.axes(), pi_gcs.move("1", 5), pi_gcs.position("1"), pi_gcs.on_target("1"), pi_gcs.halt(),
    pi_gcs.servo("1"), pi_gcs.referenced("1"), pi_gcs.set_servo("1", on=True), pi_gcs.set_speed("1", 5),
    pi_gcs.speed("1"), *pi_gcs.travel("1"), pi_gcs.error(), pi_gcs.reference("1", "switch"),
]  # fmt: skip


def table(port: str = "x", **changes: object) -> AxisSpec:
    limits = {"min_um": 0.0, "max_um": 400.0}
    return AxisSpec.model_validate({"driver": "pi-gcs2", "port": port, "baud": 115200, "limits": limits, **changes})


def on_loopback(twin: PiE709, clock: SimClock, **changes: object) -> PiStage:
    link = Link(Loopback(twin.feed, clock), clock, terminator=pi_gcs.TERMINATOR)
    return PiStage(link, table(**{"units_per_um": 1.0, **changes}), clock)


@given(st.binary(max_size=40))
def test_any_bytes_decode_or_raise_an_error_of_ours(reply: bytes):
    for request in REQUESTS:
        try:
            request.decode((request.framing or (lambda received: received))(reply) or reply)
        except (MalformedReply, Refused):
            continue


@pytest.mark.parametrize(
    ("request_", "payload", "reply", "meaning"),
    [
        (pi_gcs.move("1", 123.456), b"MOV 1 123.456000\nERR?\n", b"0", None),
        (pi_gcs.halt(), b"\x18ERR?\n", b"10", None),
        (pi_gcs.halt(), b"\x18ERR?\n", b"0", None),
        (pi_gcs.position("A"), b"POS? A\n", b"A=-1.25e-03", -0.00125),
        (pi_gcs.on_target("1"), b"ONT? 1\n", b"1=1", True),
        (pi_gcs.axes(), b"SAI?\n", b"1 \n2 \nZ", ("1", "2", "Z")),
        (pi_gcs.set_servo("1", on=True), b"SVO 1 1\nERR?\n", b"0", None),
        (pi_gcs.error(), b"ERR?\n", b"1024", 1024),
    ],
)
def test_the_documented_exchanges(request_: Request, payload: bytes, reply: bytes, meaning: object):
    assert (request_.payload, request_.decode(reply)) == (payload, meaning)


@pytest.mark.parametrize(
    ("code", "words"), [(5, "servo is off"), (7, "out of the travel"), (10, "stopped"), (77, "error")]
)
def test_refusals_have_names(code: int, words: str):
    with pytest.raises(Refused, match=words) as caught:
        pi_gcs.move("1", 5).decode(b"%d" % code)
    assert caught.value.reason == str(code)


@given(st.lists(st.text("abc=1", min_size=1, max_size=5), min_size=1, max_size=4), st.binary(max_size=3))
def test_several_lines_end_where_the_space_is_missing(lines: list[str], after: bytes):
    reply = " \n".join(lines).encode()
    assert pi_gcs.lines(reply + b"\n" + after) == reply
    assert pi_gcs.lines(reply) is None


@pytest.mark.parametrize(
    ("um_per_unit", "changes", "words"),
    [
        (1.0, {"units_per_um": 10.0}, "reach beyond the travel 0 … 40 µm"),
        (1.0, {"limits": {"min_um": -1.0, "max_um": 400.0}}, "reach beyond the travel 0 … 400 µm"),
        (1000.0, {}, "reach beyond the travel 0 … 0.4 µm"),
        (1.0, {"axis": "2"}, "axes are 1; '2' is none"),
    ],
)
def test_a_file_that_does_not_fit_the_controller_is_told_before_anything_moves(um_per_unit, changes: dict, words: str):
    clock = SimClock()
    twin = PiE709(Axis(clock, TRAVEL), um_per_unit=um_per_unit)
    with pytest.raises(RigError, match=words):
        on_loopback(twin, clock, **changes).greet()
    assert twin.feed(b"SVO? 1\n") == [b"1=0\n"]


def test_speed_and_settings_of_an_inverted_axis():
    clock = SimClock()
    axis = Axis(clock, Limits(-400.0, 0.0))
    stage = on_loopback(PiE709(axis), clock, invert=True, speed_um_s=100.0, settle_ms=5.0)
    assert stage.greet() == 0
    assert axis.speed_um_s == 100
    stage.move_to(40.0)
    assert stage.settle(5.0) == pytest.approx(40)
    assert axis.encoder_um() == pytest.approx(-40)
    with pytest.raises(Refused, match="velocity"):
        stage.set_speed_um_s(1e9)


def test_units_have_to_be_said():
    with pytest.raises(RigError, match="units_per_um is missing"):
        open_stage(table(), DeviceContext(SystemClock()))


def motor(clock: SimClock, at_um: float = 150.0, **changes: object) -> tuple[PiE709, Axis, PiStage]:
    """A motor that was switched on somewhere, and its driver."""
    axis = Axis(clock, TRAVEL, position_um=at_um)
    twin = PiE709.c863(axis)
    link = Link(Loopback(twin.feed, clock), clock, terminator=pi_gcs.TERMINATOR)
    spec = table(units_per_um=0.001, **changes)
    return twin, axis, PiStage(link, spec, clock, may_reference=spec.may_move_on_enable)


def test_without_consent_nothing_moves_to_search_a_reference():
    clock = SimClock()
    twin, axis, stage = motor(clock)
    with pytest.raises(DeviceError, match="not referenced") as caught:
        stage.greet()
    assert caught.value.code == "position-unknown"
    assert "stage home --may-move" in caught.value.message()
    assert (axis.encoder_um(), axis.moving()) == (150.0, False)
    assert twin.feed(b"SVO? 1\n") == [b"1=0\n"], "not even the servo goes on"


@pytest.mark.parametrize(("by", "at_um"), [("switch", 0.0), ("negative-limit", 0.0), ("positive-limit", 400.0)])
def test_with_consent_a_motor_is_referenced_once(by: str, at_um: float):
    clock = SimClock()
    twin, axis, stage = motor(clock, may_move_on_enable=True, reference_by=by)
    assert stage.greet() == pytest.approx(at_um, abs=0.01)
    assert axis.encoder_um() == pytest.approx(at_um)
    stage.move_to(30.0)
    assert stage.settle(10.0) == pytest.approx(30.0, abs=0.01)
    twin.power_cycle()
    with pytest.raises(DeviceError, match="not referenced"):  # the consent was for the opening
        stage.greet()
    assert axis.encoder_um() == pytest.approx(30.0)


def test_a_reference_that_is_not_found_is_a_stall_and_leaves_nothing_running():
    clock = SimClock()
    _, axis, stage = motor(clock, may_move_on_enable=True)
    axis.obstruct(100.0)
    with pytest.raises(StageStalled, match="no reference was found by its switch"):
        stage.greet()
    assert not axis.moving()


def test_a_controller_that_cannot_search_says_so():
    clock = SimClock()
    twin, axis, stage = motor(clock, may_move_on_enable=True)
    del twin._done["FRF"]
    with pytest.raises(DeviceError) as caught:
        stage.greet()
    assert caught.value.code in ("device-garbled", "device-refused")
    assert axis.encoder_um() == 150.0


def test_a_motor_that_goes_off_during_the_search_is_not_believed():
    clock = SimClock()
    twin, axis, stage = motor(clock, may_move_on_enable=True)
    sleep = clock.sleep

    def power_cut(seconds: float) -> None:
        sleep(seconds)
        if axis.moving():
            twin.power_cycle()

    clock.sleep = power_cut
    with pytest.raises(StageStalled):
        stage.greet()


def test_an_old_controller_without_the_question_for_its_reference():
    clock = SimClock()
    twin = PiE709(Axis(clock, TRAVEL))
    del twin._told["FRF?"]
    stage = on_loopback(twin, clock)
    stage.greet()
    stage.move_to(10.0)
    assert stage.settle(5.0) == pytest.approx(10)


@pytest.mark.parametrize(("reply", "code"), [(b"", "device-silent"), (b"\xff\x00\n", "device-garbled")])
def test_something_else_behind_the_port(monkeypatch: pytest.MonkeyPatch, reply: bytes, code: str):
    monkeypatch.setattr(polled, "REPLY_TIMEOUT_S", 0.03)
    with closing(OnPty(lambda data: [reply] if reply else [])) as far:
        with pytest.raises(DeviceError) as caught:
            open_stage(table(far.port, units_per_um=1.0), DeviceContext(SystemClock()))
        assert caught.value.code == code
        assert "an E-709 is delivered with 115200" in caught.value.message()


def test_it_reconnects_through_a_name_that_stays(tmp_path: Path):
    name = tmp_path / "port"
    twin = PiE709(Axis(SystemClock(), TRAVEL))
    first = OnPty(twin.feed)
    name.symlink_to(first.port)
    with closing(open_stage(table(str(name), units_per_um=1.0), DeviceContext(SystemClock(), tmp_path))) as stage:
        stage.move_to(5.0)
        stage.settle(5.0)
        first.close()
        with pytest.raises(DeviceError):
            stage.position_um()
        name.unlink()
        with closing(OnPty(twin.feed)) as second:
            name.symlink_to(second.port)
            assert stage.reconnect() == pytest.approx(5.0)
            stage.move_to(7.0)
            assert stage.settle(5.0) == pytest.approx(7.0)
    assert '"MOV 1 7.000000\\nERR?\\n"' in (tmp_path / "stage-z.jsonl").read_text()
