"""How fast the simulated bench is: planes a second at 1024², its share beside the exposure, its cost per call.

Run: ``python benchmarks/bench_sim.py``. Rendering is timed in this process, turn and turn about with a memcpy of the
same frame, the peer; the served camera over its wire and shared memory, with an exposure too short to matter. Prints a
table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import contextlib
import json
import platform
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from devices.values import CameraCaps, Limits
from sim.camera import Replay, SimCamera
from sim.clock import SimClock
from sim.motion import Axis, Ringing
from sim.optics import Optics
from sim.sensor import Sensor
from sim.serve import DEFAULT_INSTRUMENT
from sim.specimen import make_specimen
from sim.stage import SimStage

WANTED_PER_S = 30.0
LIMIT_PREPARE_S = {512: 3.0, 1024: 8.0}
LIMIT_CALL_US = 50.0
ROUNDS = 40
CALLS = 2000
PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve", "--follow-stdin"]


def prepared(kind: str, size: int) -> tuple[Sensor, float]:
    start = time.perf_counter()
    specimen = make_specimen(kind, (size, size), 0.1725, seed=7)
    optics = Optics(na=0.45, medium_index=1.0, wavelength_um=0.55, pixel_um=0.1725)
    sensor = Sensor(specimen, optics, bit_depth=12, exposure_ms=10.0, seed=7)
    return sensor, time.perf_counter() - start


def rendering(sensor: Sensor) -> tuple[float, float]:
    """Median seconds of a plane, and of a memcpy of it."""
    caps = sensor.caps()
    frame, copy = np.empty(caps.shape, caps.dtype), np.empty(caps.shape, caps.dtype)
    planes, copies = [], []
    for z_um in np.linspace(-20, 20, ROUNDS):
        planes.append(seconds(lambda z_um=z_um: sensor.expose(np.array([z_um]), 10.0, frame)))
        copies.append(seconds(lambda: np.copyto(copy, frame)))
    return statistics.median(planes), statistics.median(copies)


def seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def served(kind: str) -> float:
    """Planes a second that the bench hands over its wire at 1024², exposing 1 ms each."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.toml"
        text = DEFAULT_INSTRUMENT.read_text(encoding="utf-8")
        rig.write_text(text.replace("[512, 512]", "[1024, 1024]").replace('"relief"', f'"{kind}"'), encoding="utf-8")
        command = [*PROGRAM, str(rig), "--dir", folder]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as bench:
            try:
                return triggered(json.loads(bench.stdout.readline())["camera"])
            finally:
                bench.stdin.close()


def triggered(address: str) -> float:
    host, _, port = address.partition(":")
    with socket.create_connection((host, int(port))) as wire, contextlib.closing(wire.makefile("rb")) as answers:

        def ask(**words):
            wire.sendall(json.dumps({"id": 0, **words}).encode() + b"\n")
            assert json.loads(answers.readline())["ok"]

        ask(do="configure", exposure_ms=1.0)
        ask(do="trigger")
        took = seconds(lambda: [ask(do="trigger") for _ in range(ROUNDS)])
    return ROUNDS / took


def calls() -> dict[str, float]:
    """Microseconds of a move with its arrival, and of a trigger, on simulated time, beside rendering."""
    axis = Axis(SimClock(), Limits(-1e6, 1e6), backlash_um=0.5, ringing=Ringing(0.001))
    stage = SimStage(axis)
    caps = CameraCaps("replay", 8, 8, 1, "uint16", 12, timed=True)
    camera = SimCamera(Replay(np.zeros((1, 8, 8), np.uint16), caps), axis)
    camera.arm(None, lambda _pixels, _stamp: None)

    def moves():
        for plane in range(CALLS):
            stage.move_to(float(plane))
            stage.settle(5.0)

    stage_us = seconds(moves) / CALLS * 1e6
    camera_us = seconds(lambda: [camera.trigger() for _ in range(CALLS)]) / CALLS * 1e6
    return {"move and settle": stage_us, "trigger": camera_us}


def main() -> int:
    rows: list[tuple[str, str, float]] = []  # what, figure, ratio to its limit: 1 and less is good
    for size, limit_s in LIMIT_PREPARE_S.items():
        for kind in ("relief", "depth"):
            sensor, prepare_s = prepared(kind, size)
            rows.append((f"prepare {kind} {size}²", f"{prepare_s:.2f} s", prepare_s / limit_s))
            if size == 1024:
                plane_s, copy_s = rendering(sensor)
                words = f"{1 / plane_s:.0f} planes/s, {plane_s / copy_s:.0f} memcpys"
                rows.append((f"render {kind} {size}²", words, WANTED_PER_S * plane_s))
    for kind in ("relief", "depth"):
        per_s = served(kind)
        rows.append((f"serve {kind} 1024²", f"{per_s:.0f} planes/s", WANTED_PER_S / per_s))
    rows += [(name, f"{us:.1f} µs", us / LIMIT_CALL_US) for name, us in calls().items()]
    for what, figure, ratio in rows:
        print(f"{what:<20} {figure:>32}   {ratio:5.2f} of the limit")
    result = {what: {"figure": figure, "of_limit": round(ratio, 3)} for what, figure, ratio in rows}
    print(json.dumps({"benchmark": "sim", "machine": platform.machine(), "results": result}, ensure_ascii=False))
    return int(any(ratio > 1 for *_, ratio in rows))


if __name__ == "__main__":
    sys.exit(main())
