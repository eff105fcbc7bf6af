"""How fast the ring is beside a plain copy, how late its frames come, and whether it keeps its promises under stress.

Run: ``python benchmarks/bench_ring.py``. Every speed is a ratio to `numpy.copyto` of the same frames, measured in
turns within the same run. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from acquire.frame import FrameHeader
from acquire.ring import RingReader, RingWriter, WriterGone
from devices.clock import SystemClock

BIG = (2048, 2048)
SMALL = (512, 512)
SLOTS = 8
BATCH = 60
REPEATS = 15
PACED_FRAMES = 150
FRAME_S = 1 / 30
STRESS_FRAMES = 20_000
IDLE_S = 2.0
CLOCK = SystemClock()
HEADER = FrameHeader(plane=0, setpoint_um=0.0, z_um=0.0, exposure_ms=1.0)


def main() -> int:
    """Measure everything, print it, and say whether the limits are kept."""
    rows = [*push_overhead(), *throughput(), *latency("lossless", "<= 2"), *latency("latest", ""), *idle(), *stress()]
    print(f"{'what':<58} {'measured':>10}  limit")
    for name, value, limit in rows:
        verdict = "" if kept(value, limit) else "  MISSED"
        print(f"{name:<58} {value:>10.4g}  {limit}{verdict}")
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    print(json.dumps({"benchmark": "ring", **machine, **{name: value for name, value, _ in rows}}))
    return 0 if all(kept(value, limit) for _, value, limit in rows) else 1


def kept(value: float, limit: str) -> bool:
    """Return whether a value keeps a limit written as ``>= 0.7``; an empty limit is always kept."""
    if not limit:
        return True
    relation, number = limit.split()
    return {">=": value >= float(number), "<=": value <= float(number), "==": value == float(number)}[relation]


@contextmanager
def reader(path, kind, task):
    """Run a reader in a process of its own; yields a function that returns its report once the ring is closed."""
    command = [sys.executable, __file__, "reader", str(path), kind, task]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout.readline() == "ready\n"
            yield lambda: json.loads(child.stdout.readline())
        finally:
            child.kill()


def timed(work):
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def push_overhead():
    """What `push` costs beside the copy, for a small frame."""
    pixels = np.ones(SMALL, np.uint16)
    plain = [np.zeros(SMALL, np.uint16) for _ in range(SLOTS)]
    with RingWriter.create("bench", SMALL, "uint16", SLOTS, clock=CLOCK) as writer:

        def push():
            for _ in range(200):
                writer.push(pixels, HEADER)

        def copy():
            for i in range(200):
                np.copyto(plain[i % SLOTS], pixels)

        extra_us = [(timed(push) - timed(copy)) / 200 * 1e6 for _ in range(REPEATS)]
    return [("push beside its copy, 512x512, us", statistics.median(extra_us), "<= 100")]


def throughput():
    """Frames per second through the ring to a zero-copy reader, as a share of what copying alone reaches."""
    pixels = np.ones(BIG, np.uint16)
    plain = [np.zeros(BIG, np.uint16) for _ in range(SLOTS)]
    writer = RingWriter.create("bench", BIG, "uint16", SLOTS, clock=CLOCK)
    with writer, reader(writer.path, "lossless", "touch") as report:

        def carry():
            for _ in range(BATCH):
                writer.push(pixels, HEADER)
            while writer.readers()[0].cursor < writer.published:
                CLOCK.sleep(0.0002)

        def copy():
            for i in range(BATCH):
                np.copyto(plain[i % SLOTS], pixels)

        timed(copy), timed(carry)
        times = [(timed(copy), timed(carry)) for _ in range(REPEATS)]
        writer.close()
        seen = report()
    ratios = sorted(copying / carrying for copying, carrying in times)
    rate = BATCH / statistics.median(carrying for _, carrying in times)
    return [
        (f"rate / copy rate, zero-copy reader, median of {REPEATS}", statistics.median(ratios), ">= 0.7"),
        (f"rate / copy rate, worst of {REPEATS}", ratios[0], ""),
        ("rate, 2048x2048 uint16, frames per s", rate, ""),
        ("frames published - received", writer.published - seen["received"], "== 0"),
    ]


def latency(kind, before_limit):
    """How late frames are at 30 per second: counted from before `push` copies them, and from their publication."""
    pixels = np.ones(BIG, np.uint16)
    writer = RingWriter.create("bench", BIG, "uint16", SLOTS, clock=CLOCK)
    with writer, reader(writer.path, kind, "latency") as report:
        due = CLOCK.now()
        for _ in range(PACED_FRAMES):
            due += FRAME_S
            CLOCK.sleep(due - CLOCK.now())
            before = time.monotonic_ns()
            with writer.slot() as slot:
                np.copyto(slot.pixels, pixels)
                times = {"exposure_end_ns": before, "arrival_ns": time.monotonic_ns()}
                slot.publish(FrameHeader(0, 0.0, 0.0, 1.0, **times))
        writer.close()
        late_ms = np.array(report()["late_ms"])
    (whole50, after50), (whole99, after99) = np.percentile(late_ms, [50, 99], axis=0)
    return [
        (f"late from before push, {kind}, p50 ms", whole50, before_limit),
        (f"late from before push, {kind}, p99 ms", whole99, ""),
        (f"late from publication, {kind}, p50 ms", after50, "<= 2"),
        (f"late from publication, {kind}, p99 ms", after99, ""),
    ]


def idle():
    """Processor time of a reader that waits for frames which do not come."""
    writer = RingWriter.create("bench", SMALL, "uint16", SLOTS, clock=CLOCK)
    with writer, RingReader.attach(writer.path, "latest", clock=CLOCK) as waiting:
        start = time.process_time()
        waiting.read(IDLE_S)
        return [("idle reader, % of one core", 100 * (time.process_time() - start) / IDLE_S, "<= 10")]


def stress():
    """Four readers lapped at full speed; then the same with the check after the copy left out."""
    checked, unchecked = lap("check"), lap("trust")
    gap = max(abs(STRESS_FRAMES - r["received"] - r["lost"]) for r in checked + unchecked)
    return [
        ("stress, 4 readers, 3 slots: frames published", STRESS_FRAMES, ""),
        ("stress: frames received, all readers", sum(r["received"] for r in checked), ""),
        ("stress: published - received - lost, worst reader", gap, "== 0"),
        ("stress: torn copies caught", sum(r["caught"] for r in checked), ">= 1"),
        ("stress: torn frames accepted", sum(r["torn"] for r in checked), "== 0"),
        ("control without the check: torn frames accepted", sum(r["torn"] for r in unchecked), ">= 1"),
    ]


def lap(task):
    """Publish at full speed to four readers of a ring of three slots and return what they report."""
    with ExitStack() as stack:
        writer = stack.enter_context(RingWriter.create("bench", SMALL, "uint16", 3, clock=CLOCK))
        reports = [stack.enter_context(reader(writer.path, "latest", task)) for _ in range(4)]
        for number in range(STRESS_FRAMES):
            with writer.slot() as slot:
                slot.pixels.fill(number)
                slot.publish(HEADER)
        writer.close()
        return [report() for report in reports]


class Trusting(RingReader):
    """The control: it believes every copy."""

    def _intact(self, *_):
        return True


def run_reader(path, kind, task):
    """Read to the end in this process and print what was seen."""
    late_ms, torn = [], 0
    with (Trusting if task == "trust" else RingReader).attach(Path(path), kind, clock=CLOCK) as ring:
        print("ready", flush=True)
        try:
            while True:
                frame = ring.read(60.0)
                if task == "latency":
                    now = time.monotonic_ns()
                    late_ms.append([(now - frame.header.exposure_end_ns) / 1e6, (now - frame.header.arrival_ns) / 1e6])
                elif task == "touch":
                    frame.pixels[::256, ::256].sum()
                else:
                    torn += bool((frame.pixels != frame.number).any())
        except WriterGone:
            seen = {"received": ring.received, "lost": ring.lost, "caught": ring.torn}
            print(json.dumps({**seen, "torn": torn, "late_ms": late_ms}), flush=True)


if __name__ == "__main__":
    sys.exit(run_reader(*sys.argv[2:]) if sys.argv[1:2] == ["reader"] else main())
