"""The twin of the emitter against the description of its protocol, without any code of the driver."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.clock import SimClock
from sim.controllers.open3d import BANNER, Emitter

FACTORY = b"parameters 22,2,500,7000,30,6500,10,128,0,0,0,0,0,0,32,0,8333,0\r\nOK\r\n"
FREE = b"0,2,500,7000,30,6500,10,128,0,0,0,0,0,0,32,0,8333,6\n"


def emitter(**options):
    clock = SimClock(50.0)
    return Emitter(clock, **options), clock


def turns(twin):
    return [(round(edge.at_ns / 1e9 - 50.0, 6), edge.eye) for edge in twin.edges()]


def test_settings_are_told_as_the_firmware_prints_them():
    twin, _ = emitter()
    assert twin.feed(b"0\n") == [FACTORY]
    assert twin.feed(b"0") == []
    assert twin.feed(b"\n0\n") == [FACTORY, FACTORY]


def test_a_beginning_of_the_settings_may_be_sent():
    twin, _ = emitter()
    assert twin.feed(b"0,1,700\n")[0].startswith(b"parameters 22,1,700,7000,")
    assert twin.feed(b"0,,9\n")[0].startswith(b"parameters 22,1,700,7000,"), "nothing behind an empty field is read"


@pytest.mark.parametrize(
    ("line", "field", "value"),
    [
        (b"0,2,500,7000,286\n", 4, b"30"),  # 286 does not fit 8 bits
        (b"0,2,65537\n", 2, b"1"),
        (b"0,9\n", 1, b"2"),  # no such glasses
        (b"0,2,-5\n", 2, b"500"),
        (b"0,2,12abc\n", 2, b"12"),
        (b"0,2,abc\n", 2, b"0"),
    ],
)
def test_numbers_are_read_as_the_emitter_reads_them(line, field, value):
    twin, _ = emitter()
    assert twin.feed(line)[0].split(b" ")[1].split(b",")[field] == value


def test_commands_with_and_without_an_answer():
    twin, _ = emitter()
    for line in (b"7,0\n", b"7,2\n", b"8\n", b"10,1\n"):
        assert twin.feed(line) == [b"OK\r\n"]
    for line in (b"9,0\n", b"9, 1\n", b"7,5\n", b"3\n", b"10,7\n"):
        assert twin.feed(line) == []
    assert (twin.view, twin.saves) == (2, 1)


def test_turns_count_in_the_serial_mode_only():
    twin, clock = emitter()
    twin.feed(b"9,0\n")
    assert twin.edges() == []
    twin.feed(FREE.replace(b",6\n", b",1\n"))
    twin.feed(b"9,0\n")
    clock.sleep(0.01)
    twin.feed(b"9, 1\n")
    assert turns(twin) == [(0.0005, "left"), (0.0105, "right")]


def test_a_free_run_alternates_and_drifts():
    twin, clock = emitter(drift_ppm=1000.0)
    twin.feed(FREE)
    clock.sleep(8.4)
    seen = turns(twin)
    assert [eye for _, eye in seen[:4]] == ["left", "right", "left", "right"]
    assert seen[1000][0] == pytest.approx((8.333 + 0.0005) * 1.001, abs=2e-6)


def test_a_changed_frame_time_starts_anew_the_same_does_not():
    twin, clock = emitter()
    twin.feed(FREE)
    clock.sleep(0.010)
    twin.feed(FREE)
    assert [eye for _, eye in turns(twin)] == ["left", "right"]
    twin.feed(FREE.replace(b"8333", b"8334"))
    assert turns(twin)[-1] == (0.0105, "left")


def test_flipped_eyes():
    twin, _ = emitter()
    twin.feed(b"0,2,500,7000,30,6500,10,128,0,0,0,0,0,1,32,0,8333,6\n")
    assert turns(twin)[0][1] == "right"


def test_power_off_forgets_what_was_not_saved():
    twin, _ = emitter()
    twin.feed(b"0,1,700\n8\n0,3\n")
    twin.power_cycle()
    banner, settings = twin.feed(b"0\n")
    assert banner == BANNER
    assert settings.startswith(b"parameters 22,1,700,7000,")


@given(st.binary(max_size=200))
def test_any_bytes_are_survived(data):
    twin, _ = emitter()
    twin.feed(data)
    assert twin.feed(b"\n0\n")[-1].startswith(b"parameters 22,")
