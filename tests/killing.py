"""Runs that are killed anywhere: a world of twins that outlives them, and children that die at a numbered instant.

Every exchange with a device, every plane on its way to the disk and every record of the journal makes instants, before
and after, and for a record one with half of its line written. A child given the number of one kills itself there with
signal 9. Time is simulated by the world, so that a run costs what it computes. The world and the children are forks of
one process, the stable, which has everything imported: a kill and its resume take a fraction of a second.

Started as a program it is the stable; `Stable` drives it from a test.
"""

from __future__ import annotations

import gc
import importlib
import json
import mmap
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import Client, Listener
from pathlib import Path

WIRE, PLANE, RECORD = "wire", "plane", "record"
AWAY_S = 30.0
SIDE = (16, 24)
# The twin's port in this process takes frames of a serial line; short ways keep the looks at moving devices few.
CHANGES = ('microtome.link="rtu"', "stage.z.park_um=-10.0")


class SharedClock:
    """Simulated time that the world and all children share: a number in memory they inherited."""

    def __init__(self):
        self._seconds = memoryview(mmap.mmap(-1, 8)).cast("d")
        self._seconds[0] = 100.0

    def now(self):
        return self._seconds[0]

    def sleep(self, seconds):
        self._seconds[0] += max(seconds, 0.0)


class World:
    """Stage, microtome and camera over one simulated clock; what the camera sees follows from what was cut and z."""

    def __init__(self, spec, clock):
        from sim.feed_line import build_feed_twin
        from sim.motion import Axis
        from sim.stages import stage_kind

        self.clock = clock
        self.axis = Axis(self.clock, spec.stage.z.soft_limits, speed_um_s=5000.0, ramp_s=0.005)
        self.stage = stage_kind(spec.stage.z.driver).make(self.axis, spec.stage.z)
        self.feed = build_feed_twin(spec.microtome, self.clock)
        self.feed.machine.home()
        self.clock.sleep(10.0)
        assert self.feed.machine.homed

    def do(self, what, *given):
        return getattr(self, f"_{what}")(*given)

    def _sleep(self, seconds):
        self.clock.sleep(seconds)

    def _stage(self, data):
        return self.stage.feed(data)

    def _feed(self, data):
        return [(reply.data, reply.delay_s) for reply in self.feed.feed_upset(data)]

    def _expose(self, exposure_ms):
        import numpy as np

        start_s = self.clock.now()
        removed_nm = round(1000 * sum(self.feed.machine.removed_um))
        seed = (removed_nm, round(self.axis.load_um(start_s) * 100) + 10**6)
        self.clock.sleep(exposure_ms / 1000)
        pixels = np.random.default_rng(seed).integers(0, 4096, SIDE).astype("<u2")
        return pixels.tobytes(), round(start_s * 1e9), round(self.clock.now() * 1e9)

    def _truth(self):
        return {**self.feed.counters(), "begun": self.feed.plc.knife.strokes_begun}


def serve_world(spec, clock, listener):
    """Answer one client after the other until one says that it is over; a client that dies is forgotten."""
    world = World(spec, clock)
    with listener:
        while True:
            with listener.accept() as client, suppress(EOFError, ConnectionError):
                while True:
                    what, *given = client.recv()
                    if what == "over":
                        return
                    if what == "anew":
                        world = World(spec, clock)
                    client.send(world.do(what, *given) if what != "anew" else None)


class Instants:
    """Counts what happens and kills this process at the ``nth`` instant of a label, or at the ``nth`` of all."""

    def __init__(self, label=None, nth=None):
        self._label, self._left, self.labels = label, nth, []

    def is_it(self, label):
        self.labels.append(label)
        if self._left is None or self._label not in (None, label):
            return False
        self._left -= 1
        return self._left == 0

    def __call__(self, label):
        if self.is_it(label):
            die()


def die():
    os.kill(os.getpid(), signal.SIGKILL)
    signal.pause()


class Far:
    """The world as a child reaches it."""

    def __init__(self, address, instants):
        self._line, self._lock, self._instants = Client(address, family="AF_UNIX"), threading.Lock(), instants

    def wire(self, what, *given):
        with self._lock:
            self._instants(f"{WIRE} before {what}")
            self._line.send((what, *given))
            self._instants(f"{WIRE} after {what}")
            return self._line.recv()


class FarCamera:
    """A camera over the world."""

    def __init__(self, far):
        self._far, self._sink, self._number = far, None, 0

    def caps(self):
        from devices.values import CameraCaps

        return CameraCaps("far", *SIDE, 1, "uint16", 12, timed=True)

    def configure(self, *, exposure_ms, roi=None):
        self._exposure_ms = exposure_ms

    def arm(self, frames, sink):
        self._sink = sink

    def trigger(self):
        import numpy as np

        from devices.values import FrameStamp

        data, start_ns, end_ns = self._far.wire("expose", self._exposure_ms)
        self._number += 1
        self._sink(np.frombuffer(data, "<u2").reshape(SIDE), FrameStamp(end_ns, self._number, start_ns, end_ns))

    def stop(self, timeout_s):
        self._sink = None

    def close(self):
        pass


def far_rig(spec, clock, far):
    """The instrument over the world's wires: the real drivers, the real link, the real Modbus client."""
    from feeds import TIMEOUT_S, TwinPort
    from pymodbus.client import ModbusSerialClient

    from devices.drivers.asi_triggered import AsiTriggeredStage
    from devices.drivers.feed import ModbusFeed
    from devices.link import Link
    from devices.rig import Rig
    from devices.transport.loopback import Loopback
    from devices.transport.modbus import ModbusBus
    from devices.wire import asi
    from sim.faults import Delayed

    class FarTwin:
        def feed_upset(self, data):
            return [Delayed(*reply) for reply in far.wire("feed", data)]

    def connect():
        client = ModbusSerialClient("far", baudrate=1_000_000, timeout=TIMEOUT_S, retries=0)
        client._recv_interval = 0
        client.socket = TwinPort(FarTwin())
        return client

    link = Link(Loopback(lambda data: far.wire("stage", data), clock), clock, terminator=asi.TERMINATOR)
    stage = AsiTriggeredStage(link, spec.stage.z, clock)
    profile = spec.microtome.feed_profile()
    bus = ModbusBus(connect, name="far", clock=clock, gap_s=0.0, exceptions=profile.exception_words())
    feed = ModbusFeed(bus, spec.microtome, clock)
    feed.identify()
    return Rig(spec, stage, FarCamera(far), feed)


def hook(instants, broken):
    """Put instants around planes and records; ``broken`` breaks the rules on purpose, as a control of the test."""
    from acquire import journal, removal, store

    append, write_all, write = journal.Journal.append, journal._write_all, store._PlaneFiles.write

    def torn(file, data):
        if instants.is_it(f"{RECORD} half"):
            os.write(file, data[: len(data) // 2])
            die()
        write_all(file, data)

    def appended(self, *events):
        name = events[0]["e"]
        instants(f"{RECORD} before {name}")
        append(self, *events)
        instants(f"{RECORD} after {name}")

    def written(self, slot, pixels):
        instants(f"{PLANE} before")
        write(self, slot, pixels)
        instants(f"{PLANE} after")

    journal._write_all, journal.Journal.append, store._PlaneFiles.write = torn, appended, written
    if broken == "blind-cut":
        removal.judge_cut = lambda *_: removal.Act.PENDING
    if broken == "record-first":
        store.RunStore.put = recorded_first


def recorded_first(self, frame):
    """Call a plane durable before it is written."""
    from dataclasses import replace

    from acquire.store import PlaneRecord, checksum

    self._pending.append(PlaneRecord(replace(frame.header, crc32=checksum(frame.pixels)), frame.pixels.nbytes))
    self.commit()
    self._files.write(self.layout.slot_of(frame.header), frame.pixels)


def child(spec, recipe, clock, address, task):
    """Take a run, or the rest of one, and say how it ended."""
    from acquire.resume import interrupted_run
    from acquire.session import Options, new_session, resumed_session

    instants = Instants(*task.get("kill_at") or ())
    far = Far(address, instants)
    hook(instants, task.get("broken"))
    folder, told = Path(task["folder"]), []
    options = Options(attended=False)
    rig = far_rig(spec, clock, far)
    if task["resume"]:
        session = resumed_session(interrupted_run(folder, None), rig, clock, told.append, options)
    else:
        session = new_session(recipe, rig, folder, clock, told.append, options)
    outcome = session.execute()
    said = "" if outcome.held is None else outcome.held.words
    said += "" if outcome.error is None else outcome.error.message()
    return {"state": str(outcome.state), "said": said, "labels": instants.labels}


def in_child(do, report):
    """Fork, do it there and write what it returned into a file; return the exit status."""
    pid = os.fork()
    if pid:
        return os.waitpid(pid, 0)[1]
    code = 1
    try:
        report.write_text(json.dumps(do()))
        code = 0
    except BaseException as error:  # noqa: BLE001  whatever it is, the test wants to read it
        report.write_text(json.dumps({"state": "raised", "said": repr(error), "labels": []}))
    finally:
        os._exit(code)


def import_everything():
    """Import what a child needs, once for all."""
    for name in ("acquire.session", "acquire.resume", "devices.drivers.asi_triggered", "devices.drivers.feed", "feeds"):
        importlib.import_module(name)


def stable(instrument, recipe, scratch):
    """Serve tasks, one JSON object a line."""
    from acquire.recipe import load_recipe
    from devices.rig import load_rig

    import_everything()
    spec, plan, clock = load_rig(instrument, CHANGES), load_recipe(recipe), SharedClock()
    gc.freeze()  # what all children share is not copied only because garbage is looked for
    address, report = f"\0stereotome-world-{os.getpid()}", scratch / "report"
    listener = Listener(address, family="AF_UNIX")
    world = os.fork()
    if not world:
        try:
            serve_world(spec, clock, listener)
        finally:
            os._exit(0)
    listener.close()
    for line in sys.stdin:
        task = json.loads(line)
        if task["do"] == "run":
            report.unlink(missing_ok=True)
            status = in_child(lambda: child(spec, plan, clock, address, task), report)  # noqa: B023  it is done before the next
            told = json.loads(report.read_text()) if report.exists() else {}
            told = {"killed": os.WIFSIGNALED(status), **told}
        else:
            told = {"told": asked(address, task["ask"])}
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()
    with suppress(ConnectionError, EOFError):
        asked(address, ["over"])
    os.waitpid(world, 0)


def asked(address, words):
    with Client(address, family="AF_UNIX") as line:
        line.send(tuple(words))
        return line.recv()


class Stable:
    """The stable as a test drives it."""

    def __init__(self, instrument, recipe, scratch):
        scratch.mkdir(parents=True, exist_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(instrument), str(recipe), str(scratch)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _do(self, **task):
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def run(self, folder, **task):
        """Start a run in a new world; returns whether it was killed, its state and its instants."""
        self._do(do="ask", ask=["anew"])
        return self._do(do="run", folder=str(folder), resume=False, **task)

    def go_on(self, folder, *, away_s=AWAY_S, **task):
        """Go on with a run after a while."""
        self._do(do="ask", ask=["sleep", away_s])
        return self._do(do="run", folder=str(folder), resume=True, **task)

    def truth(self):
        """What really happened to the block."""
        return self._do(do="ask", ask=["truth"])["told"]

    def close(self):
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    sys.path[:0] = [str(root), str(root / "tests")]
    stable(*map(Path, sys.argv[1:4]))
