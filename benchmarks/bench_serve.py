"""What it costs to be served: how soon a stop is on the wire, and what those who look on cost a run.

Run: ``nice python benchmarks/bench_serve.py [--seconds 60]``. Costs are CPU seconds, as ratios within the same run,
with and without viewers in turns. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from acquire import requests
from acquire.client import Instrument
from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.preview import preview
from acquire.recorder import Recorder, ring_slots
from acquire.ring import RingWriter, shared_memory_folder
from acquire.store import RunEnd, RunStore, free_bytes, open_run
from acquire.viewer import RingViewer
from devices.clock import SystemClock

CLOCK = SystemClock()
PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]
STOPS = 30
HALT = "\\"  # how an ASI is halted
SERIES = {"512² at 200/s": ((512, 512), 200), "2048² at 30/s": ((2048, 2048), 30)}


def main() -> int:
    """Measure everything, print it, and say whether the limits are kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    rows = [*stop_latency(), *viewer_cost(), *picture_cost()]
    for name, (shape, rate_hz) in SERIES.items():
        rows += series(name, shape, rate_hz, seconds)
    print(f"{'what':<66} {'measured':>10}  limit")
    for name, value, limit in rows:
        print(f"{name:<66} {value:>10.4g}  {limit}{'' if kept(value, limit) else '  MISSED'}")
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    print(json.dumps({"benchmark": "serve", **machine, **{name: value for name, value, _ in rows}}))
    return 0 if all(kept(value, limit) for _, value, limit in rows) else 1


def kept(value, limit):
    """Return whether a value keeps a limit written as ``<= 50``; an empty limit is always kept."""
    if not limit:
        return True
    relation, number = limit.split()
    return {"<=": value <= float(number), "==": value == float(number)}[relation]


def stop_latency():
    """From the call of `Instrument.stop` in another process to the halt on the stage's line, while it moves."""
    with tempfile.TemporaryDirectory(prefix="st-") as folder, served(Path(folder)) as instrument:
        instrument.command("bench")
        late_ms = [stop_once(instrument, Path(folder) / "wire" / "stage-z.jsonl", k) for k in range(STOPS)]
    return [
        ("stop: call to the wire, median of 30, ms", statistics.median(late_ms), "<= 50"),
        ("stop: call to the wire, worst of 30, ms", max(late_ms), "<= 50"),
    ]


def stop_once(instrument, wire, k):
    instrument.clear_stop()
    moving = instrument.ask(requests.MoveStage(z_um=150.0 if k % 2 else -150.0))
    time.sleep(0.02 + 0.003 * k)
    seen = len(wire.read_text().splitlines())
    called_s = time.monotonic()
    instrument.stop()
    moving.exception(30.0)
    lines = [json.loads(line) for line in wire.read_text().splitlines()[seen:]]
    halts_s = [line["t"] for line in lines if line["to"] == "device" and line["bytes"].startswith(HALT)]
    return (halts_s[0] - called_s) * 1000


@contextmanager
def served(folder):
    command = [*PROGRAM, "serve", "--sim", "--transcript", str(folder / "wire"), "--set", "stage.z.speed_um_s=200.0"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        told = json.loads(process.stdout.readline())
        try:
            with Instrument.connect(Path(told["connection"])) as instrument:
                yield instrument
        finally:
            process.terminate()


def viewer_cost():
    """CPU time of the acquiring process for the same frames at a camera's rate, with three viewers and without."""
    with ExitStack() as stack:
        rings = [stack.enter_context(RingWriter.create("bench", (512, 512), "uint16", 32, clock=CLOCK)) for _ in "ab"]
        for _ in range(3):
            stack.enter_context(viewer(rings[1].path, asleep=False))
        costs = [[push_cost(ring) for ring in rings] for _ in range(9)]
    alone, watched = (statistics.median(spent) for spent in zip(*costs, strict=True))
    return [("512² at 200/s into the ring: CPU with three viewers / without", watched / alone, "<= 1.1")]


def push_cost(ring, frames=200):
    pixels = np.zeros((512, 512), np.uint16)
    start_cpu_s = time.process_time()
    for k in range(frames):
        ring.push(pixels, FrameHeader(plane=k, setpoint_um=0.0, z_um=0.0, exposure_ms=1.0))
        time.sleep(0.005)
    return time.process_time() - start_cpu_s


def picture_cost():
    """CPU time of one small JPEG beside one copy of the frame."""
    pixels = np.random.default_rng(1).integers(0, 4096, (2048, 2048), np.uint16)
    frame = Frame(0, FrameHeader(plane=0, setpoint_um=0.0, z_um=0.0, exposure_ms=1.0), pixels)
    spent = []
    for _ in range(10):
        start = time.process_time()
        preview(frame)
        spent.append(time.process_time() - start)
    return [("one preview of a frame of 2048², CPU ms", statistics.median(spent) * 1000, "")]


def series(name, shape, rate_hz, seconds):
    """Frames at a camera's rate to the disk, with a viewer attached and one that sleeps."""
    pixels = np.random.default_rng(2).poisson(900, shape).astype(np.uint16)
    done = record(pixels, rate_hz, seconds, viewers=2)
    return [
        (f"{name}, {seconds:g} s, two viewers, one asleep: frames lost", done.lost, "== 0"),
        (f"{name}: latest frame behind its time, ms", done.late_ms, ""),
    ]


class Done:
    """What a recording lost, and how far it fell behind."""

    def __init__(self, lost, late_ms):
        self.lost, self.late_ms = lost, late_ms


def record(pixels, rate_hz, seconds, viewers):
    """Push frames at a rate through ring and store, as the engine does, while others look on."""
    frames = round(rate_hz * seconds)
    with tempfile.TemporaryDirectory(prefix="st-", dir=os.environ.get("BENCH_DIR")) as folder, ExitStack() as stack:
        slots = ring_slots(pixels.nbytes, free_bytes(shared_memory_folder()))
        ring = RingWriter.create("bench", pixels.shape, "uint16", slots, clock=CLOCK)
        layout = FocalArray(
            planned=frames,
            shape=pixels.shape,
            dtype="uint16",
            start_um=0.0,
            step_um=1.0,
            pixel_um=None,
            compression="none",
        )
        store = RunStore.create(Path(folder) / "run", {"name": "bench", "plan_id": "bench"}, layout, CLOCK)
        recorder = Recorder(store, ring, CLOCK)
        for number in range(viewers):
            stack.enter_context(viewer(ring.path, asleep=number == 0))
        start_s, worst_s = time.monotonic(), 0.0
        for k in range(frames):
            due_s = start_s + k / rate_hz
            time.sleep(max(0.0, due_s - time.monotonic()))
            recorder.put(pixels, FrameHeader(plane=k, setpoint_um=0.0, z_um=0.0, exposure_ms=1.0))
            worst_s = max(worst_s, time.monotonic() - due_s)
        recorder.finish(RunEnd.COMPLETED)
        return Done(frames - len(open_run(Path(folder) / "run").planes), worst_s * 1000)


@contextmanager
def viewer(path, *, asleep):
    """Look at a ring in a process of its own until it ends; one ``asleep`` sleeps ten seconds after its first frame."""
    command = [sys.executable, __file__, "viewer", str(path), str(int(asleep))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        try:
            yield
        finally:
            child.kill()


def look(path, asleep):
    with RingViewer(lambda: path, CLOCK) as ring:
        ring.newest(0)
        print("ready", flush=True)
        while True:
            if ring.newest(1.0) is not None and asleep:
                time.sleep(10.0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["viewer"]:
        look(sys.argv[2], bool(int(sys.argv[3])))
    sys.exit(main())
