"""Observers by name: what they write is true of what lies on disk, and one that dies or stands still is said."""

from __future__ import annotations

import csv
import os
import signal
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile

from acquire.frame import FrameHeader
from acquire.observe import Observer, known_observer
from acquire.ome_zarr import FocalArray
from acquire.ring import RingReader, RingWriter
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import PlanError, StoreError
from processing import watchers

if TYPE_CHECKING:
    from pathlib import Path

PLANES, SHAPE = 6, (40, 48)
MANIFEST = {"plan_id": "p", "name": "watched", "camera": {"bit_depth": 12}}


def picture(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 4000, SHAPE).astype(np.uint16)


class Watched:
    """A run being written, frame by frame, through a ring."""

    def __init__(self, folder: Path) -> None:
        clock = SystemClock()
        layout = FocalArray(PLANES, SHAPE, "uint16", 0.0, 0.5, 0.65)
        self.folder = folder / "run"
        self.store = RunStore.create(self.folder, MANIFEST, layout, clock)
        self.ring = RingWriter.create("test", SHAPE, "uint16", 4, clock=clock, folder=folder)
        self.keeper = RingReader.attach(self.ring.path, "lossless", clock=clock)

    def take_all(self) -> None:
        """At full speed: an observer overlooks some of them."""
        for k in range(PLANES):
            self.ring.push(picture(k), FrameHeader(k, 0.5 * k, 0.5 * k + 0.01, 1.0, arrival_ns=k + 1))
            frame = self.keeper.read(10.0)
            assert frame is not None
            self.store.put(frame)
            self.keeper.release()
        self.store.finalise(RunEnd.COMPLETED)
        for part in (self.keeper, self.ring, self.store):
            part.close()


def watched_by(name: str, folder: Path) -> Path:
    """Let an observer watch in a thread of this process, and return where it wrote."""
    run, ready = Watched(folder), threading.Event()
    observe = known_observer(name).load()
    thread = threading.Thread(target=observe, args=[run.ring.path, run.folder, folder / name, {}, ready.set])
    thread.start()
    assert ready.wait(60)
    run.take_all()
    thread.join(60)
    assert not thread.is_alive()
    return folder / name


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_statistics_are_those_of_every_plane(tmp_path):
    told = rows(watched_by("statistics", tmp_path) / "statistics.csv")
    assert [float(row["mean"]) for row in told] == pytest.approx([picture(k).mean() for k in range(PLANES)], rel=1e-5)
    assert [float(row["max"]) for row in told] == [picture(k).max() for k in range(PLANES)]
    assert [float(row["z_um"]) for row in told] == pytest.approx([0.5 * k + 0.01 for k in range(PLANES)])


def test_the_histogram_counts_every_pixel_once(tmp_path):
    told = rows(watched_by("histogram", tmp_path) / "histogram.csv")
    every = np.stack([picture(k) for k in range(PLANES)])
    assert [int(float(row["pixels"])) for row in told] == np.histogram(every, 256, (0, 4096))[0].tolist()


def test_focus_scores_are_those_of_the_autofocus(tmp_path):
    told = rows(watched_by("focus-score", tmp_path) / "focus_score.csv")
    expected = [watchers.focus_energy(picture(k)) for k in range(PLANES)]
    assert [float(row["score"]) for row in told] == pytest.approx(expected)


def test_the_reslice_is_the_middle_row_of_every_plane(tmp_path):
    out = watched_by("reslice", tmp_path)
    np.testing.assert_array_equal(tifffile.imread(out / "reslice.tif"), [picture(k)[20] for k in range(PLANES)])
    assert (out / "reslice.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("signum", "words"), [(signal.SIGKILL, "failed"), (signal.SIGSTOP, "stood still")])
def test_an_observer_that_dies_or_stands_still_is_dropped_and_said(tmp_path, signum, words):
    run = Watched(tmp_path)
    observer = Observer("statistics", run.ring.path, run.folder, tmp_path / "out", {})
    assert observer.wait_until_ready(110)
    os.kill(observer._process.pid, signum)
    run.take_all()
    said = observer.finish(60)
    assert said.startswith("statistics")
    assert words in said


def test_an_unknown_observer_is_refused():
    with pytest.raises(PlanError, match="no observer is called 'statistic'"):
        known_observer("statistic")


def test_an_observer_that_comes_after_the_run_has_every_plane_from_the_disk(tmp_path):
    run = Watched(tmp_path)
    run.take_all()
    known_observer("statistics").load()(run.ring.path, run.folder, tmp_path / "out", {}, lambda: None)
    assert len(rows(tmp_path / "out" / "statistics.csv")) == PLANES


def test_what_is_no_ring_is_said(tmp_path):
    run = Watched(tmp_path)
    run.take_all()
    (tmp_path / "x.ring").write_bytes(b"something else")
    with pytest.raises(StoreError, match="not a frame ring"):
        known_observer("statistics").load()(tmp_path / "x.ring", run.folder, tmp_path / "out", {}, lambda: None)
