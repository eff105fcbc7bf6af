"""The ring between processes: readers that are lapped, killed or simply leave, and a writer that is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from acquire.frame import FrameHeader
from acquire.ring import RingFull, RingReader, RingWriter, WriterGone, sweep_stale
from devices.clock import SystemClock

SHAPE = (128, 128)
HEADER = FrameHeader(plane=3, setpoint_um=1.5, z_um=1.48, exposure_ms=20.0)

READ_TO_THE_END = """
import json, sys
from pathlib import Path
from acquire.ring import RingReader, WriterGone
from devices.clock import SystemClock

reader = RingReader.attach(Path(sys.argv[1]), sys.argv[2], clock=SystemClock())
numbers, torn_accepted = [], 0
print("ready", flush=True)
try:
    while True:
        if frame := reader.read(30.0):
            numbers.append(frame.number)
            torn_accepted += bool((frame.pixels != frame.number % 65536).any())
except WriterGone:
    print(json.dumps({"received": reader.received, "lost": reader.lost, "torn_accepted": torn_accepted,
        "ordered": numbers == sorted(set(numbers)), "last": numbers[-1]}), flush=True)
"""

READ_ONE_AND_WAIT = """
import os, sys
from pathlib import Path
from acquire.ring import RingReader
from devices.clock import SystemClock

reader = RingReader.attach(Path(sys.argv[1]), sys.argv[2], clock=SystemClock())
print("ready", flush=True)
frame = reader.read(30.0)
print(frame.number, flush=True)
sys.stdin.readline()
"""

WRITE_FIVE_AND_DIE_IN_THE_SIXTH = """
import subprocess, sys
from pathlib import Path
import numpy as np
from acquire.frame import FrameHeader
from acquire.ring import RingWriter
from devices.clock import SystemClock

writer = RingWriter.create("dying", (128, 128), "uint16", 8, clock=SystemClock(), folder=Path(sys.argv[1]))
print(writer.path, flush=True)
sys.stdin.readline()
heir = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"])  # outlives its parent
for plane in range(5):
    writer.push(np.full((128, 128), plane, np.uint16), FrameHeader(plane, 0.0, 0.0, 1.0))
with writer.slot() as slot:
    slot.pixels[:64] = 999
    print("half", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def spawn():
    """Start a Python program, talk to it by lines; whatever happens, it is gone afterwards."""
    children = []

    def spawn(program, *arguments):
        command = [sys.executable, "-c", program, *map(str, arguments)]
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        children.append(child)
        return child

    yield spawn
    for child in children:
        child.kill()
        child.communicate()


@pytest.fixture
def writer(tmp_path):
    with RingWriter.create("stress", SHAPE, "uint16", 3, clock=SystemClock(), folder=tmp_path) as writer:
        yield writer


def kill(child):
    """Kill -9 and wait for the death, without burying: a zombie is dead too."""
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)


def publish(writer, count):
    for _ in range(count):
        with writer.slot(timeout_s=30.0) as slot:
            slot.pixels.fill(writer.published % 65536)
            slot.publish(HEADER)


def run_readers(spawn, writer, kinds, frames):
    """Publish to readers in processes of their own and return what each saw in the end."""
    children = [spawn(READ_TO_THE_END, writer.path, kind) for kind in kinds]
    assert all(child.stdout.readline() == "ready\n" for child in children)
    publish(writer, frames)
    writer.close()
    return [json.loads(child.stdout.readline()) for child in children]


def test_four_lapped_readers_account_for_every_frame_and_accept_none_torn(spawn, writer):
    frames = 20_000
    results = run_readers(spawn, writer, ["latest"] * 4, frames)
    assert [r["received"] + r["lost"] for r in results] == [frames] * 4
    assert [r["torn_accepted"] for r in results] == [0] * 4
    assert all(r["ordered"] for r in results)
    assert all(r["last"] == frames - 1 for r in results)
    assert min(r["lost"] for r in results) > 0, "nobody was lapped: this run proved nothing"


def test_lossless_readers_hold_the_writer_and_miss_nothing(spawn, writer):
    frames = 1000
    results = run_readers(spawn, writer, ["lossless", "lossless", "latest"], frames)
    assert [(r["received"], r["lost"]) for r in results[:2]] == [(frames, 0)] * 2
    assert results[2]["received"] + results[2]["lost"] == frames
    assert [r["torn_accepted"] for r in results] == [0] * 3
    assert writer.refused == 0


def test_a_lossless_reader_may_join_and_leave_at_full_speed(writer):
    enough = threading.Event()

    def write():
        while not enough.is_set():
            publish(writer, 1)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(200):
            with RingReader.attach(writer.path, "lossless", clock=SystemClock()) as reader:
                frames = [(frame.number, int(frame.pixels.min())) for frame in (reader.read(30.0) for _ in range(4))]
            first = frames[0][0]
            assert frames == [(number, number % 65536) for number in range(first, first + 4)]
    finally:
        enough.set()
        thread.join()


def test_a_killed_lossless_reader_holds_its_claim_until_it_is_detached(spawn, writer):
    child = spawn(READ_ONE_AND_WAIT, writer.path, "lossless")
    assert child.stdout.readline() == "ready\n"
    publish(writer, 3)
    assert child.stdout.readline() == "0\n"
    assert writer.detach_dead() == ()
    kill(child)
    with pytest.raises(RingFull, match="no free place") as caught:
        writer.push(np.zeros(SHAPE, np.uint16), HEADER, timeout_s=0)
    assert f"process {child.pid} still needs frame 0 on; it died" in caught.value.why
    with RingReader.attach(writer.path, "lossless", clock=SystemClock()):
        assert [status.pid for status in writer.readers()] == [child.pid, os.getpid()]
    (status,) = writer.detach_dead()
    assert (status.pid, status.kind, status.cursor, status.alive) == (child.pid, "lossless", 0, False)
    assert writer.readers() == ()
    publish(writer, 3)
    assert (writer.published, writer.refused) == (6, 1)


def test_a_stopped_reader_is_alive(spawn, writer):
    child = spawn(READ_ONE_AND_WAIT, writer.path, "lossless")
    assert child.stdout.readline() == "ready\n"
    child.send_signal(signal.SIGSTOP)
    publish(writer, 3)
    with pytest.raises(RingFull) as caught:
        writer.push(np.zeros(SHAPE, np.uint16), HEADER, timeout_s=0)
    assert "stands still" in caught.value.why
    assert writer.detach_dead() == ()


def test_a_reader_that_just_exits_takes_nothing_with_it(spawn, writer):
    mine = RingReader.attach(writer.path, "lossless", clock=SystemClock())
    child = spawn(READ_ONE_AND_WAIT, writer.path, "latest")
    assert child.stdout.readline() == "ready\n"
    publish(writer, 2)
    child.communicate("\n")
    assert child.returncode == 0
    assert writer.path.exists()
    assert [status.pid for status in writer.detach_dead()] == [child.pid]
    assert [status.pid for status in writer.readers()] == [os.getpid()]
    publish(writer, 1)
    assert [int(mine.read(0).pixels[0, 0]) for _ in range(3)] == [0, 1, 2]
    mine.close()


@pytest.mark.parametrize(("kind", "numbers"), [("lossless", [0, 1, 2, 3, 4]), ("latest", [4])])
def test_readers_survive_a_killed_writer_with_its_last_frames(spawn, tmp_path, kind, numbers):
    child = spawn(WRITE_FIVE_AND_DIE_IN_THE_SIXTH, tmp_path)
    path = type(tmp_path)(child.stdout.readline().strip())
    with RingReader.attach(path, kind, clock=SystemClock()) as reader:
        child.stdin.write("\n")
        child.stdin.flush()
        assert child.stdout.readline() == "half\n"
        assert sweep_stale(tmp_path) == ()
        kill(child)
        frames = [reader.read(0) for _ in numbers]
        assert [frame.number for frame in frames] == numbers
        assert (frames[-1].pixels == 4).all()
        with pytest.raises(WriterGone, match="after frame 4"):
            reader.read(2.0)
        assert sweep_stale(tmp_path) == (path,)
        assert reader.received + reader.lost == 5


def test_other_systems_get_one_clear_error(spawn):
    program = """
import sys
sys.platform = "win32"
from devices.errors import StoreError
try:
    import acquire.ring
except StoreError as error:
    print(error.code, flush=True)
"""
    assert spawn(program).stdout.readline() == "ring-platform\n"
