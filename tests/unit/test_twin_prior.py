"""The twin of the ProScan III: byte for byte as its clients know it, with both meanings of R."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.values import Limits
from sim.clock import SimClock
from sim.controllers.prior import QUEUE, ProScan
from sim.motion import Axis

GOLDEN = Path(__file__).parents[1] / "golden" / "prior_proscan.log"


class Bench:
    """A twin on simulated time."""

    def __init__(self, says_r: str = "accepted", step_um: float = 0.1) -> None:
        self.clock = SimClock()
        self.axis = Axis(self.clock, Limits(-500.0, 500.0))
        self.twin = ProScan(self.axis, says_r=says_r, step_um=step_um)

    def ask(self, command: str) -> str:
        return b"".join(self.twin.feed(command.encode() + b"\r")).decode()

    def rest(self) -> None:
        self.clock.sleep(10.0)


def test_golden_log():
    bench = Bench()
    for line in GOLDEN.read_text(encoding="ascii").splitlines():
        command, _, reply = line.partition(" -> ")
        if command == "wait":
            bench.rest()
        elif not command.startswith("#"):
            assert (command, bench.ask(command)) == (command, reply.encode().decode("unicode_escape"))


@pytest.mark.parametrize("separator", [",", " ", "\t", ";", ":", "=", ", "])
def test_every_separator_will_do(separator: str):
    bench = Bench()
    assert bench.ask(f"v{separator}253") == "R\r"
    bench.rest()
    assert bench.ask("PZ") == "253\r"


@pytest.mark.parametrize(
    ("command", "code"),
    [("NIX", 5), ("V", 10), ("V,x", 4), ("RES,Q", 10), ("RES,Z,0", 11), ("SMZ,0", 8), ("SMZ,101", 8), ("COMP,7", 8),
     ("PIEZORANGE", 20)],
)  # fmt: skip
def test_errors_by_number(command: str, code: int):
    assert Bench().ask(command) == f"E,{code}\r"


def test_finished_moves_are_reported_in_their_order_and_later_ones_wait():
    bench = Bench("finished")
    assert bench.ask("V,100") + bench.ask("U,50") == ""
    assert bench.ask("$") == "4\r"
    assert bench.twin.unasked() == []
    bench.rest()
    assert bench.twin.unasked() == [b"R\r"]
    assert bench.axis.moving()
    bench.rest()
    assert bench.ask("PZ") == "R\r150\r"
    assert bench.ask("$") == "0\r"


def test_too_many_moves_are_refused():
    bench = Bench("finished")
    replies = [bench.ask("U,1") for _ in range(QUEUE + 2)]
    assert replies == [""] * (QUEUE + 1) + ["E,18\r"]


@pytest.mark.parametrize("says_r", ["accepted", "finished"])
@pytest.mark.parametrize("stop", ["I", "K"])
def test_a_stop_ends_all_moves(says_r: str, stop: str):
    bench = Bench(says_r)
    bench.ask("SMZ,5")
    bench.ask("V,5000")
    bench.ask("U,10")
    bench.clock.sleep(1.0)
    assert bench.ask(stop) == "R\r"
    bench.rest()
    stopped_um = bench.axis.encoder_um()
    assert 0 < stopped_um < 450
    assert bench.ask("$") == "0\r"
    bench.rest()
    assert bench.axis.encoder_um() == stopped_um


def test_a_drive_that_counts_downwards():
    bench = Bench(step_um=-0.1)
    assert bench.ask("RES,Z") == "-0.1\r"
    bench.ask("V,100")
    bench.rest()
    assert bench.axis.encoder_um() == pytest.approx(-10)


def test_a_power_cycle_makes_here_zero_and_forgets_all_settings():
    bench = Bench()
    for command in ("SMZ,20", "RES,Z,0.2", "COMP,1", "V,100"):
        bench.ask(command)
    bench.rest()
    bench.twin.power_cycle()
    assert [bench.ask(command) for command in ("PZ", "SMZ", "RES,Z", "COMP")] == ["0\r", "100\r", "0.1\r", "0\r"]
    assert bench.axis.encoder_um() == pytest.approx(20)


@given(st.binary(max_size=60))
def test_any_bytes_are_survived(data: bytes):
    bench = Bench()
    bench.twin.feed(data + b"\r")
    bench.ask("RES,Z,0.1")
    assert bench.ask("RES,Z") == "0.1\r"
