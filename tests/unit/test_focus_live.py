"""Live focus through a real ring and a real run folder: complete, in order, and the same bits as the batch."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from acquire.frame import FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.ring import RingReader, RingWriter
from acquire.store import RunEnd, RunStore, open_run
from devices.clock import SystemClock
from devices.errors import InputError
from processing.focus import focus_stack
from processing.live import LiveFocus, follow_run
from processing.stack import open_stack

SHAPE = (48, 64)
PLANES = 9
WATCHER = """
import sys
from pathlib import Path
import numpy as np
from processing.live import follow_run
ring, folder, out, method = sys.argv[1:]
result = follow_run(Path(ring), Path(folder), method=method, ready=lambda: print("ready", flush=True))
np.savez(out, range=result.range, focus=result.extended_focus, plane=result.plane, confidence=result.confidence)
"""


def pictures(bands: tuple[int, ...] = ()) -> np.ndarray:
    rng = np.random.default_rng(4)
    grain = rng.normal(size=(*SHAPE, *bands))
    best = np.linspace(2, 6, SHAPE[1]).reshape(1, -1, *[1] * len(bands))
    planes = [120 + 40 * grain / (1 + (k - best) ** 2) for k in range(PLANES)]
    return np.clip(planes, 0, 255).astype(np.uint8)


class Bench:
    """A run being written: frames go into the ring and, one by one or later, into the store."""

    def __init__(self, folder: Path, bands: tuple[int, ...] = ()) -> None:
        clock = SystemClock()
        layout = FocalArray(PLANES, (*SHAPE, *bands), "uint8", 10.0, -0.5, 0.65)
        self.folder = folder / "run"
        self.store = RunStore(self.folder, {"plan_id": "p", "name": "live"}, layout, clock)
        self.ring = RingWriter.create("test", layout.shape, "uint8", 4, clock=clock, folder=folder)
        self.keeper = RingReader.attach(self.ring.path, "lossless", clock=clock)

    def show(self, k: int, pixels: np.ndarray) -> None:
        header = FrameHeader(plane=k, setpoint_um=10 - 0.5 * k, z_um=10.01 - 0.5 * k, exposure_ms=1)
        self.ring.push(pixels, header)
        frame = self.keeper.read(1.0)
        assert frame is not None
        self.store.put(frame)
        self.keeper.release()

    def end(self, end: RunEnd = RunEnd.COMPLETED) -> None:
        self.store.finalise(end)
        self.close()

    def close(self) -> None:
        self.keeper.close()
        self.ring.close()
        self.store.close()


def from_disk(folder: Path, method: str = "brightfield"):
    stack = open_stack(folder)
    return focus_stack(stack, z_um=stack.z_um, method=method, register=False)  # type: ignore[arg-type]


def assert_same(found, expected) -> None:
    np.testing.assert_array_equal(found["range"], expected.range)
    np.testing.assert_array_equal(found["focus"], expected.extended_focus)
    np.testing.assert_array_equal(found["plane"], expected.plane)
    np.testing.assert_array_equal(found["confidence"], expected.confidence)


@pytest.mark.parametrize(("method", "bands"), [("brightfield", ()), ("brightfield", (3,)), ("confocal", ())])
def test_watcher_in_its_own_process_gives_the_same_bits(tmp_path, method, bands):
    bench = Bench(tmp_path, bands)
    out = tmp_path / "live.npz"
    arguments = [str(bench.ring.path), str(bench.folder), str(out), method]
    with subprocess.Popen([sys.executable, "-c", WATCHER, *arguments], stdout=subprocess.PIPE) as watcher:
        assert watcher.stdout is not None
        assert watcher.stdout.readline() == b"ready\n"
        for k, pixels in enumerate(pictures(bands)):  # at full speed: the watcher overlooks some of them
            bench.show(k, pixels)
        bench.end()
        assert watcher.wait(60) == 0
    with np.load(out) as found:
        assert_same(found, from_disk(bench.folder, method))


def live_on(bench: Bench) -> LiveFocus:
    return LiveFocus(open_run(bench.folder), "brightfield")


def seen_by(bench: Bench, live: LiveFocus, watched: set[int], stack: np.ndarray) -> None:
    """Take a run of which the live reader sees only some frames."""
    with RingReader.attach(bench.ring.path, "latest", clock=SystemClock()) as reader:
        for k, pixels in enumerate(stack):
            bench.show(k, pixels)
            if k in watched:
                frame = reader.read(1.0)
                assert frame is not None
                live.take(frame)


def test_overlooked_planes_come_from_the_disk_once_durable(tmp_path):
    bench = Bench(tmp_path)
    live = live_on(bench)
    seen_by(bench, live, {0, 4, PLANES - 1}, pictures())
    assert not live.complete  # shown, stored, but not committed
    assert live.result() is None
    bench.store.commit()
    live.advance()
    assert live.complete
    bench.end()
    np.testing.assert_array_equal(live.result().range, from_disk(bench.folder).range)


def test_missed_plane_leaves_its_place_empty(tmp_path):
    bench = Bench(tmp_path)
    live = live_on(bench)
    with RingReader.attach(bench.ring.path, "latest", clock=SystemClock()) as reader:
        for k, pixels in enumerate(pictures()):
            if k == 3:
                bench.store.journal.append({"e": "missed", "section": 0, "plane": 3, "reason": "camera-timeout"})
                continue
            bench.show(k, pixels)
            live.take(reader.read(1.0))
    assert live.complete
    bench.end(RunEnd.COMPLETED_WITH_GAPS)
    found, expected = live.result(), from_disk(bench.folder)
    np.testing.assert_array_equal(found.range, expected.range)
    assert found.unit == "um"


def test_cancelled_run_is_measured_from_its_folder(tmp_path):
    bench = Bench(tmp_path)
    path, ready = bench.ring.path, []

    def cancel() -> None:
        ready.append(True)
        for k, pixels in enumerate(pictures()[:5]):
            bench.show(k, pixels)
        bench.end(RunEnd.CANCELLED)

    result = follow_run(path, bench.folder, method="brightfield", ready=cancel)
    assert ready
    np.testing.assert_array_equal(result.range, from_disk(bench.folder).range)


def test_run_without_a_plane_is_said(tmp_path):
    bench = Bench(tmp_path)
    with pytest.raises(InputError):
        follow_run(bench.ring.path, bench.folder, method="confocal", ready=lambda: bench.end(RunEnd.CANCELLED))
