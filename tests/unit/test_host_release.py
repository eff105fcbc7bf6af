"""The release of a stop: it comes after the last word of every stop, which would halt what moves then."""

import threading

import pytest
from served import PATIENCE_S, SMALL_BENCH

from acquire import replies, requests
from acquire.host import Host
from devices.clock import SystemClock
from devices.rig import load_rig, open_rig

CLOCK = SystemClock()


class Unheard:
    """Telemetry nobody listens to."""

    def tell(self, topic, told):
        pass


class Slow:
    """A stage whose halts take until they are let go."""

    def __init__(self, stage):
        self.stage = stage
        self.halting, self.let_go = threading.Semaphore(0), threading.Semaphore(0)

    def halt(self):
        self.halting.release()
        assert self.let_go.acquire(timeout=PATIENCE_S)
        self.stage.halt()

    def __getattr__(self, name):
        return getattr(self.stage, name)


@pytest.fixture
def host(start_bench, tmp_path):
    small = tmp_path / "small.toml"
    small.write_text(SMALL_BENCH.replace('"small"', '"release"'))
    bench = start_bench(small)
    with open_rig(load_rig(bench.instrument), clock=CLOCK) as rig:
        rig.stage = Slow(rig.stage)
        host = Host(rig, Unheard(), CLOCK)
        yield host, rig.stage
        host.close()


def release(host):
    """Ask for the release; returns an event, and what will hold the answer once it is set."""
    answered, answers = threading.Event(), []
    host.put(requests.ClearStop(), 60_000, lambda answer: (answers.append(answer), answered.set()))
    return answered, answers


def stop(host):
    stopping = threading.Thread(target=host.stop_all)
    stopping.start()
    return stopping


def test_it_waits_for_a_stop_under_way(host):
    host, stage = host
    stopping = stop(host)
    assert stage.halting.acquire(timeout=PATIENCE_S)
    answered, answers = release(host)
    assert not answered.wait(0.3)
    for _ in range(10):
        stage.let_go.release()
    assert answered.wait(PATIENCE_S)
    stopping.join(PATIENCE_S)
    assert isinstance(answers[0], replies.Done)
    assert not host.now().stopped


def test_a_stop_that_comes_meanwhile_stays(host):
    host, stage = host
    stops = [stop(host)]
    assert stage.halting.acquire(timeout=PATIENCE_S)
    answered, answers = release(host)
    while not host._lanes["motion"].busy:
        CLOCK.sleep(0.001)
    stops.append(stop(host))
    assert stage.halting.acquire(timeout=PATIENCE_S)
    for _ in range(30):
        stage.let_go.release()
    assert answered.wait(PATIENCE_S)
    for each in stops:
        each.join(PATIENCE_S)
    assert answers[0].code == "serve-stopped"
    assert host.now().stopped
