"""Live focus through a real ring and a real run folder: complete, in order, and the same bits as the batch."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from acquire.frame import FrameHeader
from acquire.observe import Observer
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
        self.store = RunStore.create(self.folder, {"plan_id": "p", "name": "live"}, layout, clock)
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


@pytest.mark.parametrize(("method", "bands"), [("brightfield", (3,)), ("confocal", ())])
def test_observer_writes_what_the_command_writes(tmp_path, method, bands):
    bench = Bench(tmp_path, bands)
    out = bench.folder / "focus"
    observer = Observer("focus", bench.ring.path, bench.folder, out, {"method": method})
    assert observer.wait_until_ready(200)
    for k, pixels in enumerate(pictures(bands)):  # at full speed: the observer overlooks some of them
        bench.show(k, pixels)
    bench.end()
    assert observer.finish(60) == ""
    expected = from_disk(bench.folder, method)
    np.testing.assert_array_equal(tifffile.imread(out / "range.tif"), expected.range)
    np.testing.assert_array_equal(tifffile.imread(out / "confidence.tif"), expected.confidence)
    np.testing.assert_array_equal(tifffile.imread(out / "extended_focus.tif"), expected.extended_focus)
    report = json.loads((out / "report.json").read_text())
    assert report["unit"] == "um"
    assert report["input"]["planes"] == PLANES


def live_on(bench: Bench) -> LiveFocus:
    return LiveFocus(open_run(bench.folder), {"method": "brightfield"})


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

    result, _ = follow_run(path, bench.folder, options={"method": "brightfield"}, ready=cancel, clock=SystemClock())
    assert ready
    np.testing.assert_array_equal(result.range, from_disk(bench.folder).range)


def test_run_without_a_plane_is_said(tmp_path):
    bench = Bench(tmp_path)
    with pytest.raises(InputError):
        follow_run(
            bench.ring.path,
            bench.folder,
            options={"method": "confocal"},
            ready=lambda: bench.end(RunEnd.CANCELLED),
            clock=SystemClock(),
        )


def test_an_observer_that_comes_after_the_run_measures_it_from_the_disk(tmp_path):
    bench = Bench(tmp_path)
    for k, pixels in enumerate(pictures()):
        bench.show(k, pixels)
    bench.end()
    found, _ = follow_run(
        bench.ring.path, bench.folder, options={"method": "brightfield"}, ready=lambda: None, clock=SystemClock()
    )
    np.testing.assert_array_equal(found.range, from_disk(bench.folder).range)
