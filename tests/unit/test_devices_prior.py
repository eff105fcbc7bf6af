"""What is particular to Prior's controllers: the codec with its two meanings of R, and steps of any length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.drivers.prior import PriorStage
from devices.errors import MalformedReply, Refused, RigError
from devices.link import Link
from devices.rig import AxisSpec
from devices.transport.loopback import Loopback
from devices.values import Limits
from devices.wire import prior
from sim.clock import SimClock
from sim.controllers.prior import ProScan
from sim.motion import Axis

if TYPE_CHECKING:
    from devices.wire.exchange import Request

REQUESTS = [
    prior.identity(), prior.standard_mode(), prior.resolution(), prior.position(), prior.set_position(0), prior.move(5),
    prior.move_by(5), prior.is_moving(), prior.halt(), prior.speed(), prior.set_speed(50),
]  # fmt: skip


def on_loopback(step_um: float = 0.1, **changes: object) -> tuple[PriorStage, Axis]:
    clock = SimClock()
    limits = {"min_um": -500.0, "max_um": 500.0}
    axis = Axis(clock, Limits(**limits))
    link = Link(Loopback(ProScan(axis, step_um=step_um).feed, clock), clock, terminator=prior.TERMINATOR)
    table = {"driver": "prior-proscan", "port": "x", "limits": limits, **changes}
    return PriorStage(link, AxisSpec.model_validate(table), clock), axis


@given(st.binary(max_size=40))
def test_any_bytes_decode_or_raise_an_error_of_ours(reply: bytes):
    for request in REQUESTS:
        framed = request.framing(reply)
        try:
            request.decode(reply if framed is None else framed)
        except (MalformedReply, Refused):
            continue


@pytest.mark.parametrize(
    ("request_", "payload", "received", "meaning"),
    [
        (prior.move(-253), b"V,-253\r$\r", b"R\r4\r", True),
        (prior.move(253), b"V,253\r$\r", b"4\r", True),
        (prior.move(253), b"V,253\r$\r", b"R\rR\r0\r", False),
        (prior.move_by(-50), b"D,50\r$\r", b"R\r7\r", True),
        (prior.move_by(50), b"U,50\r$\r", b"R\r3\r", False),
        (prior.is_moving(), b"$\r", b"R\r0\r", False),
        (prior.position(), b"PZ\r", b"R\r-253\r", -253),
        (prior.resolution(), b"RES,Z\r", b"-0.1\r", -0.1),
        (prior.standard_mode(), b"COMP,0\r", b"0\r", None),
        (prior.halt(), b"I\r$\r", b"R\r4\r", True),
        (prior.identity(), b"DATE\r", b"Prior\rVersion 1\r", "Prior Version 1"),
    ],
)
def test_the_documented_exchanges(request_: Request, payload: bytes, received: bytes, meaning: object):
    assert request_.payload == payload
    assert request_.decode(request_.framing(received)) == meaning
    assert request_.framing(received[:-1]) is None


@pytest.mark.parametrize(("received", "reason"), [(b"E,8\r0\r", "8"), (b"R\rE,18\r4\r", "18"), (b"E,99\r0\r", "99")])
def test_a_refused_move(received: bytes, reason: str):
    request = prior.move(5)
    with pytest.raises(Refused) as caught:
        request.decode(request.framing(received))
    assert caught.value.reason == reason


@pytest.mark.parametrize(("step_um", "invert", "z_um"), [(-0.1, False, 12.3), (0.1, True, -12.3), (-0.1, True, -12.3)])
def test_upwards_is_upwards_whichever_way_the_steps_count(step_um: float, invert: bool, z_um: float):
    stage, axis = on_loopback(step_um, invert=invert)
    stage.greet()
    stage.move_to(12.3)
    assert stage.settle(5.0) == pytest.approx(12.3)
    assert axis.encoder_um() == pytest.approx(z_um)


def test_steps_of_another_length_than_the_file_says_are_told():
    stage, _ = on_loopback(0.25)
    with pytest.raises(RigError, match=r"a step is 0.25 µm, as the controller tells, and not 0.1 µm"):
        stage.greet()
    stage, axis = on_loopback(0.25, units_per_um=4.0)
    stage.greet()
    stage.move_to(10.0)
    assert stage.settle(5.0) == pytest.approx(10.0)
    assert axis.encoder_um() == pytest.approx(10.0)


def test_zero_and_speed():
    stage, axis = on_loopback()
    stage.greet()
    stage.move_to(30.0)
    stage.settle(5.0)
    stage.zero_here()
    assert stage.settle(5.0) == 0
    stage.move_to(5.0)
    assert stage.settle(5.0) == pytest.approx(5)
    assert axis.encoder_um() == pytest.approx(35)
    assert stage.set_speed_percent(40.0) == 40
    with pytest.raises(Refused, match="out of range"):
        stage.set_speed_percent(101.0)
