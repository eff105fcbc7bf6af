"""The twins of the feeds themselves: framing, the manuals' frames, power, and what they count."""

from __future__ import annotations

import pytest
from feeds import PROFILES
from hypothesis import example, given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from sim.clock import SimClock
from sim.controllers.modbus_frame import RtuServer, crc16
from sim.faults import PortDied
from sim.feed_line import FeedTwin, Upset

MOVE = bytes.fromhex("01106200000810000100001388025800640064000000 10BB1B")


def leadshine() -> tuple[FeedTwin, SimClock]:
    clock = SimClock()
    twin = FeedTwin("leadshine-rs", clock)
    twin.machine.zero_here()
    return twin, clock


@given(st.binary(max_size=300))
def test_two_checksums_of_two_makers_agree(data: bytes):
    assert crc16(data) == FramerRTU.compute_CRC(data).to_bytes(2, "big")


@given(st.lists(st.binary(max_size=40), max_size=12), st.sampled_from(PROFILES), st.booleans())
@example([b"\x00\x00\x00\x00"], "leadshine-rs", False)
def test_any_bytes_are_survived(chunks: list[bytes], profile: str, tcp: bool):
    twin = FeedTwin(profile, SimClock(), tcp=tcp)
    for chunk in chunks:
        for reply in twin.feed(chunk):
            assert len(reply) >= 5
    assert twin.machine.feeds_executed == 0


@given(st.binary(min_size=1, max_size=30), st.sampled_from(PROFILES))
def test_any_request_with_a_right_checksum_gets_an_answer_or_none(pdu: bytes, profile: str):
    twin = FeedTwin(profile, SimClock())
    frame = b"\x01" + pdu
    for reply in twin.feed(frame + crc16(frame)):
        assert crc16(reply[:-2]) == reply[-2:]


@given(st.lists(st.integers(1, 6), max_size=6))
def test_a_frame_in_pieces(cuts: list[int]):
    twin, _ = leadshine()
    rest, replies = MOVE, []
    for cut in cuts:
        replies += twin.feed(rest[:cut])
        rest = rest[cut:]
    replies += twin.feed(rest)
    assert [reply[:6].hex(" ") for reply in replies] == ["01 10 62 00 00 08"]
    assert twin.machine.feeds_executed == 1


def test_the_one_frame_move_of_the_manual():
    twin, clock = leadshine()
    status = bytes.fromhex("01 03 02 00 72")  # enabled, command and path done, homed
    assert twin.feed(bytes.fromhex("01 03 10 03 00 01 70 CA")) == [status + crc16(status)]
    twin.feed(MOVE)
    clock.sleep(0.01)
    assert twin.machine.moving
    clock.sleep(1.0)
    assert twin.machine.position_um - 137.0 == pytest.approx(10.0)


def test_a_wrong_checksum_is_exception_8_at_a_leadshine_only():
    spoilt = MOVE[:-1] + b"\x00"
    assert leadshine()[0].feed(spoilt) == [bytes.fromhex("01 83 08 40 F6")]
    assert FeedTwin("oriental-az", SimClock()).feed(spoilt) == []


def test_a_broadcast_is_executed_and_not_answered():
    twin, _ = leadshine()
    frame = b"\x00" + MOVE[1:-2]
    assert twin.feed(frame + crc16(frame)) == []
    assert twin.machine.feeds_executed == 1


def test_another_units_frames_are_not_answered():
    frame = b"\x07" + MOVE[1:-2]
    twin, _ = leadshine()
    assert twin.feed(frame + crc16(frame)) == []
    assert twin.machine.feeds_executed == 0


@pytest.mark.parametrize("profile", PROFILES)
def test_power_off_and_on(profile: str):
    clock = SimClock()
    twin = FeedTwin(profile, clock)
    twin.machine.home()
    clock.sleep(5.0)
    assert twin.machine.homed
    twin.machine.move_to(500, 200.0)
    clock.sleep(5.0)
    twin.power_cycle()
    assert not twin.machine.homed
    assert twin.machine.counts == 0
    assert twin.machine.position_um == pytest.approx(1.0)


def test_a_repeated_relative_command_would_be_counted_twice():
    """What makes the count of feeds a proof: the twin does not forgive a repetition."""
    clock = SimClock()
    twin = FeedTwin("applied-motion-scl", clock)
    for _ in range(2):
        twin.drive.write(30, [0, 100])
        twin.drive.write(124, [0x66])
        clock.sleep(1.0)
    assert twin.machine.feeds_executed == 2


def test_a_mailbox_executes_a_number_once():
    clock = SimClock()
    twin = FeedTwin("plc-mailbox", clock)
    twin.machine.zero_here()
    twin.drive.write(2, [0, 1000, 3, 0x0D40])
    twin.drive.write(1, [3])
    for _ in range(3):
        twin.drive.write(0, [1])
        clock.sleep(1.0)
    assert twin.machine.feeds_executed == 1
    assert twin.drive.read(16, 1) == [1]


def test_a_silent_minute_ends_the_connection_of_an_applied_motion():
    clock = SimClock()
    twin = FeedTwin("applied-motion-scl", clock, tcp=True)
    read_status = bytes.fromhex("0001 0000 0006 01 03 0001 0001")
    clock.sleep(59.0)
    assert len(twin.feed(read_status)) == 1
    clock.sleep(61.0)
    with pytest.raises(PortDied):
        twin.feed(read_status)


def test_a_fault_strikes_as_often_as_it_says():
    twin, _ = leadshine()
    twin.upsets.append(Upset("drop", "any", times=2))
    read = bytes.fromhex("01 03 10 03 00 01 70 CA")
    assert [len(twin.feed(read)) for _ in range(3)] == [0, 0, 1]


def test_a_server_needs_no_whole_frames():
    server = RtuServer({})
    assert server.frames(b"\x01") == []
    assert server.feed(MOVE[1:]) == []
