"""The twin of the MS-2000: byte for byte as its clients know it, on a pseudo-terminal and fed directly."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.values import Limits
from sim.clock import SimClock
from sim.controllers.asi import Ms2000
from sim.controllers.asi_grammar import LONG_NAMES, Nack, Word, parse
from sim.faults import LATE_S, Faults, FaultyTwin, parse_faults
from sim.motion import Axis
from sim.serial_line import SerialLine, converse
from sim.uart import as_heard

GOLDEN = Path(__file__).parents[1] / "golden" / "asi_ms2000.log"
LIMITS = Limits(-500.0, 500.0)


class Bench:
    """A twin on simulated time."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.axes = {letter: Axis(self.clock, LIMITS) for letter in "XYZ"}
        self.twin = Ms2000(self.axes)

    def ask(self, command: str) -> str:
        return b"".join(self.twin.feed(command.encode() + b"\r")).decode()

    def ask_at_rest(self, command: str) -> str:
        reply = self.ask(command)
        self.clock.sleep(10.0)
        return reply

    @property
    def z_um(self) -> float:
        return self.axes["Z"].encoder_um()


@pytest.fixture
def bench() -> Bench:
    return Bench()


@contextlib.contextmanager
def on_wires(*faults: str, baud: int = 115200):
    """Run a twin on a pseudo-terminal and a TCP port."""
    clock = SystemClock()
    twin = Ms2000({letter: Axis(clock, LIMITS) for letter in "XYZ"})
    twin.feed(b"S Z=1.5\r")
    line = SerialLine(FaultyTwin(twin.feed, Faults(parse_faults(faults), clock)).feed, baud, clock)
    try:
        yield line
    finally:
        line.close()


def ask(port: serial.SerialBase, command: str) -> bytes:
    port.write(command.encode() + b"\r")
    return port.read_until(b"\r\n")


def golden() -> list[tuple[str, bool, bytes]]:
    exchanges = []
    for line in GOLDEN.read_text(encoding="ascii").splitlines():
        if line.startswith("#"):
            continue
        command, arrow, reply = line.partition(" => ") if " => " in line else line.partition(" -> ")
        exchanges.append((command, arrow == " => ", reply.encode().decode("unicode_escape").encode()))
    return exchanges


@pytest.mark.parametrize("way", ["pty_path", "tcp_url"])
def test_golden_log_over_a_real_wire(way):
    with on_wires() as line, serial.serial_for_url(getattr(line, way), 115200, timeout=5) as port:
        for command, until, expected in golden():
            reply = ask(port, command)
            while until and reply == b"B\r\n":
                reply = ask(port, command)
            assert (command, reply) == (command, expected)


def test_a_client_of_another_baud_hears_noise_until_it_sets_the_right_one():
    with on_wires(baud=9600) as line, serial.Serial(line.pty_path, 115200, timeout=5, exclusive=True) as port:
        port.write(b"W Z\r")
        assert port.read(1)
        assert b":A" not in port.read(port.in_waiting)
        port.baudrate = 9600
        port.timeout = 0.2
        port.read(1000)
        port.timeout = 5
        assert ask(port, "W Z") == b":A 0 \r\n"


@pytest.mark.parametrize("way", ["pty_path", "tcp_url"])
def test_a_dying_twin_takes_the_port_with_it(way):
    with on_wires("z.die@2") as line, serial.serial_for_url(getattr(line, way), 115200, timeout=5) as port:
        assert ask(port, "/") == b"N\r\n"
        with pytest.raises(OSError, match=r"disconnected|no data|Input/output"):
            ask(port, "/")


def test_a_death_by_tcp_closes_the_terminal_too():
    with on_wires("z.die@2") as line, serial.Serial(line.pty_path, 115200, timeout=5) as other:
        with serial.serial_for_url(line.tcp_url, timeout=5) as port:
            assert ask(port, "/") == b"N\r\n"
            port.write(b"/\r")
            with pytest.raises(OSError, match="disconnected"):
                port.read(1)
        with pytest.raises(OSError, match=r"no data|Input/output"):
            other.read(1)


class Scripted:
    """A channel whose client sends the given bytes, then leaves; notes when it is answered."""

    def __init__(self, clock: SimClock, *sent: bytes, baud: int | None = None) -> None:
        self.clock, self.sent, self.baud = clock, list(sent), baud
        self.heard: list[tuple[float, bytes]] = []

    def read(self) -> bytes:
        return self.sent.pop(0) if self.sent else b""

    def write(self, data: bytes) -> None:
        self.heard.append((self.clock.now(), data))

    def client_baud(self) -> int | None:
        return self.baud


def conversation(*faults: str, baud: int = 9600, client_baud: int | None = None) -> list[tuple[float, bytes]]:
    clock = SimClock()
    channel = Scripted(clock, b"/\r", b"W Z\r", baud=client_baud)
    twin = Ms2000({letter: Axis(clock, LIMITS) for letter in "XYZ"})
    converse(channel, FaultyTwin(twin.feed, Faults(parse_faults(faults), clock)).feed, baud, clock)
    return channel.heard


@pytest.mark.parametrize("baud", [9600, 115200])
def test_bytes_arrive_as_on_a_wire_of_that_baud(baud):
    heard, byte_s = conversation(baud=baud), 10 / baud
    assert b"".join(data for _, data in heard) == b"N\r\n:A 0 \r\n"
    bytes_on_the_wire = [3, 4, 5, *range(10, 17)]  # after two of the first command, and four more of the second
    assert [at for at, _ in heard] == pytest.approx([n * byte_s for n in bytes_on_the_wire])


def test_a_late_reply_comes_late_and_whole():
    punctual, late = conversation(), conversation("z.late@1")
    assert [data for _, data in late] == [data for _, data in punctual]
    assert [at for at, _ in late] == pytest.approx([at + LATE_S for at, _ in punctual])


def test_a_client_at_another_baud_is_not_understood():
    heard = conversation(baud=9600, client_baud=19200)
    assert [data for _, data in heard] == [as_heard(b":N-1 \r\n", 9600, 19200)] * 2


def test_half_a_reply_and_then_the_next():
    with on_wires("z.half@1") as line, serial.Serial(line.pty_path, 115200, timeout=5) as port:
        port.write(b"W Z\r/\r")
        assert port.read_until(b"\r\n") == b":A N\r\n"


def test_the_terminal_is_raw_and_outlives_its_client():
    with on_wires() as line:
        for _ in range(2):
            with serial.Serial(line.pty_path, 115200, timeout=5, exclusive=True) as port:
                assert ask(port, "W Z") == b":A 0 \r\n"
        client = os.open(line.pty_path, os.O_RDWR | os.O_NOCTTY)  # no serial library: speed as we left it
        os.write(client, b"V\r")
        received = b""
        while not received.endswith(b"\n"):
            received += os.read(client, 100)
        os.close(client)
        assert received == b":A Version: USB-9.54 \r\n"


def test_one_tcp_client_after_the_other():
    with on_wires() as line:
        for _ in range(3):
            with serial.serial_for_url(line.tcp_url, timeout=5) as port:
                assert ask(port, "/") == b"N\r\n"


# -- the state machine, on simulated time ----------------------------------------------------------------------------


@given(st.lists(st.binary(max_size=30), max_size=10))
def test_any_bytes_are_taken(chunks):
    twin = Bench().twin
    for chunk in [*chunks, b"\r"]:
        assert all(reply.endswith(b"\r\n") for reply in twin.feed(chunk))
    assert twin.feed(b"\x08/\r") in ([b"N\r\n"], [b"B\r\n"])


words = st.sampled_from(["M", "R", "W", "S", "AC", "SL", "SU", "ZS", "RM", "LD", "TTL", "H", "Z", "!", "\\", "RS", "J"])
numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)
arguments = st.builds("{}={:f}".format, st.sampled_from("XYZFM"), numbers) | st.sampled_from(["Z", "Z?", "X?", "Z+"])


@given(st.lists(st.builds("{} {}".format, words, arguments), max_size=25))
def test_any_commands_leave_a_twin_that_answers(commands):
    bench = Bench()
    for command in commands:
        assert bench.ask(command).startswith(":")
        bench.twin.ttl_in()
        bench.clock.sleep(0.01)
    assert bench.ask("/") in ("N\r\n", "B\r\n")
    assert bench.ask("w z").startswith(":A ")


@pytest.mark.parametrize("cut", range(1, 8))
def test_commands_may_come_in_pieces(bench, cut):
    line = b"M Z=100\r"
    assert bench.twin.feed(line[:cut]) + bench.twin.feed(line[cut:]) == [b":A \r\n"]


def test_line_feeds_are_ignored_and_backspace_flushes(bench):
    assert bench.twin.feed(b"W Z\r\n/\r\n") == [b":A 0 \r\n", b"N\r\n"]
    assert bench.twin.feed(b"M Z=1000\x08/\r") == [b"N\r\n"]
    assert bench.twin.feed(b"rubbish\x7fW Z\r") == [b":A 0 \r\n"]
    assert bench.twin.feed(b"\r\r\r") == []
    assert bench.twin.feed(b"\xff\x41W Z\r") == [b":A 0 \r\n"]


@pytest.mark.parametrize("spelling", ["M Z=100", "m z=100", "MOVE Z=100", "Move  z = +100.0 "])
def test_commands_have_many_spellings(bench, spelling):
    assert bench.ask_at_rest(spelling) == ":A \r\n"
    assert bench.z_um == pytest.approx(10.0)


def test_every_long_name_is_known(bench):
    for name in LONG_NAMES:
        assert not bench.ask(f"{name} Z?").startswith(":N-1")


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("BOGUS", ":N-1\r\n"),
        ("?", ":N-1\r\n"),
        ("M Q=1", ":N-2\r\n"),
        ("W F", ":N-2\r\n"),
        ("W", ":N-3\r\n"),
        ("M Z=abc", ":N-4\r\n"),
        ("M Z=99999999999", ":N-4\r\n"),
        ("ZS Y=40000", ":N-4\r\n"),
    ],
)
def test_refusals_carry_their_number_and_move_nothing(bench, command, reply):
    assert bench.ask(command) == reply
    assert bench.ask("/") == "N\r\n"


def test_a_move_takes_its_time_and_can_be_watched(bench):
    bench.ask("M Z=1000")
    assert (bench.ask("/"), bench.ask("RS Z?")) == ("B\r\n", ":A B\r\n")
    seen = []
    while bench.ask("/") == "B\r\n":
        bench.clock.sleep(0.01)
        seen.append(int(bench.ask("W Z").split()[1]))
    assert seen == sorted(seen)
    assert len(set(seen)) > 5
    assert seen[-1] == 1000


def test_a_missing_number_is_zero(bench):
    bench.ask_at_rest("M Z=500")
    bench.ask_at_rest("M Z")
    assert bench.z_um == 0.0


def test_several_axes_are_answered_in_the_order_of_the_hardware(bench):
    bench.ask_at_rest("M Z=3 X=1 Y=-2")
    assert bench.ask("W Z X Y") == ":A 1 -2 3 \r\n"
    bench.ask("M Z=500")
    assert bench.ask("RS X? Y? Z?") == ":A NNB\r\n"
    assert bench.ask("AC X? Z?") == ":X=70 Z=70 A\r\n"


def test_halt_of_a_move_is_n21_of_rest_is_a(bench):
    assert bench.ask("\\") == ":A \r\n"
    bench.ask("M Z=5000")
    bench.clock.sleep(0.05)
    assert bench.ask_at_rest("HALT Z") == ":N-21\r\n"
    assert 0 < bench.z_um < 500
    assert bench.ask("HALT") == ":A \r\n"


def test_status_byte_tells_rest_motion_ramps_and_limits(bench):
    assert bench.ask("RS Z") == ":A 10\r\n"
    bench.ask("M Z=5000")
    clock_s = [0.01, 0.15, 0.12]
    seen = []
    for step_s in clock_s:
        bench.clock.sleep(step_s)
        seen.append(int(bench.ask("RS Z").split()[1]))
    assert seen == [0b11111, 0b01111, 0b111111]
    bench.clock.sleep(10)
    assert bench.ask("RS Z") == f":A {10 | 1 << 6}\r\n"
    bench.ask_at_rest("M Z=-9000")  # past the lower limit: it stops there
    assert bench.ask("RS Z") == f":A {10 | 1 << 7}\r\n"
    assert bench.z_um == -500.0


def test_speed_is_clipped_in_silence_and_reads_back(bench):
    assert bench.ask("S Z=7.5") == ":A \r\n"
    assert bench.ask("S Z?") == ":A Z=2.000000\r\n"
    bench.ask("S Z=0.1")
    bench.ask("M Z=1000")
    bench.clock.sleep(0.5)
    assert 40 < bench.z_um < 60


def test_here_and_zero_rename_the_place(bench):
    bench.ask_at_rest("M Z=1000")
    assert bench.ask("H Z=50") == ":A \r\n"
    assert bench.ask("W Z") == ":A 50 \r\n"
    bench.ask_at_rest("M Z=60")
    assert bench.z_um == pytest.approx(101.0)
    bench.ask("Z")
    assert bench.ask("W X Y Z") == ":A 0 0 0 \r\n"
    bench.ask_at_rest("R Z=-10")
    bench.ask_at_rest("!")
    assert bench.ask("W Z") == ":A 0 \r\n"


def test_limits_are_set_and_told_in_mm(bench):
    bench.ask("SU Z=0.01")
    assert (bench.ask("SU Z?"), bench.ask("SL Z?")) == (":A Z=0.010\r\n", ":A Z=-0.500\r\n")
    bench.ask_at_rest("M Z=1000")
    assert bench.ask("W Z") == ":A 100 \r\n"


def test_a_motor_that_is_off_refuses_to_move(bench):
    bench.ask("MC Z-")
    assert (bench.ask("MC Z?"), bench.ask("M Z=10"), bench.ask("RS Z")) == (":A 0\r\n", ":N-5\r\n", ":A 8\r\n")
    bench.ask("MC Z+")
    assert (bench.ask("MC Z?"), bench.ask("M Z=10")) == (":A 1\r\n", ":A \r\n")


def test_settings_of_axes_are_kept(bench):
    assert bench.ask("B Z=0.01") == ":A \r\n"
    assert (bench.ask("B Z?"), bench.ask("B X?")) == (":Z=0.010000 A\r\n", ":X=0.040000 A\r\n")
    assert (bench.ask("UM Z?"), bench.ask("CNTS Z?")) == (":Z=10000 A\r\n", ":Z=45397.600000 A\r\n")
    assert (bench.ask("J Z?"), bench.ask("SS Z")) == (":A Z=4\r\n", ":A \r\n")


def test_the_page_for_people_has_two_columns(bench):
    lines = bench.ask("INFO Z").removesuffix("\r\n").split("\r")
    assert len(lines) > 5
    assert {len(line) for line in lines} == {66}


# -- triggered z -----------------------------------------------------------------------------------------------------


def pulses(bench: Bench, count: int) -> list[float]:
    seen = []
    for _ in range(count):
        bench.twin.ttl_in()
        bench.clock.sleep(0.4)
        seen.append(round(bench.z_um, 3))
    return seen


def test_pulses_step_through_the_ring(bench):
    for command in ["RM X=0", "LD Z=10", "LD Z=20", "LD Z=35", "RM Y=4 Z=0", "TTL X=1"]:
        assert bench.ask(command) == ":A \r\n"
    assert bench.ask("RM X?") == ":A X=3\r\n"
    assert pulses(bench, 4) == [1.0, 2.0, 3.5, 1.0]
    assert bench.ask("RM Z?") == ":A Z=1\r\n"
    assert bench.ask_at_rest("RM") == ":A \r\n"  # a pulse by command
    assert bench.z_um == 2.0
    bench.ask("RM Z=0")
    assert pulses(bench, 2) == [1.0, 2.0]
    bench.ask("TTL X=0")
    assert pulses(bench, 1) == [2.0]


def test_the_ring_leaves_z_alone_until_told(bench):
    bench.ask("LD Z=10")
    bench.ask("TTL X=1")
    assert pulses(bench, 1) == [0.0]


def test_the_ring_is_full_after_fifty(bench):
    replies = [bench.ask(f"LD Z={n}") for n in range(51)]
    assert replies[:50] == [":A \r\n"] * 50
    assert replies[50] == ":N-5\r\n"


def test_pulses_step_a_stack_around_the_place_of_the_first(bench):
    bench.ask_at_rest("M Z=100")
    bench.ask("ZS X=20 Y=5 Z=0 F=10000")
    bench.ask("TTL X=4")
    assert pulses(bench, 6) == [6.0, 8.0, 10.0, 12.0, 14.0, 6.0]
    assert (bench.ask("ZS M?"), bench.ask("TTL X?")) == (":A M=1\r\n", ":A X=4\r\n")


def test_a_triangular_stack_goes_back_as_it_came(bench):
    bench.ask("ZS X=20 Y=3 Z=1 F=10000")
    bench.ask("TTL X=4")
    assert pulses(bench, 6) == [-2.0, 0.0, 2.0, 0.0, -2.0, 0.0]


def test_a_stack_returns_to_its_start_when_no_pulse_comes(bench):
    bench.ask("ZS X=20 Y=5 F=500")
    bench.ask("TTL X=4")
    assert pulses(bench, 2) == [-4.0, -2.0]
    bench.clock.sleep(0.2)
    bench.ask("/")
    bench.clock.sleep(1.0)
    assert bench.ask("W Z") == ":A 0 \r\n"
    assert bench.ask("ZS M?") == ":A M=0\r\n"


def test_pulses_repeat_the_last_relative_move(bench):
    bench.ask_at_rest("R Z=15")
    bench.ask("TTL X=2")
    assert pulses(bench, 2) == [3.0, 4.5]


def test_the_grammar_reads_letters_values_and_marks():
    assert parse("ttl  X=1  y = -2.5 F Z? M+").words == (
        Word("X", 1.0),
        Word("Y", -2.5),
        Word("F"),
        Word("Z", mark="?"),
        Word("M", mark="+"),
    )
    with pytest.raises(Nack, match=":N-4"):
        parse("M Z=1X=2")
