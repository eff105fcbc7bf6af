"""What goes wrong between a stage and its port, and what is said about it."""

from __future__ import annotations

import threading
from contextlib import closing
from typing import TYPE_CHECKING

import pytest
from small_twin import OnPty, SmallAxis, SteppingClock

from devices.clock import SystemClock
from devices.drivers import polled
from devices.drivers.asi import AsiStage, open_stage
from devices.errors import DeviceBusy, DeviceError, LimitError, LinkLost, NoReply, StageStalled
from devices.link import Link
from devices.registry import DeviceContext
from devices.rig import AxisSpec
from devices.transport import ports
from devices.transport.loopback import Loopback
from devices.transport.transcript import Recorder, Replay
from devices.wire import asi

if TYPE_CHECKING:
    from pathlib import Path

LIMITS = {"min_um": -500.0, "max_um": 500.0}


def axis(port: str, **changes: object) -> AxisSpec:
    return AxisSpec.model_validate({"driver": "asi-ms2000", "port": port, "limits": LIMITS, **changes})


def on_loopback(**changes: object) -> tuple[AsiStage, SmallAxis, SteppingClock]:
    clock = SteppingClock()
    twin = SmallAxis(clock.now)
    link = Link(Loopback(twin.feed, clock), clock, terminator=asi.TERMINATOR)
    return AsiStage(link, axis("loopback", **changes), clock), twin, clock


def test_what_is_refused_is_not_sent():
    stage, twin, _ = on_loopback()
    with pytest.raises(LimitError) as caught:
        stage.move_to(900.0)
    assert twin.commands == []
    assert "Z: +900.00 µm is outside the soft limits -500 … 500 µm. Nothing moved." in caught.value.message()


def test_an_inverted_axis_with_units_of_its_own():
    stage, twin, _ = on_loopback(invert=True, units_per_um=100.0)
    stage.move_to(12.3)
    assert stage.settle(5.0) == pytest.approx(12.3)
    assert "M Z=-1230.000" in twin.commands


def test_a_relative_move_keeps_to_the_limits_and_is_sent_once():
    stage, twin, _ = on_loopback()
    stage.move_by(-20.0)
    assert stage.settle(5.0) == pytest.approx(-20)
    with pytest.raises(LimitError):
        stage.move_by(-481.0)
    twin.spoil = lambda command, reply: b"" if command.startswith("R") else reply
    with pytest.raises(NoReply):
        stage.move_by(5.0)
    assert stage.settle(5.0) == pytest.approx(-15), "the reply was lost, the move was made once"
    assert [command for command in twin.commands if command.startswith("R")] == ["R Z=-200.000", "R Z=50.000"]


def test_the_rest_after_the_arrival_is_waited_for_and_the_position_read_again():
    stage, twin, clock = on_loopback(settle_ms=40.0)
    stage.move_to(1.0)
    stage.settle(5.0)
    before, asked = clock.now(), len(twin.commands)
    stage.settle(5.0)
    assert clock.now() - before >= 0.050
    assert twin.commands[asked:] == ["/", "W Z", "/", "W Z", "W Z"]


def test_a_blocked_axis_is_told_from_a_slow_one():
    stage, twin, clock = on_loopback()
    twin.stall_at = 125.0
    stage.move_to(300.0)
    before = clock.now()
    with pytest.raises(StageStalled, match=r"no progress for 1 s; it is at \+12.50 µm, sent to \+300.00 µm"):
        stage.settle(60.0)
    assert clock.now() - before < 2.5


def test_speed_is_read_back_for_it_is_clipped_without_a_word():
    stage, _, _ = on_loopback()
    assert stage.set_speed_um_s(400.0) == pytest.approx(400)
    assert stage.set_speed_um_s(9000.0) == pytest.approx(5000)
    assert stage.identity() == "Version: USB-9.54"


def test_zero_here():
    stage, _, _ = on_loopback()
    stage.move_to(30.0)
    stage.settle(5.0)
    stage.zero_here()
    assert stage.settle(5.0) == 0


def test_a_lost_and_a_garbled_reply_are_asked_for_again():
    stage, twin, _ = on_loopback()
    for spoilt in (iter([b"", b"\xff\x00\r\n"]), iter([b":A 12", b""])):
        twin.spoil = lambda command, reply, spoilt=spoilt: next(spoilt, reply)
        assert stage.position_um() == 0.0
    assert twin.commands == ["W Z"] * 6


def test_a_halt_from_another_thread_ends_a_settle():
    twin = SmallAxis(SystemClock().now, speed=10.0)
    with closing(OnPty(twin.feed)) as far, closing(open_stage(axis(far.port), DeviceContext(SystemClock()))) as stage:
        stage.move_to(500.0)
        halting = threading.Thread(target=stage.halt)
        halting.start()
        with pytest.raises(StageStalled, match="halted"):
            stage.settle(60.0)
        halting.join()
        assert not twin.moving()


@pytest.mark.parametrize(
    ("spoil", "code", "words"),
    [
        (lambda command, reply: b"", "device-silent", "opened at 9600 baud but nothing came back."),
        (lambda command, reply: b"\xff\xfe\x00\x80", "device-garbled", "unreadable data came back: ff fe 00 80"),
        (lambda command, reply: b"ok\r\n", "device-garbled", "unreadable data came back: 6f 6b."),
    ],
)
def test_a_port_with_something_else_behind_it(monkeypatch: pytest.MonkeyPatch, spoil, code: str, words: str):
    monkeypatch.setattr(polled, "REPLY_TIMEOUT_S", 0.03)
    twin = SmallAxis(SystemClock().now)
    twin.spoil = spoil
    with closing(OnPty(twin.feed)) as far:
        with pytest.raises(DeviceError) as caught:
            open_stage(axis(far.port), DeviceContext(SystemClock()))
        assert caught.value.code == code
        assert caught.value.exit_code == 4
        assert f"z stage: no valid answer from {far.port}." in caught.value.message()
        assert words in caught.value.message()
        assert "set baud" in caught.value.message()


def test_a_controller_that_dies_in_the_middle_of_a_move():
    far = OnPty(SmallAxis(SystemClock().now, speed=10.0).feed)
    with closing(open_stage(axis(far.port), DeviceContext(SystemClock()))) as stage:
        stage.move_to(100.0)
        far.close()
        with pytest.raises(LinkLost) as caught:
            stage.settle(60.0)
        assert caught.value.code == "device-lost"
        with pytest.raises(LinkLost):
            stage.halt()


def test_a_port_that_is_taken():
    with closing(OnPty(SmallAxis(SystemClock().now).feed)) as far:
        held = open_stage(axis(far.port), DeviceContext(SystemClock()))
        with closing(held), pytest.raises(DeviceBusy) as caught:
            open_stage(axis(far.port), DeviceContext(SystemClock()))
        assert caught.value.message() == (
            f"error[device-busy]: z stage: {far.port} is in use by another program.\n"
            "  why: Another console, a terminal (minicom, screen, Arduino IDE) or ModemManager holds it.\n"
            f"  fix: find it: sudo fuser -v {far.port}"
        )
        assert caught.value.exit_code == 8


def test_a_port_that_is_not_there(monkeypatch: pytest.MonkeyPatch):
    present = [ports.Port("/dev/ttyUSB1", "/dev/serial/by-id/usb-FTDI-port0", "FT232R")]
    monkeypatch.setattr(ports, "ports_present", lambda: present)
    with pytest.raises(DeviceError) as caught:
        open_stage(axis("/dev/ttyUSB9"), DeviceContext(SystemClock()))
    assert caught.value.message() == (
        "error[device-missing]: z stage: no serial port /dev/ttyUSB9.\n"
        "  why: Ports present now: /dev/serial/by-id/usb-FTDI-port0.\n"
        '  fix: set port = "/dev/serial/by-id/usb-FTDI-port0" in the instrument file.\n'
        "   or: work without hardware: stereotome demo"
    )


@pytest.mark.parametrize("port", ["socket://127.0.0.1:1", "socket://nowhere", "bogus://x", __file__])
def test_what_is_no_port(port: str):
    with pytest.raises(DeviceError) as caught:
        open_stage(axis(port), DeviceContext(SystemClock()))
    assert caught.value.code == "device-missing"


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ([], "and user 'mk' is not in it.\n  fix: run once: sudo usermod -aG uucp mk   then log out and in again"),
        (["mk"], "user 'mk' is in it, but was not yet at this login.\n  fix: log out and in again"),
    ],
)
def test_a_port_one_may_not_open(monkeypatch: pytest.MonkeyPatch, members: list[str], words: str):
    monkeypatch.setattr(ports.getpass, "getuser", lambda: "mk")
    monkeypatch.setattr(ports, "port_group", lambda port: "uucp")
    monkeypatch.setattr(ports, "group_members", lambda group: members)
    error = ports.open_failure("z stage", "/dev/ttyUSB0", 13, "Permission denied")
    assert error.message().startswith("error[device-permission]: z stage: no permission to open /dev/ttyUSB0.\n")
    assert "  why: The port belongs to group 'uucp'" in error.message()
    assert words in error.message()
    assert error.message().endswith("\n   or: check afterwards: stereotome doctor")


def test_a_transcript_is_recorded_and_replays_the_same(tmp_path: Path):
    path = tmp_path / "stage-z.jsonl"
    stage, twin, clock = on_loopback()
    for make in (lambda: Recorder(Loopback(twin.feed, clock), path, clock), lambda: Replay(path, clock)):
        stage = AsiStage(Link(make(), clock, terminator=asi.TERMINATOR), axis("x"), clock)
        stage.move_to(5.0)
        assert stage.settle(5.0) == pytest.approx(5.0)
        stage.close()
    replay = Replay(path, clock)
    with pytest.raises(DeviceError, match="not b'W Z"):
        AsiStage(Link(replay, clock, terminator=asi.TERMINATOR), axis("x"), clock).position_um()


def test_a_transcript_is_kept_beside_the_run(tmp_path: Path):
    with closing(OnPty(SmallAxis(SystemClock().now).feed)) as far:
        open_stage(axis(far.port), DeviceContext(SystemClock(), tmp_path)).close()
    assert '"to": "device", "bytes": "W Z\\r"' in (tmp_path / "stage-z.jsonl").read_text()
