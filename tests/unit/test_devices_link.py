"""The link: it drains before it asks again, sends once what must not be repeated, and lets a halt through."""

import os
import pty
import threading
from collections import deque
from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DeviceError, LinkLost, MalformedReply, NoReply, Refused
from devices.link import Link
from devices.transport.loopback import Loopback
from devices.transport.serial_port import SerialPort
from devices.transport.transcript import Recorder, Replay
from devices.wire import asi
from devices.wire.exchange import Request, no_reply


class SteppingClock:
    """A clock that moves on only when somebody waits."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += max(seconds, 1e-4)


class LatePeer:
    """A transport whose replies arrive at set times after each write; keeps everything that was sent."""

    name = "late peer"

    def __init__(self, clock: SteppingClock, *replies: tuple[float, bytes]) -> None:
        self.clock = clock
        self.replies = deque(replies)
        self.under_way: list[tuple[float, bytes]] = []
        self.sent: list[bytes] = []
        self.sent_at: list[float] = []

    def write(self, data: bytes) -> None:
        self.sent.append(data)
        self.sent_at.append(self.clock.now())
        if self.replies:
            delay_s, reply = self.replies.popleft()
            self.under_way.append((self.clock.now() + delay_s, reply))

    def read(self, wait_s: float) -> bytes:
        due = [entry for entry in self.under_way if entry[0] <= self.clock.now()]
        if due:
            self.under_way.remove(due[0])
            return due[0][1]
        self.clock.sleep(wait_s)
        return b""

    def close(self) -> None: ...


def link_to(*replies: tuple[float, bytes]) -> tuple[Link, LatePeer]:
    clock = SteppingClock()
    peer = LatePeer(clock, *replies)
    return Link(peer, clock, terminator=asi.TERMINATOR, timeout_s=0.5), peer


def test_the_link_drains_before_it_asks_again():
    link, peer = link_to((0.7, b":A 111 \r\n"), (0.01, b":A 222 \r\n"))
    assert link.ask(asi.where()) == 222
    assert len(peer.sent) == 2
    assert peer.sent_at[1] >= 0.7 + 0.5, "the line was not quiet for a timeout before the second question"


def test_a_late_reply_is_no_answer_to_a_later_question_of_another_kind():
    link, _ = link_to((0.9, b":A 111 \r\n"), (0.01, b":A \r\n"))
    with pytest.raises(NoReply):
        link.ask(Request(b"R Z=5\r", asi.where().decode, repeatable=False))
    assert link.ask(asi.move(5)) is None


def test_a_line_that_never_falls_quiet_is_drained_for_two_timeouts_only():
    link, peer = link_to((0.6, b"x"), (0.01, b":A 5 \r\n"))
    peer.under_way = [(tick / 10, b"noise") for tick in range(6, 15)]
    assert link.ask(asi.where()) == 5
    assert peer.sent_at[1] == pytest.approx(1.5, abs=0.2)


def test_a_request_that_may_not_be_repeated_is_sent_exactly_once():
    for reply in ((9.0, b""), (0.01, b"\xff\xfe\r\n"), (0.01, b":A 12")):
        link, peer = link_to(reply)
        with pytest.raises((NoReply, MalformedReply)):
            link.ask(asi.move_by(-234))
        assert peer.sent == [b"R Z=-234.000\r"]


def test_a_repeatable_request_is_sent_a_bounded_number_of_times():
    link, peer = link_to()
    with pytest.raises(NoReply, match=r"no reply to b'W Z\\r' within 0.5 s"):
        link.ask(asi.where())
    assert len(peer.sent) == 3


def test_a_refusal_is_never_repeated():
    link, peer = link_to((0.01, b":N-1\r\n"))
    with pytest.raises(Refused) as caught:
        link.ask(asi.where())
    assert caught.value.reason == "-1"
    assert len(peer.sent) == 1


def test_bytes_nobody_asked_for_are_dropped():
    link, peer = link_to((0.01, b":A 222 \r\n"))
    peer.under_way.append((0.0, b":A 111 \r\n"))
    assert link.ask(asi.where()) == 222


def test_half_a_reply_is_kept_in_the_error():
    link, _ = link_to((0.1, b":A 12"), (0.1, b":A 12"), (0.1, b":A 12"))
    with pytest.raises(NoReply) as caught:
        link.ask(asi.where())
    assert caught.value.received == b":A 12"


class Stuck:
    """A controller that is silent until it is told to halt, and a clock that stands still until then."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.halted = threading.Event()
        self.seconds = 0.0

    def feed(self, data: bytes) -> list[bytes]:
        if data == b"\\\r":
            self.halted.set()
            return [b":N-21\r\n"]
        self.asked.set()
        return []

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        if self.halted.wait(0.001):
            self.seconds += max(seconds, 1e-3)


def test_a_halt_does_not_wait_for_a_reply_that_never_comes():
    stuck = Stuck()
    link = Link(Loopback(stuck.feed, stuck), stuck, terminator=asi.TERMINATOR)
    errors: list[Exception] = []

    def ask() -> None:
        try:
            link.ask(Request(b"W Z\r", asi.where().decode, repeatable=False))
        except (NoReply, MalformedReply) as error:
            errors.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    assert stuck.asked.wait(10)
    link.interrupt(asi.halt())
    asking.join(10)
    assert stuck.seconds < 0.05, "a cancelled run waited for the line"
    assert isinstance(errors[0], NoReply), "the interrupted question took the halt's reply for its own"


class Interrupted(SteppingClock):
    """A controller that answers at once unless a halt broke in, and a clock in whose first five waits one does."""

    def __init__(self) -> None:
        super().__init__()
        self.link = Link(Loopback(self.feed, self), self, terminator=asi.TERMINATOR)
        self.asking = threading.current_thread()
        self.halted = threading.Event()
        self.halts: list[threading.Thread] = []

    def feed(self, data: bytes) -> list[bytes]:
        if data == b"\\\r":
            self.halted.set()
            return [b":N-21\r\n"]
        return [b":A 222\r\n"] if len(self.halts) == 5 else []

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if threading.current_thread() is self.asking and len(self.halts) < 5 and self.link._conversation.locked():
            self.halted.clear()
            self.halts.append(threading.Thread(target=self.link.interrupt, args=[asi.halt()]))
            self.halts[-1].start()
            assert self.halted.wait(10)


def test_a_question_that_halts_broke_into_is_asked_until_it_is_answered():
    controller = Interrupted()
    assert controller.link.ask(asi.where()) == 222
    for halt in controller.halts:
        halt.join(10)
    assert len(controller.halts) == 5
    assert controller.link.position_known


@given(st.binary(max_size=30))
def test_any_bytes_decode_or_raise_an_error_of_ours(reply: bytes):
    requests = [
        asi.move(1), asi.move_by(1), asi.where(), asi.is_moving(), asi.status_byte(), asi.halt(), asi.here(0),
        asi.set_speed(1), asi.speed(), *asi.set_limits(-1, 1), *asi.limits(), asi.units_per_mm(), asi.version(),
    ]  # fmt: skip
    for request in requests:
        try:
            request.decode(reply)
        except (MalformedReply, Refused):
            continue


@given(st.lists(st.integers(1, 9), max_size=8), st.integers(-99999, 99999))
def test_a_reply_may_come_in_pieces(cuts: list[int], position: int):
    clock = SteppingClock()
    peer = LatePeer(clock)
    rest, delay_s = f":A {position} \r\n".encode(), 0.001
    pieces = []
    for cut in [*cuts, 99]:
        pieces.append((delay_s, rest[:cut]))
        rest, delay_s = rest[cut:], delay_s + 0.001
    peer.write = lambda data: peer.under_way.extend(pieces)
    assert Link(peer, clock, terminator=asi.TERMINATOR).ask(asi.where()) == position


@given(exchanges=st.lists(st.tuples(st.binary(min_size=1, max_size=9), st.binary(min_size=1, max_size=9)), max_size=5))
def test_any_bytes_are_recorded_and_replayed(tmp_path_factory: pytest.TempPathFactory, exchanges: list):
    path = tmp_path_factory.mktemp("transcript") / "any.jsonl"
    clock = SteppingClock()
    replies = iter([reply for _, reply in exchanges])
    recorder = Recorder(Loopback(lambda data: [next(replies)], clock), path, clock)
    for sent, reply in exchanges:
        recorder.write(sent)
        assert recorder.read(0.1) == reply
    recorder.close()
    replay = Replay(path, clock)
    for sent, reply in exchanges:
        replay.write(sent)
        assert replay.read(0.1) == reply
    assert replay.read(0.1) == b""


@given(st.floats(-1e5, 1e5), st.sampled_from(["{:.0f}", "{:.1f}", "{:+.6f}"]), st.sampled_from(["", " "]))
def test_a_position_is_read_as_it_was_written(position: float, form: str, end: str):
    text = form.format(position)
    assert asi.where().decode(f":A {text}{end}".encode()) == float(text)


@pytest.mark.parametrize(
    ("request_", "payload", "reply", "meaning"),
    [
        (asi.move(1234), b"M Z=1234.000\r", b":A ", None),
        (asi.move_by(-234), b"R Z=-234.000\r", b":A", None),
        (asi.where(), b"W Z\r", b":A 1234 ", 1234.0),
        (asi.where(), b"W Z\r", b":A 1234.5 ", 1234.5),
        (asi.is_moving(), b"/\r", b"N", False),
        (asi.is_moving(), b"/\r", b"B", True),
        (asi.status_byte(), b"RS Z\r", b":A 10", 10),
        (asi.halt(), b"\\\r", b":A ", None),
        (asi.halt(), b"\\\r", b":N-21", None),
        (asi.here(0), b"H Z=0.000\r", b":A ", None),
        (asi.set_speed(1.5), b"S Z=1.500000\r", b":A ", None),
        (asi.speed(), b"S Z?\r", b":A Z=1.500000", 1.5),
        (asi.units_per_mm(), b"UM Z?\r", b":Z=10000 A", 10000.0),
        (asi.limits()[0], b"SL Z?\r", b":A Z=-5.000", -5.0),
        (asi.set_limits(-5, 5)[1], b"SU Z=5.000000\r", b":A ", None),
        (asi.version(), b"V\r", b":A Version: USB-9.54 ", "Version: USB-9.54"),
    ],
)
def test_the_documented_exchanges(request_: Request, payload: bytes, reply: bytes, meaning: object):
    assert request_.payload == payload
    assert request_.decode(reply) == meaning


def test_a_command_without_reply_and_a_timeout_of_its_own():
    link, peer = link_to((9.0, b""), (0.8, b":A 5 \r\n"))
    assert link.ask(Request(b"S\r", bytes, framing=no_reply)) == b""
    assert link.ask(Request(b"Q\r", asi.where().decode, repeatable=False, timeout_s=1.0)) == 5
    assert peer.sent == [b"S\r", b"Q\r"]


def test_a_move_is_not_sent_again_after_a_halt():
    stuck = Stuck()
    link = Link(Loopback(stuck.feed, stuck), stuck, terminator=asi.TERMINATOR)
    sent: list[bytes] = []
    codes: list[str] = []

    def feed(data: bytes) -> list[bytes]:
        sent.append(data)
        return stuck.feed(data)

    link._transport = Loopback(feed, stuck)

    def ask() -> None:
        try:
            link.ask(Request(b"M Z=5\r", asi.move(5).decode, moves=True))
        except DeviceError as error:
            codes.append(error.code)

    asking = threading.Thread(target=ask)
    asking.start()
    assert stuck.asked.wait(10)
    link.interrupt(asi.halt())
    asking.join(10)
    assert codes == ["device-halted"]
    assert sent.count(b"M Z=5\r") == 1


def test_a_port_closed_by_another_thread_is_a_lost_link():
    master, slave = pty.openpty()
    with closing(os.fdopen(master, "rb")), closing(os.fdopen(slave, "rb")):
        port = SerialPort(os.ttyname(slave), 115200, device="z stage")
        port.close()
        for use in (lambda: port.read(0), lambda: port.read(0.01), lambda: port.write(b"W Z\r")):
            with pytest.raises(LinkLost, match="z stage"):
                use()
