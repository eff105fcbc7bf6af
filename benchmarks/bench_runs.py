"""What a run costs beside its exposures and moves, how fast it writes safely, what it keeps, how soon it stops.

Run: ``python benchmarks/bench_runs.py [WORD ...]``, all rows or those whose name holds a word. The real stage driver
over the twin's own bytes, real time, the whole way to the disk. Limits are ratios to what the same work costs without
us, in turns in the same run. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests")]

from killing import CHANGES, World, far_rig  # noqa: E402  they lie beside the tests
from near import Near  # noqa: E402
from sections import BENCH, files  # noqa: E402

from acquire.engine import Run  # noqa: E402
from acquire.frame import Frame, FrameHeader  # noqa: E402
from acquire.ome_zarr import FocalArray  # noqa: E402
from acquire.plan import StackPlan  # noqa: E402
from acquire.recorder import GROUP, Recorder  # noqa: E402
from acquire.ring import RingWriter  # noqa: E402
from acquire.run_plan import RunPlan, SeriesPlan  # noqa: E402
from acquire.store import SIDE_BY_SIDE, RunStore  # noqa: E402
from devices.clock import SystemClock  # noqa: E402
from devices.errors import LinkError  # noqa: E402
from devices.rig import load_rig  # noqa: E402
from devices.values import CameraCaps, Limits  # noqa: E402
from sim.camera import Replay, SimCamera  # noqa: E402
from sim.clock import SimClock  # noqa: E402
from sim.motion import Axis  # noqa: E402
from sim.stage import SimStage  # noqa: E402

CLOCK = SystemClock()
SHAPE = (256, 256)
FRAMES = np.random.default_rng(3).integers(0, 4096, (8, *SHAPE)).astype(np.uint16)
LARGE = (2048, 2048)
PLANES, MANY = 200, 10_000
EXPOSURE_MS = 20.0


def recorder(folder, planes, shape=SHAPE, sections=1):
    ring = RingWriter.create("bench", shape, "uint16", 16, clock=CLOCK)
    interval_s = None if sections == 1 else 1.0
    layout = FocalArray(planes, shape, "uint16", 0.0, 0.1, None, sections=sections, interval_s=interval_s)
    return Recorder(RunStore.create(folder, {"plan_id": "bench"}, layout, CLOCK), ring, CLOCK)


def world(folder, clock=CLOCK):
    instrument, _ = files(folder, BENCH)
    spec = load_rig(instrument, CHANGES)
    made = World(spec, clock)
    return spec, made, Near(made)


def own_moves_s(axis):
    """Let an axis count how long its own moves take."""
    taken, go = [0.0], axis.move_to

    def counted(z_um):
        go(z_um)
        taken[0] += axis.rests_at_s - CLOCK.now()

    axis.move_to = counted
    return taken


def software_stack(folder):
    """Total time of a software-z stack over exposures and the twin's own moves."""
    spec, made, near = world(folder)
    rig = far_rig(spec, CLOCK, near)
    moves_s = own_moves_s(made.axis)
    camera = SimCamera(Replay(FRAMES, CameraCaps("replay", *SHAPE, 1, "uint16", 12, timed=True)), made.axis)
    plan = StackPlan(-10_000, 100, PLANES, EXPOSURE_MS)
    out = recorder(folder / "stack", PLANES)
    run = Run(plan, rig.stage, camera, out, CLOCK)
    begin = CLOCK.now()
    assert run.execute() == "COMPLETED", run.error
    took_s = CLOCK.now() - begin
    return took_s / (PLANES * EXPOSURE_MS / 1000 + moves_s[0])


def safe_writing(folder, planes=24, rounds=4):
    """Bytes a second that are durable, over those of write and fdatasync of the same bytes to one file, in turns.

    Ours as a run does it that is as fast as it can: the records of eight planes together.
    """
    pixels = np.random.default_rng(1).integers(0, 4096, LARGE).astype(np.uint16)
    ours_s = raw_s = 0.0
    for number in range(rounds):
        begin = CLOCK.now()
        with (folder / "raw").open("wb", buffering=0) as raw:
            for _ in range(planes):
                raw.write(pixels.data)
                os.fdatasync(raw.fileno())
        raw_s += CLOCK.now() - begin
        layout = FocalArray(planes, LARGE, "uint16", 0.0, 1.0, None)
        store = RunStore.create(folder / f"store-{number}", {"plan_id": "bench"}, layout, CLOCK)
        begin = CLOCK.now()
        for plane in range(planes):
            store.put(Frame(plane, FrameHeader(plane, 0.0, 0.0, 1.0), pixels))
            if store.pending >= GROUP + SIDE_BY_SIDE:
                store.commit(leave=SIDE_BY_SIDE)
        store.commit()
        ours_s += CLOCK.now() - begin
        store.close()
        shutil.rmtree(folder / f"store-{number}")
    return raw_s / ours_s


def resident_mb():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory(folder):
    """MB gained from the first thousand planes to the last of ten thousand."""
    clock, seen = SimClock(), {}
    axis = Axis(clock, Limits(-1e3, 1e3))
    caps = CameraCaps("replay", 32, 32, 1, "uint16", 12, timed=True)
    camera = SimCamera(Replay(FRAMES[:, :32, :32].copy(), caps), axis)
    plan = RunPlan(StackPlan(0, 0, 1, 1.0), series=SeriesPlan(MANY, 1.0))

    def tell(event):
        if event["event"] == "plane" and event["section"] in (MANY // 10, MANY - 1):
            seen[event["section"]] = resident_mb()

    out = recorder(folder / "many", MANY, (32, 32), sections=MANY)
    run = Run(plan, SimStage(axis), camera, out, clock, tell=tell)
    assert run.execute() == "COMPLETED", run.error
    return seen[MANY - 1] - seen[MANY // 10]


def cancelling(folder):
    """Worst ms from `cancel`, given at some time within an exposure, to the end of the run, over the exposure."""
    worst = 0.0
    for part in range(5):
        spec, made, near = world(folder)
        rig = far_rig(spec, CLOCK, near)
        camera = SimCamera(Replay(FRAMES, CameraCaps("replay", *SHAPE, 1, "uint16", 12, timed=True)), made.axis)
        out = recorder(folder / f"cancel-{part}", 50)
        begun = threading.Event()
        run = Run(StackPlan(0, 100, 50, 100.0), rig.stage, camera, out, CLOCK, tell=lambda _, begun=begun: begun.set())
        thread = threading.Thread(target=run.execute)
        thread.start()
        begun.wait()
        CLOCK.sleep(0.5 + 0.02 * part)
        begin = CLOCK.now()
        run.cancel()
        thread.join()
        worst = max(worst, 1000 * (CLOCK.now() - begin) - 100.0)
    return worst


def stopping(folder):
    """Worst ms from `stop` of a run in work to the bytes that halt stage and feed, while both are talked to."""
    spec, made, near = world(folder)
    rig = far_rig(spec, CLOCK, near)
    camera = SimCamera(Replay(FRAMES, CameraCaps("replay", *SHAPE, 1, "uint16", 12, timed=True)), made.axis)
    over, heard, worst = threading.Event(), {}, 0.0
    near.on_wire = lambda what, given: heard.setdefault(what, CLOCK.now()) if halts(what, given) else None
    asks = (rig.stage.position_um, rig.feed.position_nm)
    talkers = [threading.Thread(target=talk, args=[ask, over], daemon=True) for ask in asks]
    for talker in talkers:
        talker.start()
    for part in range(20):
        begun = threading.Event()
        out = recorder(folder / f"stop-{part}", 50)
        tell = lambda _, begun=begun: begun.set()  # noqa: E731
        run = Run(StackPlan(-50_000, 2000, 50, 20.0), rig.stage, camera, out, CLOCK, feed=rig.feed, tell=tell)
        thread = threading.Thread(target=run.execute)
        thread.start()
        begun.wait()
        CLOCK.sleep(0.2 + 0.013 * part)
        heard.clear()
        begin = CLOCK.now()
        run.stop()
        worst = max(worst, *(1000 * (heard[what] - begin) for what in ("stage", "feed")))
        thread.join()
        assert run.status.state == "CANCELLED", run.error
    over.set()
    for talker in talkers:
        talker.join()
    return worst


def talk(ask, over):
    """Poll a device all the time, as no display does; one that is halted meanwhile may leave a question unanswered."""
    while not over.is_set():
        with suppress(LinkError):
            ask()


def halts(what, given):
    """Whether bytes are those of a halt: the ASI's backslash, any write to the mailbox."""
    return b"\\" in given[0] if what == "stage" else given[0][1:2] in (b"\x06", b"\x10")


ROWS = (
    (f"software-z stack of {PLANES} planes: time over exposures and moves", software_stack, "<= 1.05"),
    ("durable writing of 2048² planes over write + fdatasync", safe_writing, ">= 0.7"),
    (f"memory gained from plane {MANY // 10} to plane {MANY}, MB", memory, "<= 20"),
    ("cancel: ms beyond the exposure, worst of 5", cancelling, "<= 50"),
    ("stop: ms to the bytes of both halts, worst of 20", stopping, "<= 50"),
)


def main(words):
    logging.getLogger("devices").setLevel(logging.ERROR)  # each halt breaks into a conversation, which says so
    missed, figures = 0, {}
    for name, measure, limit in ROWS:
        if words and not any(word in name for word in words):
            continue
        folder = Path(tempfile.mkdtemp(prefix="stereotome-bench-"))
        try:
            value = figures[name] = round(float(measure(folder)), 4)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        sign, bound = limit.split()
        kept = value <= float(bound) if sign == "<=" else value >= float(bound)
        missed += not kept
        print(f"{name:66} {value:9.3f}  {limit:8} {'' if kept else 'MISSED'}", flush=True)
    print(json.dumps(figures))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
