"""The watchdog: the instrument process is killed or stopped while it moves the twin, and the motion ends."""

import os
import re
import signal
import subprocess
import threading

import pytest
from sections import BENCH, files, ready_rig
from served import PATIENCE_S, SMALL_BENCH, served
from wires import PROGRAM

from acquire import requests
from acquire.watchdog import BEAT, BYE, HALTED, READY, Watch, watch
from devices.clock import SystemClock
from sim.clock import SimClock

CLOCK = SystemClock()


def test_a_silence_is_told_once():
    clock = SimClock()
    watch = Watch(clock, dead_after_s=5.0)
    clock.sleep(4.9)
    assert not watch.silent()
    clock.sleep(0.1)
    assert watch.silent()
    clock.sleep(60.0)
    assert not watch.silent()


def test_beats_keep_it_quiet():
    clock = SimClock()
    watch = Watch(clock, dead_after_s=5.0)
    for _ in range(100):
        clock.sleep(4.9)
        assert not watch.silent()
        assert not watch.heard()


def test_one_that_wakes_is_halted_again_for_it_may_go_on_with_what_it_was_about():
    clock = SimClock()
    watch = Watch(clock, dead_after_s=5.0)
    clock.sleep(5.0)
    assert watch.silent()
    assert watch.heard()
    assert not watch.heard()
    clock.sleep(5.0)
    assert watch.silent()


class Pipes:
    """The watching loop in a thread, between two pipes."""

    def __init__(self, dead_after_s):
        self.beats, self.to = os.pipe()
        self.said, self.say = os.pipe()
        self.halts = threading.Semaphore(0)
        self.clock = SimClock()
        arguments = [self.beats, self.say, Watch(self.clock, dead_after_s), self.halts.release]
        self.thread = threading.Thread(target=watch, args=arguments)
        self.thread.start()
        assert os.read(self.said, 1) == READY

    def close(self):
        for file in (self.beats, self.said, self.say):
            os.close(file)


@pytest.fixture
def pipes():
    pipes = Pipes(dead_after_s=5.0)
    yield pipes
    pipes.close()


def test_a_death_halts_at_once(pipes):
    os.write(pipes.to, BEAT)
    os.close(pipes.to)
    assert pipes.halts.acquire(timeout=PATIENCE_S)
    pipes.thread.join(PATIENCE_S)
    assert not pipes.thread.is_alive()


def test_a_good_bye_halts_nothing(pipes):
    os.write(pipes.to, BEAT + BYE)
    pipes.thread.join(PATIENCE_S)
    assert not pipes.halts.acquire(blocking=False)
    os.close(pipes.to)


def test_a_hang_halts_and_the_woken_one_is_told(pipes):
    pipes.clock.sleep(5.0)
    assert pipes.halts.acquire(timeout=PATIENCE_S)
    assert os.read(pipes.said, 1) == HALTED
    os.write(pipes.to, BEAT)
    assert pipes.halts.acquire(timeout=PATIENCE_S)
    assert os.read(pipes.said, 1) == HALTED
    os.write(pipes.to, BYE)
    pipes.thread.join(PATIENCE_S)
    os.close(pipes.to)


def slowed(bench, path):
    """The instrument file of a bench with a stage that takes its time."""
    path.write_text(re.sub(r"speed_um_s *= *[0-9.]+", "speed_um_s = 4.0", bench.instrument.read_text(), count=1))
    return path


def eventually(condition):
    """Wait, generously, until something is so."""
    deadline = CLOCK.now() + PATIENCE_S
    while not condition():
        assert CLOCK.now() < deadline, "it never came"
        CLOCK.sleep(0.05)


@pytest.fixture
def moving(start_bench, tmp_path):
    """A stage on its long slow way, sent by an instrument process."""
    slow = tmp_path / "slow.toml"
    slow.write_text(SMALL_BENCH.replace('"small"', '"slow"'))
    bench = start_bench(slow)
    with served(slowed(bench, slow)) as server:
        client = server.client()
        client.command("ann", wait_s=PATIENCE_S)
        client.ask(requests.MoveStage(z_um=90.0))
        eventually(lambda: bench.ask(do="truth")["z_um"] > 0.2)
        yield server, client, bench
        client.close()


def assert_at_rest_on_the_way(bench):
    def rests():
        before = bench.ask(do="truth")["z_um"]
        CLOCK.sleep(0.3)
        return bench.ask(do="truth")["z_um"] == before

    eventually(rests)
    assert 0.2 < bench.ask(do="truth")["z_um"] < 85.0


def test_kill_9_during_a_move_stops_the_stage(moving):
    server, _, bench = moving
    server.process.send_signal(signal.SIGKILL)
    assert_at_rest_on_the_way(bench)


def test_a_stopped_process_is_given_up_and_moves_nothing_when_it_wakes_until_it_is_released(moving):
    server, client, bench = moving
    server.process.send_signal(signal.SIGSTOP)
    assert_at_rest_on_the_way(bench)
    rest_um = bench.ask(do="truth")["z_um"]
    server.process.send_signal(signal.SIGCONT)
    state = client.wait_for(lambda state: state.stopped, PATIENCE_S)
    assert "its watchdog stopped all motion" in state.why_stopped
    assert bench.ask(do="truth")["z_um"] == pytest.approx(rest_um, abs=1.0)
    client.clear_stop()
    assert client.jog(2.0) == pytest.approx(rest_um + 2.0, abs=1.5)  # its last halt was before the release, not now
    state = client.refresh()
    assert (state.stopped, state.why_stopped) == (False, "")


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGSTOP])
def test_a_run_at_a_microtome_is_watched_without_a_server(start_bench, tmp_path, signum):
    instrument, recipe = files(tmp_path, BENCH.replace("park_um = -90.0", "park_um = 90.0"))
    bench = start_bench(instrument)
    command = [*PROGRAM, "run", recipe, "-i", slowed(bench, tmp_path / "slow.toml"), "--out", tmp_path / "run", "--yes"]
    with ready_rig(bench):
        pass
    with subprocess.Popen(list(map(str, command)), stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        eventually(lambda: bench.ask(do="truth")["z_um"] > 0.2)
        process.send_signal(signum)
        assert_at_rest_on_the_way(bench)
        process.kill()
