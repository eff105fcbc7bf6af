"""What it costs to be served: how soon a stop is on the wire, and what those who look on cost a run.

Run: ``nice python benchmarks/bench_serve.py [--seconds 60] [--only series]``. Costs are CPU seconds, as ratios within
the same run, with and without viewers in turns. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from acquire import requests
from acquire.client import Instrument
from acquire.engine import Run
from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray, sync_folder
from acquire.plan import StackPlan
from acquire.preview import preview
from acquire.recorder import Recorder, ring_slots
from acquire.ring import RingWriter, shared_memory_folder
from acquire.run_plan import RunPlan, SeriesPlan
from acquire.store import RunStore, free_bytes, open_run
from acquire.taker import CAMERA_STOP_S
from acquire.viewer import RingViewer
from devices.clock import SystemClock
from devices.values import CameraCaps, FrameStamp, Limits
from sim.motion import Axis
from sim.stage import SimStage

CLOCK = SystemClock()
PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]
STOPS = 30
LEAST_SHARE = 0.2
HALT = "\\"  # how an ASI is halted
SERIES = {"512² at 200/s": ((512, 512), 200), "2048² at 30/s": ((2048, 2048), 30)}


def main() -> int:
    """Measure everything, print it, and say whether the limits are kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=["series", "rest"])
    asked = parser.parse_args()
    rows = [] if asked.only == "series" else [*stop_latency(), *viewer_cost(), *picture_cost()]
    for name, (shape, rate_hz) in SERIES.items() if asked.only != "rest" else ():
        rows += series(name, shape, rate_hz, asked.seconds)
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
    """A run at a camera's rate, the whole way to the disk, with a viewer attached and one that sleeps.

    Where frames are lost the rate is halved until none are: the figure then says by how much the machine is too slow.
    """
    pixels = np.random.default_rng(2).poisson(900, shape).astype(np.uint16)
    rows, share = [], 1.0
    while True:
        with tempfile.TemporaryDirectory(prefix="st-", dir=os.environ.get("BENCH_DIR")) as folder:
            files_per_s = plain_files_per_s(Path(folder), pixels)
            lost, late_ms, cores = record(pixels, rate_hz * share, seconds, Path(folder) / "run", viewers=2)
        what = f"{name}, rate x {share:g}, {seconds:g} s"
        rows += [
            (f"{what}: lost of {round(rate_hz * share * seconds)}", lost, "== 0" if share == 1 else ""),
            (f"{what}: camera kept waiting at most, ms", late_ms, ""),
            (f"{what}: cores at work", cores, ""),
            (f"{what}: frames over plain files with fsync", rate_hz * share / files_per_s, ""),
        ]
        if not lost or share < LEAST_SHARE:
            return rows
        share /= 2


def plain_files_per_s(folder, pixels, seconds=2.0):
    """Frames a second that one thread writes, each to a file in a folder of its own, both synced."""
    begin_s, frames = CLOCK.now(), 0
    while CLOCK.now() - begin_s < seconds:
        place = folder / f"plain-{frames}"
        place.mkdir()
        with (place / "0").open("wb", buffering=0) as file:
            file.write(pixels.data)
            os.fsync(file.fileno())
        sync_folder(place)
        frames += 1
    rate = frames / (CLOCK.now() - begin_s)
    for place in folder.glob("plain-*"):
        shutil.rmtree(place)
    return rate


class Camera:
    """Gives frames at its rate, whoever takes them: what does not fit into its few buffers meanwhile is lost."""

    BUFFERS = 4

    def __init__(self, pixels, rate_hz):
        self._pixels, self._rate_hz = pixels, rate_hz
        self._over, self.late_s = threading.Event(), 0.0

    def caps(self):
        dtype, triggers = str(self._pixels.dtype), frozenset({"free-run"})
        return CameraCaps("made", *self._pixels.shape, 1, dtype, 12, timed=True, triggers=triggers, numbered=True)

    def configure(self, *, exposure_ms, roi=None):
        pass

    def arm(self, frames, sink):
        self.stop(CAMERA_STOP_S)
        self._over.clear()
        self._thread = threading.Thread(target=self._give, args=[sink], daemon=True)
        self._thread.start()

    def trigger(self):
        pass

    def _give(self, sink):
        period_s, begin_s, number = 1 / self._rate_hz, CLOCK.now() + 0.1, 0
        while not self._over.is_set():
            number = max(number + 1, int((CLOCK.now() - begin_s) / period_s) - self.BUFFERS)
            end_s = begin_s + number * period_s
            CLOCK.sleep(max(0.0, end_s - CLOCK.now()))
            sink(
                self._pixels,
                FrameStamp(round(end_s * 1e9), number, *(round(t * 1e9) for t in (end_s - period_s, end_s))),
            )
            self.late_s = max(self.late_s, CLOCK.now() - end_s)

    def stop(self, timeout_s):
        self._over.set()
        if hasattr(self, "_thread"):
            self._thread.join(timeout_s)

    def close(self):
        pass


def record(pixels, rate_hz, seconds, folder, viewers):
    """Take a series while others look on; return frames lost, the longest wait in ms, and CPU seconds a second."""
    frames = round(rate_hz * seconds)
    slots = ring_slots(pixels.nbytes, free_bytes(shared_memory_folder()), camera_waits=False)
    ring = RingWriter.create("bench", pixels.shape, "uint16", slots, clock=CLOCK)
    layout = FocalArray(frames, pixels.shape, "uint16", 0.0, 1.0, None, sections=frames, compression="none")
    store = RunStore.create(folder, {"name": "bench", "plan_id": "bench"}, layout, CLOCK)
    camera = Camera(pixels, rate_hz)
    plan = RunPlan(StackPlan(0, 0, 1, 1000 / rate_hz), series=SeriesPlan(frames))
    stage = SimStage(Axis(CLOCK, Limits(-1.0, 1.0)))
    with ExitStack() as stack:
        for number in range(viewers):
            stack.enter_context(viewer(ring.path, asleep=number == 0))
        run = Run(plan, stage, camera, Recorder(store, ring, CLOCK), CLOCK)
        begin_s, begin_cpu_s = CLOCK.now(), time.process_time()
        run.execute()
        cores = (time.process_time() - begin_cpu_s) / (CLOCK.now() - begin_s)
    if run.error is not None:
        print(f"{pixels.shape}, {rate_hz} Hz: {run.error}", file=sys.stderr)
    return frames - len(open_run(folder).planes), camera.late_s * 1000, cores


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
