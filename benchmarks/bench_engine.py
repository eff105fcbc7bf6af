"""What the engine costs beside the exposure, and whether it loses a plane: the whole way to the disk at 512².

Run: ``python benchmarks/bench_engine.py [PLANES]``. Stage and camera are simulated at protocol level: the stage arrives
at once, the camera exposes for 10 ms of real time and then has its frame; what lies between that and the next exposure
is the engine's and the recorder's. (How late the system wakes the simulated camera is not theirs; it is printed.) The
same cycle without an engine (expose, copy) runs before and after as the peer. Prints a table and a line of JSON; ends
with 1 when a limit is missed.
"""

from __future__ import annotations

import json
import platform
import shutil
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from acquire.engine import Run, RunState
from acquire.ome_zarr import FocalArray
from acquire.plan import StackPlan
from acquire.recorder import Recorder
from acquire.ring import RingReader, RingWriter
from acquire.store import RunStore, open_run
from devices.clock import SystemClock
from devices.values import CameraCaps, Limits
from sim.camera import Replay, SimCamera
from sim.clock import SimClock
from sim.motion import Axis
from sim.stage import SimStage

SHAPE = (512, 512)
EXPOSURE_MS = 10.0
PLANES = 10_000
LIMIT_MS = 0.3
FRAMES = np.random.default_rng(3).integers(0, 4096, (16, *SHAPE)).astype(np.uint16)
CAPS = CameraCaps("replay", *SHAPE, 1, "uint16", 12, timed=True)


class RingOnly:
    """Where frames go when nothing is stored: into the ring, read by nobody but a lossless reader in step."""

    def __init__(self, ring, reader):
        self.ring, self.reader, self.durable = ring, reader, 0

    def check(self):
        pass

    def put(self, pixels, header):
        self.ring.push(pixels, header)
        self.reader.read(0)
        self.reader.release()

    def missed(self, missed):
        pass

    def finish(self, end, reason=""):
        return end


def bench(clock):
    axis = Axis(clock, Limits(-1e6, 1e6), speed_um_s=1e12, ramp_s=1e-9)
    return SimStage(axis), SimCamera(Replay(FRAMES, CAPS), axis, exposure_ms=EXPOSURE_MS)


def plan(planes):
    return StackPlan(start_nm=0, step_nm=100, count=planes, exposure_ms=EXPOSURE_MS)


def bare_engine_ms(planes):
    """Mean wall time of a plane on a simulated clock: nothing waits, so all of it is overhead, the copies included."""
    clock, wall = SimClock(), SystemClock()
    stage, camera = bench(clock)
    ring = RingWriter.create("bench", SHAPE, "uint16", 4, clock=wall)
    reader = RingReader.attach(ring.path, "lossless", clock=wall)
    run = Run(plan(planes), stage, camera, RingOnly(ring, reader), clock)
    begin = wall.now()
    assert run.execute() is RunState.COMPLETED
    took = wall.now() - begin
    reader.close()
    ring.close()
    return 1000 * took / planes


def recorded(folder, planes):
    """Take planes in real time to the disk: ms from each frame to the next exposure, how late frames were, lost."""
    clock = SystemClock()
    stage, camera = bench(clock)
    ring = RingWriter.create("bench", SHAPE, "uint16", 32, clock=clock)
    layout = FocalArray(planes, SHAPE, "uint16", start_um=0.0, step_um=0.1, pixel_um=None)
    recorder = Recorder(RunStore.create(folder, {"plan_id": "bench"}, layout, clock), ring, clock)
    state = Run(plan(planes), stage, camera, recorder, clock).execute()
    stored = open_run(folder)
    headers = [stored.planes[k].header for k in sorted(stored.planes)]
    gaps_ms = [(b.exposure_start_ns - a.arrival_ns) / 1e6 for a, b in pairwise(headers)]
    late_ms = [(h.arrival_ns - h.exposure_start_ns) / 1e6 - EXPOSURE_MS for h in headers]
    wrong = sum(not np.array_equal(stored.read(k), FRAMES[k % len(FRAMES)]) for k in stored.planes)
    return gaps_ms, late_ms, len(stored.missing) + wrong, state


def peer_ms(planes=300):
    """The same cycle with nothing but exposing and copying: what the machine itself adds to an exposure."""
    clock = SystemClock()
    _, camera = bench(clock)
    kept, stamps = np.empty(SHAPE, np.uint16), []

    def keep(pixels, stamp):
        np.copyto(kept, pixels)
        stamps.append(stamp)

    camera.arm(None, keep)
    for _ in range(planes):
        camera.trigger()
    return float(np.median([(b.exposure_start_ns - a.arrival_ns) / 1e6 for a, b in pairwise(stamps)]))


def main():
    planes = int(sys.argv[1]) if len(sys.argv) > 1 else PLANES
    folder = Path(tempfile.mkdtemp(prefix="stereotome-bench-"))
    try:
        peer = peer_ms()
        above_ms, late_ms, lost, state = recorded(folder / "run", planes)
        peer = (peer + peer_ms()) / 2
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    p50, mean, p99 = float(np.median(above_ms)), float(np.mean(above_ms)), float(np.percentile(above_ms, 99))
    rows = [
        ("engine and ring alone, mean, ms a plane", bare_engine_ms(5000), f"<= {LIMIT_MS}"),
        ("engine, ring, writer and disk, p50, ms above the exposure", p50, f"<= {LIMIT_MS}"),
        ("the same, mean", mean, f"<= {LIMIT_MS}"),
        ("the same, p99", p99, ""),
        ("peer: expose and copy only, p50", peer, ""),
        ("the system woke the simulated camera late by, p50", float(np.median(late_ms)), ""),
        (f"planes lost or wrong of {planes} ({state})", lost, "<= 0"),
    ]
    print(f"{platform.machine()}, Python {platform.python_version()}, 512² uint16, exposure {EXPOSURE_MS:g} ms")
    missed = []
    for name, value, limit in rows:
        kept = not limit or value <= float(limit.removeprefix("<= "))
        missed += [] if kept else [name]
        print(f"{name:62} {value:8.3f}  {limit:8} {'' if kept else 'MISSED'}")
    print(json.dumps({name: round(float(value), 4) for name, value, _ in rows}))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
