"""How long the whole simulated bench takes to start, and what it leaves: killed with -9, and ended as usual.

The limit is 3 s from the start of the process to the greeting line. The start of the interpreter with numpy and OpenCV,
which no bench can do without, is measured in the same run.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LIMIT_S = 3.0
STARTS = 5
RIG = """schema = 1
name = "whole"
camera = { driver = "sim", size_px = [512, 512], bit_depth = 12, pixel_um = 3.45 }
optics = { magnification = 20.0, na = 0.45 }
[stage.z]
driver = "asi-tiger"
port = "x"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
[microtome]
profile = "leadshine-rs"
port = "x"
limits = { feed_um_max = 4000.0 }
knife = { profile = "plc-mailbox", unit = 2 }
[glasses]
driver = "open3d"
port = "x"
"""


def started(rig: Path, scratch: Path) -> tuple[float, subprocess.Popen]:
    command = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve", str(rig)]
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "TMPDIR": str(scratch)})
    told = json.loads(process.stdout.readline())
    seconds = time.perf_counter() - begin
    assert set(told["ports"]) == {"camera", "z", "feed", "glasses"}
    return seconds, process


def bare_s() -> float:
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import numpy, cv2"], check=True)
    return time.perf_counter() - begin


def left(scratch: Path, pids: list[int]) -> list[str]:
    shared = [str(path) for pid in pids for path in Path("/dev/shm").glob(f"stereotome-bench-{pid}-*")]
    alive = [str(pid) for pid in pids if Path(f"/proc/{pid}").exists()]
    return [*shared, *alive, *map(str, scratch.iterdir())]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rig, scratch = Path(folder) / "rig.toml", Path(folder) / "scratch"
        rig.write_text(RIG)
        scratch.mkdir()
        runs, bare, pids = [], [bare_s() for _ in range(STARTS)], []
        for number in range(STARTS):
            seconds, process = started(rig, scratch)
            runs.append(seconds)
            pids.append(process.pid)
            process.send_signal(signal.SIGTERM if number == STARTS - 1 else signal.SIGKILL)
            process.communicate()
        remains = left(scratch, pids)
    median = statistics.median(runs)
    print(f"start to greeting   median {median:.2f} s, worst {max(runs):.2f} s   limit {LIMIT_S:g} s")
    print(f"bare numpy + OpenCV median {statistics.median(bare):.2f} s")
    print(f"left after {STARTS - 1} x kill -9 and one ordinary end: {len(remains)}")
    result = {"benchmark": "startup", "median_s": median, "worst_s": max(runs), "ratio_to_limit": max(runs) / LIMIT_S}
    print(json.dumps({**result, "bare_s": statistics.median(bare), "left": len(remains)}))


if __name__ == "__main__":
    main()
