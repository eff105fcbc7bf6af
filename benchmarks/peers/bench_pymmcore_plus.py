"""A software-z stack beside pymmcore-plus on the same DemoCamera and stage: overhead per plane, and four faults.

Both sides are driven over one core, take the same planes with the same exposure and keep nothing, so what differs is
the engine. Overhead is what a plane costs beyond a bare loop of the same core's calls; the three are interleaved.
Usage: bench_pymmcore_plus.py [planes] [rounds], or bench_pymmcore_plus.py faults
Needs the extra ``mm`` and, for the demo devices, the package mm-test-adapters.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import mm_test_adapters
import numpy as np
import tensorstore
import tifffile
import useq
from pymmcore_plus import CMMCorePlus

from acquire.engine import Policy, Run
from acquire.ome_zarr import FocalArray
from acquire.plan import StackPlan
from acquire.recorder import Recorder
from acquire.ring import RingWriter
from acquire.store import RunStore, open_run
from devices.clock import SystemClock
from devices.drivers.mm_camera import MicroManagerCamera
from devices.values import Limits

if TYPE_CHECKING:
    from acquire.store import RunEnd

EXPOSURE_MS = 1.0
KILLED_AT = 40
CONFIGURATION = """
Property,Core,Initialize,0
Device,Cam,DemoCamera,DCam
Device,Z,DemoCamera,DStage
Device,Sh,DemoCamera,DShutter
Property,Core,Initialize,1
Property,Core,Camera,Cam
Property,Core,Focus,Z
Property,Core,Shutter,Sh
Property,Core,AutoShutter,0
"""


class CoreStage:
    """The demo stage as a `devices.protocols.Stage`, over the same core."""

    limits = Limits(-300.0, 300.0)

    def __init__(self, core: CMMCorePlus) -> None:
        self._core = core

    def move_to(self, z_um: float) -> None:
        self.limits.check(z_um)
        self._core.setPosition(z_um)

    def settle(self, timeout_s: float) -> float:
        self._core.waitForDevice(self._core.getFocusDevice())
        return self.position_um()

    def position_um(self) -> float:
        return float(self._core.getPosition())

    def halt(self) -> None:
        self._core.stop(self._core.getFocusDevice())

    def close(self) -> None:
        pass


class Nowhere:
    """Takes frames and keeps only their planes."""

    def __init__(self) -> None:
        self.taken: list[int] = []

    durable = property(lambda self: len(self.taken))

    def check(self) -> None:
        pass

    def put(self, pixels: np.ndarray, header) -> None:
        pixels.copy()
        self.taken.append(header.plane)

    def missed(self, missed) -> None:
        pass

    def finish(self, end: RunEnd, reason: str = "") -> RunEnd:
        return end


def demo_core() -> CMMCorePlus:
    core = CMMCorePlus()
    core.setDeviceAdapterSearchPaths([str(mm_test_adapters.device_adapter_path())])
    with tempfile.NamedTemporaryFile("w", suffix=".cfg", delete=False) as file:
        file.write(CONFIGURATION)
    core.loadSystemConfiguration(file.name)
    core.definePixelSizeConfig("lens", "Cam", "Binning", "1")
    core.setPixelSizeUm("lens", 0.5)
    core.setPixelSizeConfig("lens")
    return core


def peer(core: CMMCorePlus, planes: int) -> None:
    events = [
        useq.MDAEvent(index={"z": k}, z_pos=-0.5 * planes / 2 + 0.5 * k, exposure=EXPOSURE_MS) for k in range(planes)
    ]
    core.mda.engine.use_hardware_sequencing = False
    taken: list[np.ndarray] = []

    def keep(image: np.ndarray, *_: object) -> None:
        taken.append(image.copy())
        taken.clear()

    core.mda.events.frameReady.connect(keep)
    try:
        core.mda.run(events)
    finally:
        core.mda.events.frameReady.disconnect(keep)


def ours(camera, stage: CoreStage, planes: int) -> None:
    plan = StackPlan(round(-250 * planes), 500, planes, EXPOSURE_MS)
    out = Nowhere()
    state = Run(plan, stage, camera, out, SystemClock(), policy=Policy()).execute()
    assert str(state) == "COMPLETED", state
    assert out.taken == list(range(planes))


def bare(core: CMMCorePlus, planes: int) -> None:
    """What the devices themselves cost."""
    for k in range(planes):
        core.setPosition(-0.25 * planes + 0.5 * k)
        core.waitForDevice("Z")
        core.snapImage()
        core.getImage().copy()


def cost(do, planes: int) -> tuple[float, float]:
    """Wall and CPU milliseconds per plane beyond the exposure."""
    wall, cpu = time.perf_counter(), time.process_time()
    do()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return 1000 * wall / planes - EXPOSURE_MS, 1000 * cpu / planes


def overhead(planes: int, rounds: int) -> None:
    core = demo_core()
    core.setExposure(EXPOSURE_MS)
    camera = MicroManagerCamera(core, SystemClock())
    stage = CoreStage(core)
    peer(core, 10), ours(camera, stage, 10)
    floor, theirs, own = [], [], []
    for _ in range(rounds):
        floor.append(cost(lambda: bare(core, planes), planes))
        theirs.append(cost(lambda: peer(core, planes), planes))
        own.append(cost(lambda: ours(camera, stage, planes), planes))
    for name, column in (("wall", 0), ("CPU", 1)):
        a, b, c = (median(run[column] for run in runs) for runs in (own, theirs, floor))
        words = f"ours {a:.2f} ms, pymmcore-plus {b:.2f} ms a plane, of which the devices {c:.2f} ms"
        print(f"{name}: {words}; ratio of what is beyond them {(a - c) / (b - c):.2f}", flush=True)


class Failing:
    """A core whose snap fails: the fifth time, or from the fifth time on."""

    def __init__(self, core: CMMCorePlus, *, for_good: bool) -> None:
        self._snap, self._for_good, self._snaps = core.snapImage, for_good, 0
        core.snapImage = self.snap

    def snap(self) -> None:
        self._snaps += 1
        if self._snaps == 5 or (self._for_good and self._snaps > 5):
            raise RuntimeError("the camera did not answer")
        self._snap()


def fault_in_peer(*, for_good: bool) -> str:
    core = demo_core()
    Failing(core, for_good=for_good)
    try:
        peer(core, 10)
    except Exception as error:  # noqa: BLE001  whatever it ends with is the result
        return f"raised {type(error).__name__}"
    return str(core.mda.status.finish_reason).rpartition(".")[2]


def fault_in_ours(*, for_good: bool) -> str:
    core = demo_core()
    Failing(core, for_good=for_good)
    plan, out = StackPlan(-2500, 500, 10, EXPOSURE_MS), Nowhere()
    run = Run(plan, CoreStage(core), MicroManagerCamera(core, SystemClock()), out, SystemClock())
    state = run.execute()
    return f"{state}, {len(out.taken)} planes kept, error: {run.error}"


def store_peer(path: str, planes: int) -> None:
    core = demo_core()
    core.setExposure(EXPOSURE_MS)
    sequence = useq.MDASequence(z_plan={"range": 0.5 * (planes - 1), "step": 0.5}, channels=[])
    core.mda.engine.use_hardware_sequencing = False
    core.mda.events.frameReady.connect(lambda *_: print("plane", flush=True))
    core.mda.run(sequence, output=path)
    print(str(core.mda.status.finish_reason).rpartition(".")[2], flush=True)


def store_ours(path: str, planes: int) -> None:
    core = demo_core()
    camera, clock = MicroManagerCamera(core, SystemClock()), SystemClock()
    plan, caps = StackPlan(0, 500, planes, EXPOSURE_MS), camera.caps()
    layout = FocalArray(planes, caps.shape, caps.dtype, 0.0, 0.5, None, compression="none")
    store = RunStore.create(Path(path), {"name": "t", "plan_id": plan.plan_id, "plan": plan.canonical()}, layout, clock)
    ring = RingWriter.create("bench", caps.shape, caps.dtype, 8, clock=clock)
    tell = lambda event: print("plane", flush=True) if event["event"] == "plane" else None  # noqa: E731
    run = Run(plan, CoreStage(core), camera, Recorder(store, ring, clock), clock, tell=tell)
    print(f"{run.execute()}: {run.error}", flush=True)


def on_small_disk(mode: str, name: str) -> str:
    """Let a child write 50 planes of half a megabyte to a disk of 8 MB, which only root can make."""
    with tempfile.TemporaryDirectory() as folder:
        mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "none", folder]
        if subprocess.run(mount, capture_output=True, check=False).returncode:
            return "left out: no small disk can be made here"
        try:
            done = child(mode, str(Path(folder) / name), 50)
            return (done.stdout.strip().splitlines() or ["it said nothing"])[-1]
        finally:
            subprocess.run(["umount", folder], check=False)


def killed(mode: str, name: str) -> str:
    """Kill a child that writes 400 planes when it has told of 40 of them, and say what is left and what it says."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        process = subprocess.Popen(
            [sys.executable, __file__, mode, str(path), "400"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert process.stdout is not None
        told = sum(1 for _ in islice(process.stdout, KILLED_AT))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        return f"of {told} planes told of: {left_of(path)}"


def left_of(path: Path) -> str:
    """What the format's own readers find, and whether anything says that the run did not end."""
    if path.suffix == ".tiff":
        try:
            with tifffile.TiffFile(path) as tiff:
                shape = tiff.series[0].shape if tiff.series else ()
                return f"{len(tiff.pages)} readable of {path.stat().st_size / 1e6:.0f} MB, series of shape {shape}"
        except Exception as error:  # noqa: BLE001  whatever a reader raises is the result
            return f"unreadable ({type(error).__name__})"
    if path.suffix == ".zarr":
        return zarr_left(path)
    stored = open_run(path)
    return f"{stored.state}, {len(stored.planes)} durable and verified, {len(stored.missing)} named as missing"


def zarr_left(path: Path) -> str:
    try:
        array = tensorstore.open({"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path / "0")}}).result()
        filled = sum(bool(np.any(array[k].read().result())) for k in range(array.shape[0]))
    except Exception as error:  # noqa: BLE001  whatever a reader raises is the result
        return f"unreadable ({type(error).__name__})"
    return f"shape {tuple(array.shape)}, {filled} planes with pixels, the rest reads as black"


def child(mode: str, path: str, planes: int) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, __file__, mode, path, str(planes)], capture_output=True, text=True, check=False
    )


def faults() -> None:
    print("| fault | pymmcore-plus says | here |\n|---|---|---|", flush=True)
    for words, for_good in (("one snap fails", False), ("the camera dies", True)):
        print(f"| {words} | {fault_in_peer(for_good=for_good)} | {fault_in_ours(for_good=for_good)} |", flush=True)
    full = on_small_disk("store-peer", "a.ome.tiff"), on_small_disk("store-ours", "run")
    print(f"| the disk is full after a third | {full[0]} | {full[1]} |", flush=True)
    own = killed("store-ours", "run")
    for words, name in (("OME-TIFF", "a.ome.tiff"), ("OME-Zarr", "a.ome.zarr")):
        print(f"| kill -9, {words} there | {killed('store-peer', name)} | {own} |", flush=True)


def main(arguments: list[str]) -> None:
    match arguments:
        case ["store-peer", path, planes]:
            store_peer(path, int(planes))
        case ["store-ours", path, planes]:
            store_ours(path, int(planes))
        case ["faults"]:
            faults()
        case _:
            overhead(*(int(argument) for argument in arguments or ("200", "5")))
            faults()


if __name__ == "__main__":
    main(sys.argv[1:])
