"""``stereotome section …`` as a user starts it, on a twin behind a pseudo-terminal."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
import serial
from feeds import spec_of
from wires import stereotome

from devices.clock import SystemClock
from sim.feed_line import build_feed_twin
from sim.serial_line import SerialLine

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sim.feed_line import FeedTwin

BAUD = 115_200
TABLE = """
[microtome]
driver = "modbus"
profile = "leadshine-rs"
port = "{port}"
limits = {{ feed_um_max = 4000.0, thickness_nm_max = 10000.0 }}
[microtome.knife]
profile = "plc-mailbox"
unit = 2
window_um = [30.0, 0.0]
clearance_um = 5.0
"""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[Path, FeedTwin, SerialLine]]:
    clock = SystemClock()
    twin = build_feed_twin(spec_of("leadshine-rs"), clock)
    with ExitStack() as running:
        line = SerialLine(twin.feed_upset, BAUD, clock, misheard=b"")
        running.callback(line.close)
        instrument = tmp_path / "instrument.toml"
        instrument.write_text(TABLE.format(port=line.port))
        yield instrument, twin, line


def test_a_session_by_hand(bench):
    instrument, twin, _ = bench
    shown = stereotome("section", "show", "-i", instrument)
    assert shown.out == "feed: idle, at 0.000 µm\nknife: clear, 0 cuts counted\n"
    refused = stereotome("section", "feed", 2000, "-i", instrument)
    assert (refused.code, twin.machine.moves_executed) == (5, 0)
    assert "home it: stereotome section home" in refused.err
    assert stereotome("section", "home", "-i", instrument).code == 5
    assert stereotome("section", "home", "--yes", "-i", instrument).out.startswith("feed: ready, at 0.000 µm")
    assert stereotome("section", "approach", 50, "-i", instrument).out.startswith("feed: ready, at 50.000 µm")
    assert stereotome("section", "feed", 2000, "-i", instrument).out.startswith("feed: ready, at 52.000 µm")
    uncut = stereotome("section", "cut", "-i", instrument)
    assert (uncut.code, twin.plc.knife.strokes_begun) == (5, 0)
    cut = stereotome("section", "cut", "--stage-is-parked", "-i", instrument)
    assert cut.out == "feed: ready, at 52.000 µm\nknife: clear, 1 cuts counted\n"
    assert stereotome("section", "retract", 60, "-i", instrument).code == 5
    assert stereotome("section", "retract", 10, "-i", instrument).out.startswith("feed: ready, at 10.000 µm")
    assert twin.plc.knife.cuts_executed == 1


def test_stop_goes_past_the_program_that_holds_the_port(bench):
    instrument, twin, line = bench
    twin.machine.zero_here()
    twin.machine.jog(10.0)
    with serial.Serial(line.port, BAUD, exclusive=True):
        assert stereotome("section", "stop", "-i", instrument).out == "feed and knife were told to stop.\n"
    while twin.machine.axis.ramp() != 0 or twin.machine.moving:
        pass
    assert twin.machine.position_um < twin.machine.travel.max_um - 1000


def test_an_alarm_is_named_and_reset(bench):
    instrument, twin, _ = bench
    twin.drive.raise_alarm(0x180)
    shown = stereotome("section", "show", "-i", instrument)
    assert (shown.code, shown.out) == (4, "")
    assert "error[feed-alarm]: feed: alarm 0x180: following error." in shown.err
    assert stereotome("section", "show", "--reset", "-i", instrument).code == 0


def test_check_prints_the_frames_of_the_manual():
    told = stereotome("section", "check", "leadshine-rs", "--step-um", 10)
    assert (
        "do move_abs          01 10 62 00 00 08 10 00 01 00 00 13 88 02 58 00 64 00 64 00 00 00 10 BB 1B\n" in told.out
    )
    assert "read status          01 03 10 03 00 01 70 CA\n" in told.out
    one_um = stereotome("section", "check", "leadshine-rs")
    assert "do move_abs          01 10 62 00 00 08 10 00 01 00 00 01 F4 02 58" in one_um.out
    over_tcp = stereotome("section", "check", "applied-motion-scl")
    assert "00 01 00 00 00 0B 01 10 00 1E 00 02 04 00 00 03 E8\n" in over_tcp.out


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["check", "leadshin"], 3, "did you mean 'leadshine-rs'?"),
        (["check", "leadshine-rs", "--step-um", "1e12"], 3, "check counts_per_um"),
        (["show", "-i", "no-such.toml"], 3, "no such file"),
    ],
)
def test_what_is_wrong_is_said(arguments, code, words):
    told = stereotome("section", *arguments)
    assert told.code == code
    assert words in told.err


def test_mistakes_in_the_table_have_lines(tmp_path: Path):
    instrument = tmp_path / "instrument.toml"
    instrument.write_text(TABLE.format(port="x").replace("unit = 2", "unti = 2").replace("4000.0", "40000.0"))
    told = stereotome("section", "show", "-i", instrument)
    assert told.code == 3
    assert "instrument.toml:9: microtome.knife.unti: unknown key; did you mean 'unit'?" in told.err
