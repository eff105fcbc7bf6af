"""What a hardware-triggered stack costs beside its exposures and the stage's own moves, on the simulated bench.

Run: ``python benchmarks/bench_triggered.py [PLANES] [STACKS]``. The bench is a process of its own; the stage's driver
talks to it over the paced serial line, the camera's over TCP and shared memory. A stack of 100 planes does not fit into
the controller's ring, so it is its linear stack; one of 40 planes does. The time of a stack is from the beginning of
its first exposure to the end of its last one; it is compared with the sum of the exposures and of the moves between
them, each as long as the twin's axis needs for it. The peer is the same stack triggered by software. Prints a table and
a line of JSON; ends with 1 when the median of the stacks misses the limit or a plane is lost.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

from acquire.engine import Policy, Run, RunState
from acquire.plan import StackPlan
from devices.clock import SystemClock
from devices.rig import load_rig, open_rig

LIMIT = 1.03
EXPOSURE_MS = 10.0
STEP_UM = 1.0
SPEED_UM_S, RAMP_S = 2000.0, 0.07
INSTRUMENT = """schema = 1
name = "triggered"
camera = { driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 10.0 }
optics = { magnification = 20.0, na = 0.45 }
[stage.z]
driver = "asi-ms2000"
port = "written by the bench"
baud = 115200
limits = { min_um = -200.0, max_um = 200.0 }
speed_um_s = 2000.0
"""
PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve", "--follow-stdin"]


class Headers:
    """Where frames go: only their headers are kept."""

    durable = 0

    def __init__(self):
        self.kept = []

    def check(self):
        pass

    def put(self, pixels, header):
        self.kept.append(header)

    def missed(self, missed):
        pass

    def finish(self, end, reason=""):
        return end


def move_s():
    """Time of one step: too short to reach the speed, up and down the same ramp."""
    acceleration = SPEED_UM_S / RAMP_S
    assert STEP_UM < SPEED_UM_S * RAMP_S
    return 2 * math.sqrt(STEP_UM / acceleration)


def stack(rig, planes, *, triggered):
    """Take a stack: its ratio to exposures and moves, planes lost, and planes that the hardware did not bring."""
    plan = StackPlan(round(-500 * planes * STEP_UM), round(1000 * STEP_UM), planes, EXPOSURE_MS)
    out, told = Headers(), []
    run = Run(plan, rig.stage, rig.camera, out, SystemClock(), policy=Policy(triggered=triggered), tell=told.append)
    state = run.execute()
    lost = planes - len({header.plane for header in out.kept})
    if state is not RunState.COMPLETED or lost:
        return math.inf, lost, planes
    by_software = sum(b.hw_id - a.hw_id != 1 for a, b in pairwise(out.kept))
    took_s = (out.kept[-1].exposure_end_ns - out.kept[0].exposure_start_ns) / 1e9
    warnings = sum(event["event"] == "warn" for event in told)
    return took_s / (planes * EXPOSURE_MS / 1000 + (planes - 1) * move_s()), lost, by_software + warnings


def main(planes, stacks):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "small.toml").write_text(INSTRUMENT)
        command = [*PROGRAM, str(folder / "small.toml"), "--dir", str(folder / "bench")]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            instrument = Path(json.loads(process.stdout.readline())["instrument"])
            with open_rig(load_rig(instrument), clock=SystemClock()) as rig:
                linear = [stack(rig, planes, triggered=True) for _ in range(stacks)]
                ring = [stack(rig, 40, triggered=True) for _ in range(stacks)]
                software = stack(rig, planes, triggered=False)
            process.communicate()
    ratios = {
        f"linear, {planes} planes": statistics.median(ratio for ratio, _, _ in linear),
        "ring, 40 planes": statistics.median(ratio for ratio, _, _ in ring),
        f"software, {planes} planes": software[0],
    }
    lost = sum(gone + late for _, gone, late in (*linear, *ring))
    print(f"one step of {STEP_UM:g} µm takes the axis {1000 * move_s():.2f} ms, an exposure {EXPOSURE_MS:g} ms\n")
    print("time of a stack / (exposures + moves)")
    for words, ratio in ratios.items():
        print(f"  {words:<24}{ratio:8.4f}{'' if 'software' in words else f'   limit {LIMIT}'}")
    print(f"planes lost, or left to software: {lost}")
    hardware = [ratio for words, ratio in ratios.items() if "software" not in words]
    passed = max(hardware) <= LIMIT and lost == 0
    worst = max(ratio for ratio, _, _ in (*linear, *ring))
    figures = {"linear": hardware[0], "ring": hardware[1], "worst": worst, "software": software[0]}
    print(json.dumps({"bench": "triggered", "limit": LIMIT, "lost": lost, "passed": passed, **figures}))
    return 0 if passed else 1


if __name__ == "__main__":
    arguments = [int(text) for text in sys.argv[1:]]
    sys.exit(main(*(arguments or [100, 5]), *([5] if len(arguments) == 1 else [])))
