"""The twins of PI's controllers: byte for byte as their clients know them."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.values import Limits
from sim.clock import SimClock
from sim.controllers.pi_gcs import PiE709
from sim.motion import Axis

GOLDEN = Path(__file__).parents[1] / "golden" / "pi_e709.log"
LIMITS = Limits(0.0, 400.0)


class Bench:
    """A twin on simulated time."""

    def __init__(self, *, motor: bool = False) -> None:
        self.clock = SimClock()
        self.axis = Axis(self.clock, LIMITS, position_um=100.0 if motor else 0.0)
        self.twin = PiE709.c863(self.axis) if motor else PiE709(self.axis)

    def ask(self, command: str) -> str:
        return b"".join(self.twin.feed(command.encode("latin-1"))).decode("latin-1")

    def rest(self) -> None:
        self.clock.sleep(10.0)


def golden() -> list[tuple[str, str]]:
    lines = [line for line in GOLDEN.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    pairs = [line.partition(" -> ") for line in lines]
    return [tuple(text.encode().decode("unicode_escape") for text in (ask, reply)) for ask, _, reply in pairs]


def test_golden_log():
    bench = Bench()
    for command, expected in golden():
        if command == "wait":
            bench.rest()
        else:
            assert (command, bench.ask(command)) == (command, expected)


def test_a_reply_of_several_lines_ends_with_a_line_without_a_space_before_its_end():
    lines = Bench().ask("HLP?\n").split("\n")
    assert len(lines) > 20
    assert all(line.endswith(" ") for line in lines[:-2])
    assert not lines[-2].endswith(" ")
    assert lines[-1] == ""


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("NIX?", 2), ("NIX 1 5", 2), ("MOV 1 400.5", 7), ("MOV 1 -1", 7), ("MVR 1 500", 7), ("MOV 2 5", 15),
        ("POS? B", 15), ("MOV 1", 1), ("MOV 1 x", 1), ("VEL 1 0", 8), ("VEL 1 1e9", 8), ("SVO 1 2", 17), ("FRF 1", 2),
        ("STP", 10), ("HLT 1", 10), ("\x18", 10), ("MOV 1 399", 0), ("MOV 1 nan", 7),
    ],
)  # fmt: skip
def test_errors_wait_until_they_are_asked_for(command: str, code: int):
    bench = Bench()
    bench.ask("SVO 1 1\n")
    assert bench.ask(f"{command}\n") == ""
    assert bench.ask("ERR?\n") == f"{code}\n"
    assert bench.ask("ERR?\n") == "0\n"


def test_without_servo_nothing_moves():
    bench = Bench()
    assert bench.ask("MOV 1 5\nERR?\nONT? 1\n") == "5\n1=0\n"
    bench.rest()
    assert bench.axis.encoder_um() == 0


def test_a_stop_leaves_it_short_of_its_target_and_on_target_where_it_is():
    bench = Bench()
    bench.ask("SVO 1 1\nVEL 1 100\nMOV 1 400\n")
    bench.clock.sleep(1.0)
    assert (bench.ask("\x05"), bench.ask("ONT? 1\n")) == ("1\n", "1=0\n")
    bench.ask("\x18")
    bench.rest()
    here = bench.ask("POS? 1\n")
    assert 50 < float(here.partition("=")[2]) < 200
    assert bench.ask("MOV? 1\n") == here
    assert (bench.ask("\x05"), bench.ask("\x07"), bench.ask("ONT? 1\n")) == ("0\n", "\xb1\n", "1=1\n")


def test_a_motor_counts_mm_and_moves_only_once_it_was_referenced():
    bench = Bench(motor=True)
    bench.ask("SVO 1 1\n")
    assert bench.ask("MOV 1 0.2\nERR?\nFRF? 1\nTMX? 1\n") == "5\n1=0\n1=0.400000\n"
    bench.ask("FRF 1\n")
    bench.rest()
    assert bench.ask("FRF? 1\nPOS? 1\nMOV 1 0.2\nERR?\n") == "1=1\n1=0.000000\n0\n"
    bench.rest()
    assert bench.axis.encoder_um() == pytest.approx(200)


@pytest.mark.parametrize(("command", "at_um"), [("FRF", 0.0), ("FNL", 0.0), ("FPL", 400.0)])
def test_a_search_takes_its_time_and_ends_where_its_mark_is(command: str, at_um: float):
    bench = Bench(motor=True)
    bench.axis.move_to(200.0)
    bench.rest()
    bench.ask(f"SVO 1 1\nVEL 1 0.1\n{command} 1\n")
    bench.clock.sleep(1.0)
    assert bench.ask("FRF? 1\nONT? 1\nMOV 1 0.1\nERR?\n") == "1=0\n1=0\n5\n"
    bench.rest()
    assert bench.ask("POS? 1\nFRF? 1\n") == f"1={at_um / 1000:.6f}\n1=1\n"
    assert bench.axis.encoder_um() == pytest.approx(at_um)


def test_a_search_that_is_stopped_finds_nothing():
    bench = Bench(motor=True)
    bench.axis.move_to(200.0)
    bench.rest()
    bench.ask("SVO 1 1\nVEL 1 0.1\nFRF 1\n")
    bench.clock.sleep(1.0)
    bench.ask("\x18")
    bench.rest()
    assert bench.ask("FRF? 1\nERR?\n") == "1=0\n10\n"


def test_a_power_cycle_takes_servo_speed_and_a_motors_reference():
    bench = Bench(motor=True)
    bench.ask("SVO 1 1\nFRF 1\n")
    bench.rest()
    bench.ask("VEL 1 0.5\nMOV 1 0.2\n")
    bench.rest()
    bench.twin.power_cycle()
    assert bench.ask("SVO? 1\nFRF? 1\nPOS? 1\nVEL? 1\nERR?\n") == "1=0\n1=0\n1=0.000000\n1=2.000000\n0\n"
    assert bench.axis.encoder_um() == pytest.approx(200)


def test_a_piezo_knows_its_place_after_a_power_cycle():
    bench = Bench()
    bench.ask("SVO 1 1\nMOV 1 50\n")
    bench.rest()
    bench.twin.power_cycle()
    assert bench.ask("SVO? 1\nPOS? 1\n") == "1=0\n1=50.000000\n"


def test_a_motion_error_stops_the_axis_and_takes_the_servo():
    bench = Bench()
    bench.ask("SVO 1 1\nVEL 1 100\nMOV 1 400\n")
    bench.clock.sleep(1.0)
    bench.twin.motion_error()
    bench.rest()
    assert bench.ask("ERR?\nSVO? 1\nONT? 1\n") == "1024\n1=0\n1=0\n"
    assert bench.axis.encoder_um() < 300


@given(st.binary(max_size=60))
def test_any_bytes_are_survived(data: bytes):
    bench = Bench()
    bench.twin.feed(data)
    bench.twin.feed(b"\nERR?\n")
    assert bench.ask("ERR?\n") == "0\n"


@given(st.integers(1, 30))
def test_a_command_may_come_in_pieces(cut: int):
    bench, data = Bench(), b"SVO 1 1\nMOV 1 5\nMOV? 1\nERR?\n"
    replies = bench.twin.feed(data[:cut]) + bench.twin.feed(data[cut:])
    assert b"".join(replies) == b"1=5.000000\n0\n"
