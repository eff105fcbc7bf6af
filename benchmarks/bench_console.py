"""What the console costs: Python per frame and panel, idle CPU, from Esc to the stop on the wire, and what a run pays.

Run under a display: ``python benchmarks/bench_console.py``, or with ``xvfb-run``. Times of panels are CPU times of the
window's thread; that of a run is from its first plane to its last, with the console and without in turns. Prints a
table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import tifffile
import tomlkit
from imgui_bundle import imgui
from imgui_bundle.immapp import testing

from acquire import requests
from acquire.bench import PROGRAM
from acquire.served import Served
from acquire.store import open_run
from display.console.app import opened
from display.console.window import ConsoleWindow
from display.gl.live_picture import LivePicture

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from served import served
from x_keyboard import Keyboard

from sim.pytest_plugin import SimBench

RIG = (Path(__file__).parent.parent / "sim" / "default_instrument.toml").read_text()
RECIPE = (
    'schema = 1\nname = "b"\n[output]\nkeep_free_gb = 0.001\n[stack]\ntop_um = 10.0\nbottom_um = -10.0\nplanes = {}\n'
)
FRAMES, STOPS, PLANES, ROUNDS = 200, 30, 100, 12
LARGE_PX, LARGE_FRAMES = 2048, 21
SETTLED_S, IDLE_S, REST_S, PATIENCE_S = 8.0, 20.0, 0.2, 30.0
DRAWN = "looking up the live picture"
HALT = "\\"


def main() -> int:
    """Measure everything, print it, and say whether the limits are kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--stops", type=int, default=STOPS)
    stops = parser.parse_args().stops
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="st-")))
        os.environ["XDG_CONFIG_HOME"] = str(folder)
        rig = folder / "rig.toml"
        rig.write_text(RIG.replace("speed_um_s  = 2000.0", "speed_um_s  = 400.0"))
        bench = SimBench([str(rig), "--dir", str(folder / "b")])
        stack.callback(bench.close)
        with joined(bench.instrument, "--transcript", folder / "wire") as server:
            rows = measure(server, folder, stops)
        with joined(large_instrument(bench.instrument, folder)) as server:
            rows += large_rows(server, folder)
    print(f"{'what':<66} {'measured':>10}  limit")
    for name, value, limit in rows:
        print(f"{name:<66} {value:>10.4g}  {'' if limit is None else f'<= {limit:g}'}{missed(value, limit)}")
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    print(json.dumps({"benchmark": "console", **machine, **{name: value for name, value, _ in rows}}))
    return 1 if any(missed(value, limit) for _, value, limit in rows) else 0


@contextmanager
def joined(instrument, *options):
    """Serve an instrument, and let what is started meanwhile find it."""
    with served(instrument, *options) as server:
        os.environ["XDG_RUNTIME_DIR"] = str(server.runtime)
        yield server


def missed(value, limit):
    return "  MISSED" if limit is not None and value > limit else ""


def measure(server, folder, stops):
    """Return rows of (what, value, limit or None)."""
    rows = []
    with ExitStack() as stack:
        console = opened(Served(server.connection), stack)
        window = ConsoleWindow(console, remembers=False)
        stack.callback(window.close)
        spent = timed_panels(window)

        def drive(ctx):
            engine = imgui.test_engine.get_io(ctx.engine)
            engine.config_watchdog_warning = engine.config_watchdog_kill_test = 1e6
            wait(ctx, lambda: console.bench.commands)
            console.camera.live()
            wait(ctx, lambda: console.eyes.seen)
            spent.clear()
            ctx.yield_(FRAMES)
            rows.extend(panel_rows(spent))
            console.camera.live()
            wait(ctx, lambda: not console.state.live)

        testing.run(test_function=drive, runner_params=window.params)
    rows.extend(stop_rows(server, folder / "wire" / "stage-z.jsonl", stops))
    rows.append(("idle, share of a core, %", 100 * idle_share(server), 10))
    rows.extend(run_rows(server, folder, "512²"))
    return rows


def run_rows(server, folder: Path, size: str):
    """Take stacks beside a console as a user starts it, and while its process is held still, in turns.

    A pair is taken in one order and the next in the other, so that a machine that grows slower favours neither.
    """
    logs, lost = [], 0
    with server.client() as instrument, started_console(server) as console:
        instrument.command("bench")
        time.sleep(SETTLED_S)
        for k in range(ROUNDS):
            took_s = {}
            for beside in (k % 2 == 0, k % 2 == 1):
                console.send_signal(signal.SIGCONT if beside else signal.SIGSTOP)
                time.sleep(REST_S)
                run = folder / f"{size}-{k}-{beside}"
                took_s[beside] = run_once(instrument, run)
                lost += len(open_run(run).missing)
            logs.append(math.log(took_s[True] / took_s[False]))
        console.send_signal(signal.SIGCONT)
    ratio, unsure = math.exp(statistics.mean(logs)), math.expm1(statistics.stdev(logs) / math.sqrt(ROUNDS))
    return [
        (f"{size}: time of a stack beside the console over alone, {ROUNDS} pairs", ratio, 1.02),
        (f"{size}: standard error of that", unsure, None),
        (f"{size}: planes lost", lost, 0),
    ]


def large_instrument(instrument: Path, folder: Path) -> Path:
    """Return an instrument file whose camera replays frames of noise: the simulated one has 6 of this size a second."""
    source = folder / "frames"
    source.mkdir()
    for k in range(LARGE_FRAMES):
        frame = np.random.default_rng(k).integers(0, 4096, (LARGE_PX, LARGE_PX), np.uint16)
        tifffile.imwrite(source / f"{k}.tif", frame)
    tables = tomlkit.parse(Path(instrument).read_text())
    tables["name"] = "large bench"
    tables["camera"] = {
        "driver": "folder",
        "source": str(source),
        "z0_um": -100.0,
        "step_um": 200.0 / (LARGE_FRAMES - 1),
        "bit_depth": 12,
        "pixel_um": 3.45,
        "exposure_ms": 10.0,
    }
    path = folder / "large.toml"
    path.write_text(tomlkit.dumps(tables))
    return path


def large_rows(server, folder: Path):
    """Measure with frames of 2048²: how many are shown in a second, and what a stack pays for it."""
    with server.client() as instrument, started_console(server) as console:
        instrument.command("bench")
        instrument.start_live(30.0)
        time.sleep(SETTLED_S)
        with instrument.viewer() as viewer:
            first, began_s, before_s = viewer.newest(PATIENCE_S), time.monotonic(), spent_s(console.pid)
            time.sleep(IDLE_S)
            last, took_s = viewer.newest(PATIENCE_S), time.monotonic() - began_s
        share = (spent_s(console.pid) - before_s) / took_s
        instrument.stop_live()
    rows = [
        ("2048²: live frames a second, asked for 30", (last.number - first.number) / took_s, None),
        ("2048²: share of a core the console takes for them, %", 100 * share, None),
    ]
    return rows + run_rows(server, folder, "2048²")


def idle_share(server) -> float:
    """Return the processor time of a console nobody touches, as a user starts it, over the time it took."""
    with started_console(server) as console:
        time.sleep(SETTLED_S)
        before = spent_s(console.pid), time.monotonic()
        time.sleep(IDLE_S)
        after = spent_s(console.pid), time.monotonic()
    return (after[0] - before[0]) / (after[1] - before[1])


@contextmanager
def started_console(server):
    """Start a console as a user does."""
    command = [*PROGRAM, "console", "--server", str(server.connection)]
    console = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield console
    finally:
        console.terminate()
        console.wait()


def spent_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wait(ctx, wanted):
    while not wanted():
        ctx.yield_()


def run_once(instrument, folder: Path) -> float:
    """Return the time from the first to the last plane of a stack, in s."""
    instrument.start_run(RECIPE.format(PLANES), out=folder)
    instrument.wait_for_run(300.0)
    return taken_s(folder)


def taken_s(folder: Path) -> float:
    arrivals = sorted(each.header.arrival_ns for each in open_run(folder).planes.values())
    return (arrivals[-1] - arrivals[0]) / 1e9


def stop_rows(server, wire: Path, stops: int):
    """Press Esc in a console as a user starts it, live frames shown, the stage moving by another client's command."""
    keyboard, late_ms = Keyboard(), []
    with server.client() as client, started_console(server):
        client.command("bench")
        client.start_live(30.0)
        time.sleep(SETTLED_S)
        for k in range(stops):
            client.ask(requests.MoveStage(z_um=150.0 if k % 2 else -150.0))
            time.sleep(random.uniform(0.05, 0.15))  # at any moment of a frame
            late_ms.append(1000 * stopped_after_s(keyboard, wire))
            client.wait_for(lambda state: state.stopped, PATIENCE_S)
            time.sleep(REST_S)
            client.clear_stop()
        client.stop_live()
    return [
        (f"Esc at the keyboard to the stop on the wire, median of {stops}, ms", statistics.median(late_ms), None),
        ("the same, 99th percentile, ms", float(np.percentile(late_ms, 99)), 100),
        ("the same, longest, ms", max(late_ms), None),
    ]


def stopped_after_s(keyboard, wire: Path) -> float:
    """Press Esc and return how long it took until a halt was on the line of the stage."""
    with wire.open("rb") as lines:
        lines.seek(-1, os.SEEK_END)
        whole = lines.read(1) == b"\n"  # else the rest of a line that is being written comes first
        pressed_s = time.monotonic()
        keyboard.escape(down=True)
        line = b""
        while True:
            line += lines.readline()
            if not line.endswith(b"\n"):  # half of it may be written
                time.sleep(0.002)
                continue
            if not whole:
                line, whole = b"", True
                continue
            told, line = json.loads(line), b""
            if told["to"] == "device" and told["bytes"].startswith(HALT):
                keyboard.escape(down=False)
                return told["t"] - pressed_s


def timed_panels(window):
    """Have every panel's CPU time in this thread noted."""
    spent = {}
    draw = window.guarded

    def guarded(name, panel):
        before = time.thread_time()
        draw(name, panel)
        spent.setdefault(name, []).append(1000 * (time.thread_time() - before))

    lay = LivePicture.draw

    def draw_picture(*given, **named):
        before = time.thread_time()
        lay(*given, **named)
        drawn = 1000 * (time.thread_time() - before)
        spent.setdefault(DRAWN, []).append(drawn)
        window.drawn_ms = drawn

    def live_guarded(name, panel):
        window.drawn_ms = 0.0
        guarded(name, panel)
        spent[name][-1] -= window.drawn_ms

    LivePicture.draw = draw_picture
    window.guarded = live_guarded
    window.params = window.make_params(None, remembers=False)
    return spent


def panel_rows(spent):
    drawn = spent.pop(DRAWN)
    frames = min(len(times) for times in spent.values())
    whole = [sum(times[k] for times in spent.values()) for k in range(frames)]
    rows = [(f"Python in {name}, median, ms", statistics.median(times), None) for name, times in sorted(spent.items())]
    rows.append((f"{DRAWN} without a graphics processor, median, ms", statistics.median(drawn), None))
    return [*rows, ("Python in all panels of a frame, median, ms", statistics.median(whole), 2)]


if __name__ == "__main__":
    sys.exit(main())
