"""Observers of a run that say something about each plane: statistics, focus score, histogram, and a cut through all.

Each is a process of its own, a reader that claims nothing: what it overlooks it reads from the run's folder once that
is complete, so its result lacks nothing. `processing.live` measures extended focus and range in the same way.
"""

from __future__ import annotations

import csv
import io
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
import tifffile

from acquire.measures import focus_energy, look_at
from acquire.ome_zarr import sync_folder
from acquire.ring import RingReader, WriterGone
from acquire.store import RunEnd, open_run
from devices.clock import SystemClock
from devices.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from acquire.frame import FrameHeader
    from acquire.store import StoredRun
    from devices.protocols import Clock

LOOK_S = 0.05
BINS = 256


class Collector(Protocol):
    """What an observer gathers: it is given each plane, in any order, a plane that was taken again once more."""

    def take(self, slot: int, header: FrameHeader, pixels: np.ndarray) -> None:
        """Take a plane."""
        ...

    def write(self, folder: Path) -> None:
        """Write what was gathered."""
        ...


class Statistics:
    """Mean, deviation, extremes, saturation and focus of each plane: ``statistics.csv``."""

    def __init__(self, run: StoredRun) -> None:
        self._rows: dict[int, tuple[float, ...]] = {}
        self._top = (1 << int(run.manifest["camera"]["bit_depth"])) - 1

    def take(self, slot: int, header: FrameHeader, pixels: np.ndarray) -> None:
        """Measure a plane."""
        look = look_at(pixels, self._top)
        extremes = float(pixels.min()), float(pixels.max())
        self._rows[slot] = (
            header.section,
            header.band,
            header.plane,
            header.z_um,
            look.mean,
            look.sd,
            *extremes,
            look.saturated,
        )

    def write(self, folder: Path) -> None:
        """Write the table."""
        head = ("slot", "section", "band", "plane", "z_um", "mean", "sd", "min", "max", "saturated")
        keep_csv(folder / "statistics.csv", head, ((slot, *row) for slot, row in sorted(self._rows.items())))


class FocusScore:
    """The energy of gradients of each plane, by which a stack finds its focus: ``focus_score.csv``."""

    def __init__(self, run: StoredRun) -> None:  # noqa: ARG002  all are made alike
        self._rows: dict[int, tuple[float, ...]] = {}

    def take(self, slot: int, header: FrameHeader, pixels: np.ndarray) -> None:
        """Score a plane."""
        self._rows[slot] = (header.section, header.band, header.plane, header.z_um, focus_energy(pixels))

    def write(self, folder: Path) -> None:
        """Write the table."""
        head = ("slot", "section", "band", "plane", "z_um", "score")
        keep_csv(folder / "focus_score.csv", head, ((slot, *row) for slot, row in sorted(self._rows.items())))


class Histogram:
    """How often each grey value occurs in all planes: ``histogram.csv``, 256 bins over the camera's range."""

    def __init__(self, run: StoredRun) -> None:
        self._range = (0, 1 << int(run.manifest["camera"]["bit_depth"]))
        self._counts: dict[int, np.ndarray] = {}

    def take(self, slot: int, header: FrameHeader, pixels: np.ndarray) -> None:  # noqa: ARG002  a Collector's
        """Count a plane."""
        self._counts[slot] = np.histogram(pixels, BINS, self._range)[0]

    def write(self, folder: Path) -> None:
        """Write the counts."""
        edges = np.linspace(*self._range, BINS + 1)
        total = np.sum(list(self._counts.values()), axis=0) if self._counts else np.zeros(BINS)
        keep_csv(folder / "histogram.csv", ("from", "to", "pixels"), zip(edges[:-1], edges[1:], total, strict=True))


class Reslice:
    """The cut x-z through the middle row of all planes of the first band: ``reslice.tif`` and a picture of it.

    Rows are planes in the order of the plan, section after section; what was not taken is black.
    """

    def __init__(self, run: StoredRun) -> None:
        layout = run.layout
        self._layout = layout
        self._cut = np.zeros((layout.sections * layout.planes_each, *layout.shape[1:]), layout.dtype)

    def take(self, slot: int, header: FrameHeader, pixels: np.ndarray) -> None:
        """Keep the middle row of a plane."""
        if header.band == 0:
            section, _, plane = self._layout.place(slot)
            self._cut[section * self._layout.planes_each + plane] = pixels[len(pixels) // 2]

    def write(self, folder: Path) -> None:
        """Write the cut."""
        file = io.BytesIO()
        tifffile.imwrite(file, self._cut)
        _keep(folder / "reslice.tif", file.getvalue())
        shown = (self._cut * (255 / max(int(self._cut.max()), 1))).astype(np.uint8)
        _keep(folder / "reslice.png", cv2.imencode(".png", shown)[1].tobytes())


def keep_csv(path: Path, head: tuple[str, ...], rows: Iterable[Iterable[object]]) -> None:
    """Write a table in one durable step."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(head)
    table.writerows(rows)
    _keep(path, text.getvalue().encode())


def _keep(path: Path, content: bytes) -> None:
    """Write a file in one durable step; `processing.outputs` does the same, but takes seconds to load."""
    part = path.with_name(f".part-{path.name}")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)


def wait_for_end(run: StoredRun, clock: Clock) -> None:
    """Wait until the run has written its last word, or its process died."""
    while run.state is RunEnd.RUNNING:
        clock.sleep(LOOK_S)
        run.refresh()


def statistics(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:  # noqa: ARG001
    """Observe `Statistics`; see `acquire.observe`."""
    watch(ring, run, out, ready, Statistics)


def focus_score(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:  # noqa: ARG001
    """Observe `FocusScore`; see `acquire.observe`."""
    watch(ring, run, out, ready, FocusScore)


def histogram(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:  # noqa: ARG001
    """Observe `Histogram`; see `acquire.observe`."""
    watch(ring, run, out, ready, Histogram)


def reslice(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:  # noqa: ARG001
    """Observe `Reslice`; see `acquire.observe`."""
    watch(ring, run, out, ready, Reslice)


@contextmanager
def joined(ring: Path, clock: Clock) -> Iterator[RingReader | None]:
    """Join a run's ring; None when it is gone, because the run was over before: then everything is on the disk.

    Raises
    ------
    StoreError
        It is no ring of this version, or has no room for another reader.
    """
    try:
        reader = RingReader.attach(ring, "latest", clock=clock)
    except StoreError:
        if ring.exists():
            raise
        yield None
    else:
        with reader:
            yield reader


def watch(
    ring: Path, folder: Path, out: Path, ready: Callable[[], None], make: Callable[[StoredRun], Collector]
) -> None:
    """Give a collector every plane of a run, as they come and from the disk, then let it write."""
    clock = SystemClock()
    run = open_run(folder)
    collector = make(run)
    seen: dict[int, int] = {}
    with joined(ring, clock) as reader:
        ready()
        while reader is not None:
            try:
                frame = reader.read(LOOK_S)
            except WriterGone:
                break
            if frame is not None:
                slot = run.layout.slot_of(frame.header)
                collector.take(slot, frame.header, frame.pixels)
                seen[slot] = frame.header.arrival_ns
    wait_for_end(run, clock)
    run.refresh()
    for slot, record in run.planes.items():
        if seen.get(slot) != record.header.arrival_ns:  # overlooked, or taken again since
            collector.take(slot, record.header, run.read(slot))
    out.mkdir(parents=True, exist_ok=True)
    collector.write(out)
