"""An instrument that is gone, slow, of another version or back: the console says so, waits not, and finds it again."""

import threading
from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs

from acquire import replies, requests
from acquire.frame import FrameHeader
from acquire.meeting import ServerGone
from acquire.ring import RingWriter
from devices.clock import SystemClock
from devices.errors import DeviceBusy, StereotomeError
from display.console import bench as under_test
from display.console.bench import Bench
from display.console.eyes import Eyes
from display.console.journal import Journal

PATIENCE_S = 60.0
STATE = replies.State(
    state="IDLE", z_um=0.0, z_age_s=0.0, live=False, exposure_ms=1.0, ring="", camera="", holder="", stopped=False
)


class FakeInstrument:
    """Answers nothing by itself."""

    welcome = SimpleNamespace(instrument="fake")

    def __init__(self, *, busy=False):
        self.silent_s, self.commands, self.told, self.busy = 0.0, False, STATE, busy
        self.asked, self.closed = [], False

    def instrument(self):
        return None

    def listen(self, listener):
        self.listener = listener

    def refresh(self):
        return STATE

    def command(self, actor):
        if self.busy:
            raise DeviceBusy("ann commands.", code="lease-held")
        self.commands = True

    def ask(self, request):
        self.asked.append((request, Future()))
        return self.asked[-1][1]

    def close(self):
        self.closed = True


class Connecting:
    """Gives one thing after the other: an instrument, or an error to raise; the last for ever."""

    def __init__(self, *outcomes):
        self.outcomes = list(outcomes)

    def __call__(self):
        outcome = self.outcomes.pop(0) if len(self.outcomes) > 1 else self.outcomes[0]
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


@pytest.fixture
def start(monkeypatch):
    monkeypatch.setattr(under_test, "AGAIN_S", 0.005)
    started = []

    def start(*outcomes):
        journal = Journal()
        started.append(Bench(Connecting(*outcomes), journal))
        return started[-1], journal

    yield start
    for bench in started:
        bench.close()


def until(wanted):
    clock = SystemClock()
    deadline = clock.now() + PATIENCE_S
    while not wanted():
        assert clock.now() < deadline, "it did not come"
        clock.sleep(0.002)


def words(journal, level="info"):
    return [line.words for line in journal.lines(level)]


def test_who_is_not_there_is_told_once_and_found_when_there(start):
    there = FakeInstrument()
    bench, journal = start(*[ServerGone("nobody serves here.")] * 4, there)
    until(lambda: bench.commands)
    assert words(journal)[:2] == ["nobody serves here.", "connected to fake"]
    assert bench.connected


def test_one_that_falls_silent_is_told_as_an_error_and_met_again_when_back(start):
    first, second = FakeInstrument(), FakeInstrument()
    bench, journal = start(first, ServerGone("nobody serves here."), second)
    until(lambda: bench.commands)
    first.silent_s = 10.0
    assert not bench.connected
    until(lambda: second.commands)
    assert first.closed
    assert any("fell silent" in said for said in words(journal, "error"))
    assert bench.connected


def test_another_version_is_named_and_nothing_is_shown_of_it(start):
    bench, journal = start(StereotomeError("it speaks version 9, this program speaks 1.", code="serve-version"))
    until(lambda: words(journal))
    assert words(journal) == ["it speaks version 9, this program speaks 1."]
    assert (bench.state, bench.connected, bench.ring) == (None, False, "")


def test_somebody_else_commands_and_gives_it_back(start):
    there = FakeInstrument(busy=True)
    bench, journal = start(there)
    until(lambda: "ann commands." in words(journal, "warning"))
    assert not bench.commands
    there.busy = False
    until(lambda: bench.commands)


def test_a_slow_instrument_holds_up_neither_questions_nor_stop(start):
    there, answers = FakeInstrument(), []
    bench, journal = start(there)
    until(lambda: bench.commands)
    bench.ask(requests.Snap(), "camera", answers.append)
    bench.stop()  # returns though nothing was answered
    assert [type(request) for request, _ in there.asked] == [requests.Snap, requests.Stop]
    assert bench.stop_asked
    bench.settle()
    assert answers == []
    there.asked[1][1].set_result(replies.Stopped(told=("z stage",)))
    there.asked[0][1].set_exception(DeviceBusy("a run has the devices.", code="run-active"))
    bench.settle()
    assert not bench.stop_asked
    assert answers[0].code == "run-active"
    assert "stopped: z stage" in words(journal, "warning")


def test_without_an_instrument_a_stop_says_where_to_stop(start):
    bench, journal = start(ServerGone("nobody serves here."))
    bench.stop()
    assert any("stop it at the hardware" in said for said in words(journal, "error"))
    answers = []
    bench.ask(requests.Snap(), "camera", answers.append)
    bench.settle()
    assert isinstance(answers[0], ServerGone)


def test_a_stop_that_got_no_answer_is_sent_again_to_the_instrument_once_it_is_back(start):
    silent, back = FakeInstrument(), FakeInstrument()
    bench, _ = start(silent, back)
    until(lambda: bench.connected)
    bench.stop()
    silent.silent_s = 99.0
    until(lambda: back.asked)
    assert type(back.asked[0][0]) is requests.Stop
    back.asked[0][1].set_result(replies.Stopped(told=("z stage",), failed=()))
    until(lambda: bench.settle() or not bench.stop_asked)


def test_why_it_stopped_is_an_error_told_once_where_nobody_asked_for_it(start):
    there = FakeInstrument()
    bench, journal = start(there)
    until(lambda: bench.commands)
    for state in (STATE, *[structs.replace(STATE, stopped=True, why_stopped="it stood still.")] * 2):
        there.listener(state)
    assert words(journal, "error") == ["it stood still."]


def test_only_news_wake_the_window(start):
    there, woken = FakeInstrument(), []
    bench, _ = start(there)
    until(lambda: bench.commands)
    bench.wake = lambda: woken.append(1)
    from msgspec import structs

    for state in (
        STATE,
        structs.replace(STATE, z_age_s=3.0, utc_ns=5),
        structs.replace(STATE, z_um=1.0),
        structs.replace(STATE, z_um=1.0, utc_ns=9),
    ):
        there.listener(state)
    assert len(woken) == 2


def test_eyes_follow_from_ring_to_ring_of_another_size_and_depth(tmp_path):
    where = [""]
    eyes = Eyes(lambda: where[0], lambda: 255)
    try:
        for number, (shape, dtype) in enumerate([((20, 30), "uint16"), ((8, 12), "uint8"), ((20, 30, 3), "uint8")]):
            with RingWriter.create(f"r{number}", shape, dtype, 4, clock=SystemClock(), folder=tmp_path) as ring:
                where[0] = str(ring.path)
                header = FrameHeader(plane=0, setpoint_um=1.0, z_um=1.0, exposure_ms=2.0)
                ring.push(np.full(shape, np.iinfo(dtype).max, dtype), header, timeout_s=0)
                until(lambda shape=shape: eyes.seen is not None and eyes.seen.pixels.shape == shape)
                assert eyes.seen.pixels.dtype == dtype
                assert eyes.seen.over == 1.0
    finally:
        eyes.close()
    assert not any(thread.name == "eyes" for thread in threading.enumerate())


@pytest.mark.parametrize(("pid", "afar"), [(123, False), (0, True)])
def test_only_an_instrument_named_by_its_address_is_seen_from_afar(tmp_path, pid, afar):
    previews = SimpleNamespace(newest=lambda: None, close=lambda: None)
    instrument = SimpleNamespace(meeting=SimpleNamespace(pid=pid), previews=lambda: previews)
    asked = []

    def there():
        asked.append(1)
        return instrument

    # the ring it names is just gone, or on another computer
    eyes = Eyes(lambda: str(tmp_path / "gone"), lambda: 255, instrument=there)
    try:
        until(lambda: len(asked) > 5)
        assert eyes.afar == afar
    finally:
        eyes.close()
