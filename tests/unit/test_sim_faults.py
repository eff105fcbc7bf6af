"""Faults in words, what they do to replies, and bytes on a wire."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import RigError
from sim.clock import SimClock
from sim.faults import LATE_S, Delayed, Faults, FaultyTwin, PortDied, garbled, parse_fault, parse_faults
from sim.uart import as_heard, byte_times_s

REPLY = b":A 1234 \r\n"


def replies(*texts: str, count: int = 6, each_s: float = 0.0) -> list:
    """Ask a twin with faults ``count`` times; "died" ends the list."""
    clock = SimClock()
    twin = FaultyTwin(lambda _: [REPLY], Faults(parse_faults(texts), clock, seed=1))
    answers: list = []
    for _ in range(count):
        try:
            answers.append(twin.feed(b"W Z\r"))
        except PortDied:
            return [*answers, "died"]
        clock.sleep(each_s)
    return answers


WELL = [Delayed(REPLY)]


def test_without_faults_replies_pass():
    assert replies() == [WELL] * 6


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("z.silent", [[]] * 6),
        ("z.silent@3", [WELL, WELL, [], [], [], []]),
        ("z.drop@2", [WELL, [], WELL, WELL, WELL, WELL]),
        ("z.late@2", [WELL, [Delayed(REPLY, LATE_S)], WELL, WELL, WELL, WELL]),
        ("z.garble@1", [[Delayed(garbled(REPLY))], WELL, WELL, WELL, WELL, WELL]),
        ("z.half@1", [[Delayed(b":A 12")], WELL, WELL, WELL, WELL, WELL]),
        ("z.die@3", [WELL, WELL, "died"]),
        ("z.die", ["died"]),
    ],
)
def test_a_fault_strikes_when_it_was_named_for(text, expected):
    assert replies(text) == expected


def test_faults_in_seconds_strike_from_then_on():
    assert replies("z.silent@2.5s", each_s=1.0) == [WELL, WELL, WELL, [], [], []]
    assert replies("z.die@1.5s", each_s=1.0) == [WELL, WELL, "died"]


def test_a_share_is_about_that_share_and_the_same_for_a_seed():
    first, again = (replies("z.drop@20%", count=1000) for _ in range(2))
    assert first == again
    assert 150 < first.count([]) < 250


def test_several_faults_add_up():
    assert replies("z.drop@1", "z.half@2", "z.late@2", count=2) == [[], [Delayed(b":A 12", LATE_S)]]


def test_garbled_keeps_its_end_and_nothing_else():
    assert garbled(REPLY).endswith(b"\r\n")
    assert not garbled(REPLY).startswith(b":A")
    assert garbled(b"0\n")[-1:] == b"\n"
    assert len(garbled(b"\x01\x03")) == 2


def test_faults_of_the_mechanics_are_done_to_the_device_when_they_go_on_and_undone_when_they_go_off():
    done = []
    faults = Faults(parse_faults(["z.stall@-12.5um"]), SimClock())
    faults.when_changed("z.stall", lambda fault: done.append(fault and fault.when))
    faults.switch_on(parse_fault("z.stall@3um"))
    assert faults.switch_off("z.stall")
    assert not faults.switch_off("z.stall")
    assert done == [-12.5, 3.0, None, None]
    assert faults.strike("z") == set()


def test_a_fault_switched_on_later_counts_from_there():
    clock = SimClock()
    faults = Faults((), clock)
    twin = FaultyTwin(lambda _: [REPLY], faults, "feed")
    assert [twin.feed(b"x") for _ in range(3)] == [WELL] * 3
    faults.switch_on(parse_fault("feed.drop@2"))
    faults.switch_on(parse_fault("z.silent"))
    assert [twin.feed(b"x") for _ in range(3)] == [WELL, [], WELL]
    assert [str(fault) for fault in faults.active] == ["feed.drop@2", "z.silent"]
    faults.switch_on(parse_fault("feed.silent@1s"))
    assert twin.feed(b"x") == WELL
    clock.sleep(1.0)
    assert twin.feed(b"x") == []
    faults.switch_off("feed.silent")
    assert twin.feed(b"x") == WELL


def test_camera_faults_count_frames_alone():
    faults = Faults(parse_faults(["camera.drop@2", "camera.hang@4", "z.drop@1"]), SimClock())
    faults.strike("z")
    struck = [faults.strike("camera") for _ in range(5)]
    assert struck == [set(), {"camera.drop"}, set(), {"camera.hang"}, {"camera.hang"}]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("z.lat@3", "did you mean 'z.late'"),
        ("", "known here"),
        ("z.stall", "cannot be read"),
        ("z.stall@3", "cannot be read"),
        ("z.late@3um", "cannot be read"),
        ("z.late@-3", "cannot be read"),
        ("camera.drop@2s", "cannot be read"),
        ("z.late@nan", "cannot be read"),
        ("feed.jam@3", "write feed.jam (always)"),
        ("glasses.drift", "write glasses.drift@Nppm"),
        ("glasses.drift@100um", "cannot be read"),
    ],
)
def test_what_is_no_fault_is_refused_in_words(text, words):
    with pytest.raises(RigError) as refusal:
        parse_fault(text)
    assert words in refusal.value.message()


@given(st.text())
def test_any_text_is_a_fault_or_our_error(text):
    with contextlib.suppress(RigError):
        parse_fault(text)


def test_ten_bits_a_byte():
    assert byte_times_s(4, 9600, 2.0) == pytest.approx([2 + 10 / 9600 * n for n in (1, 2, 3, 4)])
    assert byte_times_s(0, 9600, 2.0) == []


@given(st.binary(max_size=40), st.sampled_from([1200, 9600, 115200]))
def test_the_right_baud_hears_what_was_sent(data, baud):
    assert as_heard(data, baud, baud) == data


def test_too_slow_a_sender_sounds_like_many_bytes_too_fast_a_one_like_few():
    slow, fast = as_heard(REPLY, 9600, 115200), as_heard(REPLY, 115200, 9600)
    assert len(slow) > 2 * len(REPLY)
    assert 0 < len(fast) < len(REPLY)
    assert REPLY.rstrip() not in slow


def test_half_the_baud_by_hand():
    # 0x0F on the line, two samples a bit: start 00, 1111 1111, 0000 0000, stop 11.
    # Heard: start 0, then 0 1 1 1 1 1 1 1 and a missing stop; the line falls again for 0 0 0 0 0 0 0 1 1.
    assert as_heard(b"\x0f", 1, 2)[0] == 0b11111110


@given(st.binary(min_size=1, max_size=20), st.sampled_from([(9600, 115200), (115200, 9600), (19200, 28800)]))
def test_a_wrong_baud_always_hears_something(data, bauds):
    assert as_heard(data, *bauds)
