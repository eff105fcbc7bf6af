"""How well shutter glasses keep to the display: 60 s at 120 Hz on simulated time, and some seconds of real time.

Run: ``python benchmarks/bench_glasses.py``. On simulated time the display flips exactly, the USB takes 0.2 … 1.2 ms
each way, and the emitter's clock is wrong by -100, 0 or +100 ppm; each case is shown once as the driver locks it and
once locked a single time, its peer: there the slow beat is seen. In real time, with simulated lines, the peer is a bare
loop that only sleeps to each flip. Prints tables and a line of JSON; ends with 1 when a limit is missed on simulated
time. ``--real-seconds`` sets the length of the real part, ``--real-only`` leaves the simulated one out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from contextlib import closing

from devices.clock import SystemClock
from devices.drivers.modem_glasses import ModemGlasses, open_glasses
from devices.drivers.open3d import Open3dGlasses
from devices.glasses_spec import GlassesSpec
from devices.glasses_timing import Edge, phase_report
from devices.registry import DeviceContext
from devices.transport.lines import ModemLines
from sim.clock import SimClock
from sim.controllers.open3d import Emitter
from sim.eyewear import Shutter, leak
from sim.simlines import Circuit, plug
from sim.usb_wire import UsbWire

HZ, SECONDS = 120.0, 60.0
OPEN_US = 5600
LIMIT_BIAS_MS, LIMIT_P99_MS = 0.5, 1.5
LOCK_EVERY_S = 0.25
NEVER_S = 60.0
LISTENING, WIRED = Shutter(), Shutter(silence_s=None)
COLUMNS = ("bias_ms", "rms_ms", "p95_ms", "p99_ms", "max_ms", "drift_ppm", "beat_s", "missed", "duplicated")


def flips_from(first_s, seconds):
    return [Edge(round((first_s + n / HZ) * 1e9), "right" if n % 2 else "left") for n in range(round(seconds * HZ))]


def result(edges, flips, shutter, open_s, locks):
    inside = [edge for edge in edges if flips[0].at_ns - 4e6 <= edge.at_ns <= flips[-1].at_ns + 4e6]
    report = phase_report(inside, flips, open_s=open_s)
    found = {name: getattr(report, name) for name in COLUMNS}
    light = 100 * leak(inside, flips, shutter, open_s=open_s)
    return {**found, "wrong_eye": report.alternation_faults, "leak_percent": light, "locks": locks}


def emitter_free(drift_ppm, *, locked_once=False):
    clock = SimClock(100.0)
    twin = Emitter(clock, drift_ppm=drift_ppm)
    spec = GlassesSpec(
        driver="open3d", port="usb", delay_us=0, open_us=OPEN_US, swap=False, relock_s=NEVER_S if locked_once else 1.0
    )
    glasses = Open3dGlasses(UsbWire(twin.feed, clock), spec, clock)
    glasses.prepare()
    first_s = clock.now()
    glasses.lock_to(HZ, first_s)
    begun_s = clock.now() + 0.1
    while clock.now() < begun_s + SECONDS + 0.2:
        if not locked_once:
            glasses.lock_to(HZ, first_s)
        clock.sleep(LOCK_EVERY_S)
    skipped = 2 * round((begun_s - first_s) * HZ / 2)
    flips = flips_from(first_s + skipped / HZ, SECONDS)
    return result(twin.edges(), flips, LISTENING, OPEN_US / 1e6, len(glasses.timing.locks))


def emitter_per_frame():
    clock = SimClock(100.0)
    twin = Emitter(clock)
    spec = GlassesSpec(driver="open3d", port="usb", delay_us=0, open_us=OPEN_US, swap=False, drive="per-frame")
    glasses = Open3dGlasses(UsbWire(twin.feed, clock), spec, clock)
    glasses.prepare()
    glasses.show("right")
    flips = flips_from(clock.now() + 0.01, SECONDS)
    for flip in flips:
        clock.sleep(flip.at_ns / 1e9 - clock.now())
        glasses.show(flip.eye)
    return result(twin.edges()[1:], flips, LISTENING, OPEN_US / 1e6, 0)


def lines_free():
    clock = SimClock(100.0)
    circuit = Circuit(clock)
    lines = ModemLines(plug("bench", circuit), (), device="glasses")
    glasses = ModemGlasses(lines, GlassesSpec(driver="modem-lines", port="x"), clock)
    flips = flips_from(clock.now() + 0.01, SECONDS)
    glasses.lock_to(HZ, flips[0].at_ns / 1e9)
    while clock.now() < flips[-1].at_ns / 1e9 + 0.02:
        clock.sleep(glasses.tend() + 1e-6)
    return result(circuit.edges(), flips, WIRED, None, 1)


def real_lines(seconds, *, free):
    """The driver's thread, or its caller, on the real clock; the lines are simulated and cost nothing."""
    clock = SystemClock()
    circuit = Circuit(clock)
    spec = GlassesSpec(driver="modem-lines", port=plug(f"bench-{free}", circuit))
    with closing(open_glasses(spec, DeviceContext(clock))) as glasses:
        flips = flips_from(clock.now() + 0.1, seconds)
        for flip in flips[:: 30 if free else 1]:
            clock.sleep(flip.at_ns / 1e9 - clock.now())
            glasses.lock_to(HZ, flips[0].at_ns / 1e9) if free else glasses.show(flip.eye)
        clock.sleep(flips[-1].at_ns / 1e9 - clock.now() + 0.02)
        return result(circuit.edges(), flips, WIRED, None, len(glasses.timing.locks))


def bare_loop(seconds):
    clock = SystemClock()
    flips, edges = flips_from(clock.now() + 0.1, seconds), []
    for flip in flips:
        clock.sleep(flip.at_ns / 1e9 - clock.now())
        edges.append(Edge(round(clock.now() * 1e9), flip.eye))
    return result(edges, flips, WIRED, None, 0)


def table(title, rows):
    names = (*COLUMNS, "wrong_eye", "leak_percent", "locks")
    print(f"\n{title}\n{'':34}" + "".join(f"{name:>13}" for name in names))
    for case, row in rows.items():
        print(f"{case:34}" + "".join(f"{row[name]:>13.3f}" if row[name] % 1 else f"{row[name]:>13g}" for name in names))


def within(row):
    return abs(row["bias_ms"]) <= LIMIT_BIAS_MS and row["p99_ms"] <= LIMIT_P99_MS and row["wrong_eye"] == 0


def simulated():
    locked = {f"emitter free, {ppm:+d} ppm": emitter_free(ppm) for ppm in (-100, 0, 100)}
    locked |= {"modem lines free": lines_free()}
    once = {f"emitter locked once, {ppm:+d} ppm": emitter_free(ppm, locked_once=True) for ppm in (-100, 0, 100)}
    once |= {"emitter per frame": emitter_per_frame()}
    table(f"Simulated time, {SECONDS:g} s at {HZ:g} Hz, as driven by default", locked)
    table("For comparison", once)
    print(f"\nlimits: |bias| <= {LIMIT_BIAS_MS} ms, p99 <= {LIMIT_P99_MS} ms, wrong_eye = 0")
    for case, row in locked.items():
        ratios = f"{abs(row['bias_ms']) / LIMIT_BIAS_MS:.2f} and {row['p99_ms'] / LIMIT_P99_MS:.2f} of the limits"
        print(f"  {case}: {ratios}: {'reached' if within(row) else 'MISSED'}")
    return locked, once


def real(seconds):
    print(f"\nload average {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    rows = {
        "bare loop": bare_loop(seconds),
        "modem lines per frame": real_lines(seconds, free=False),
        "modem lines free, own thread": real_lines(seconds, free=True),
    }
    table(f"Real time, {seconds:g} s, simulated lines (no limit: it tells of this computer)", rows)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--real-seconds", type=float, default=10.0)
    parser.add_argument("--real-only", action="store_true")
    options = parser.parse_args()
    locked, once = ({}, {}) if options.real_only else simulated()
    found = {
        "simulated": locked,
        "compared": once,
        "real": real(options.real_seconds),
        "python": platform.python_version(),
    }
    print(json.dumps(found))
    return 0 if all(within(row) for row in locked.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
