"""``devices probe``: who is at a port, asked without changing anything."""

from __future__ import annotations

import json
from contextlib import closing

import pytest
import serial
from wires import stereotome

from devices import probe
from devices.clock import SystemClock
from devices.errors import DeviceBusy, DeviceError, InputError
from devices.probe import Exchange, Report, crc16, probe_port, words
from devices.values import Limits
from sim.controllers.open3d import Emitter
from sim.controllers.pi_gcs import PiE709
from sim.faults import Delayed
from sim.feed_line import FeedTwin
from sim.motion import Axis
from sim.serial_line import MISHEARD, SerialLine
from sim.stages import KINDS

LIMITS = Limits(-100.0, 100.0)


class Table:
    """As much of an axis' table as a twin asks for."""

    units_per_um, axis = 10.0, None


class Watched:
    """A twin that remembers what it was sent."""

    def __init__(self, twin) -> None:
        self.twin = twin
        self.heard = b""

    def feed(self, data: bytes) -> list[Delayed]:
        self.heard += data
        return [Delayed(reply) for reply in self.twin.feed(data)]


def twin_of(driver: str, clock):
    if driver == "open3d":
        return Emitter(clock)
    if driver == "modbus":
        return FeedTwin("leadshine-rs", clock)
    axis = Axis(clock, LIMITS)
    return PiE709(axis) if driver == "pi-gcs2" else KINDS[driver].make(axis, Table)


@pytest.mark.parametrize("baud", [9600, 115200])
@pytest.mark.parametrize("driver", ["asi-ms2000", "asi-tiger", "pi-gcs2", "prior-proscan", "open3d", "modbus"])
def test_each_controller_is_known_by_its_own_words(driver: str, baud: int):
    clock = SystemClock()
    twin = Watched(twin_of(driver, clock))
    misheard = KINDS[driver].misheard if driver in KINDS else b""
    with closing(SerialLine(twin.feed, baud, clock, misheard=misheard)) as line:
        report = probe_port(line.pty_path, (115200, 9600), clock)
        assert report.found is not None
        assert (report.found.driver, report.found.baud) == (driver, baud)
        if isinstance(getattr(twin.twin, "axis", None), Axis):
            assert not twin.twin.axis.moving()
    assert report.exchanges[-1].received
    assert any(driver in line for line in words(report, "here"))


def test_nobody_at_home_is_said_with_every_byte(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(probe, "ANSWER_S", 0.02)
    with closing(SerialLine(lambda data: [Delayed(b"what?")], 9600, SystemClock(), misheard=MISHEARD)) as line:
        report = probe_port(line.pty_path, (9600,), SystemClock())
    assert report.found is None
    said = list(words(report, "/dev/x"))
    assert said[-1] == "/dev/x: nobody known answered."
    assert r"sent b'/\r'  got b'what?'  [77 68 61 74 3f]" in said[0]
    assert next(words(Report(None, [Exchange(9600, b"/\r", b"")]), "x")).endswith("got nothing")


def test_1200_baud_is_never_used():
    assert 1200 not in probe.BAUDS
    with pytest.raises(InputError, match="1200 baud is never used"):
        probe_port("/dev/null", (9600, 1200), SystemClock())


def test_no_question_is_one_that_moves_or_sets_anything():
    asked = b"".join(question for one in probe.PROBES for question in one.questions)
    assert not {0x05, 0x07, 0x08, 0x18, 0xFF} & set(asked), "no control byte of any of these controllers"
    assert not any(question.strip().startswith((b"M", b"R", b"V", b"U", b"H", b"Z")) for question in asked.split())


def test_a_port_that_is_taken_or_vanishes_is_named():
    clock = SystemClock()
    with closing(SerialLine(lambda data: [], 9600, clock)) as line:
        with serial.Serial(line.pty_path, exclusive=True), pytest.raises(DeviceBusy):
            probe_port(line.pty_path, (9600,), clock)
        gone = line.pty_path
    with pytest.raises(DeviceError) as caught:
        probe_port(gone, (9600,), clock)
    assert caught.value.code == "device-missing"


def test_the_command_tells_it_as_json():
    with closing(SerialLine(Watched(twin_of("prior-proscan", SystemClock())).feed, 9600, SystemClock())) as line:
        done = stereotome("devices", "probe", line.pty_path, "--baud", "9600", "--json")
    told = json.loads(done.out)
    assert done.code == 0
    assert told["found"]["driver"] == "prior-proscan"
    assert bytes.fromhex(told["exchanges"][0]["sent"]) == b"/\r"
    assert stereotome("devices", "probe", "/dev/null", "--baud", "1200").code == 2


@pytest.mark.parametrize(("frame", "crc"), [("01 03 00 00 00 01", "84 0a"), ("01 06 60 02 00 10", "37 c6")])
def test_the_checksum_is_the_one_of_the_standard(frame: str, crc: str):
    whole = bytes.fromhex(frame) + bytes.fromhex(crc)
    assert crc16(whole) == 0
    assert crc16(whole[:-1] + b"\x00") != 0
