"""Sections aligned while a run takes them: each on arrival, the whole stack in one solution at the end.

An observer: ``live.csv`` has a line for every section as soon as it was imaged. When the run is
over the files follow that ``stereotome process align`` writes. Of a section with several planes the middle one counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.depths import depths_nm
from acquire.ring import WriterGone
from acquire.store import open_run
from devices.clock import SystemClock
from devices.errors import InputError
from processing.align_models import applied, deformation
from processing.align_stack import SectionAligner
from processing.readers import Recording
from processing.readers_run import NM_PER_UM, is_cut
from processing.stack import Stack
from processing.watchers import LOOK_S, joined, keep_csv, wait_for_end

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.frame import FrameHeader
    from acquire.ring import RingReader
    from acquire.store import StoredRun
    from processing.align_models import Model

    Array = NDArray[Any]

MODEL: Model = "rigid"  # one microscope sees all faces; sections that were cut off and lie compressed are no run
HEAD = ("section", "x_px", "y_px", "turn_deg", "correlation", "believed")
LOOKS = 10  # in vain at the ring before one at the disk: the journal of a long run takes time to read
WARM_SIDE = 96


class LiveAlignment:
    """The sections of a run, matched in the order in which they come.

    Parameters
    ----------
    run : StoredRun
        The run's folder, being written.
    out : Path
        Folder for ``live.csv``, then for all results.

    Raises
    ------
    InputError
        ``align-one``: the run has one section.
    """

    def __init__(self, run: StoredRun, out: Path) -> None:
        if run.layout.sections < 2:
            raise InputError("this run takes one section.", fix="align runs of two sections or more.", code="align-one")
        self._run, self._out = run, out
        self._middle = run.layout.planes_each // 2
        self._aligner: SectionAligner | None = SectionAligner(MODEL)
        self._sections: list[int] = []
        self._seen: dict[int, int] = {}
        self.newest = -1
        self._lines: list[tuple[object, ...]] = []
        warm()

    @property
    def owes(self) -> bool:
        """Whether a section was seen in the ring whose middle plane was not."""
        return self.newest not in self._seen

    def take(self, header: FrameHeader, pixels: Array) -> None:
        """Match a section with those before it; one that comes out of order is left to the end."""
        self.newest = max(self.newest, header.section)
        if header.band or header.plane != self._middle or self._aligner is None:
            return
        self._seen[header.section] = header.arrival_ns
        if self._sections and header.section < self._sections[-1]:
            self._aligner = None
            return
        if self._sections and header.section == self._sections[-1]:
            self._aligner.forget_last()
            self._sections.pop()
            self._lines.pop()
        matrix = self._aligner.add(pixels)
        self._sections.append(header.section)
        self._lines.append(self._line(header.section, matrix, pixels.shape))
        self._out.mkdir(parents=True, exist_ok=True)
        keep_csv(self._out / "live.csv", HEAD, self._lines)

    def catch_up(self) -> None:
        """Match what was overlooked in the ring and is on the disk, or was taken again since."""
        self._run.refresh()
        for slot in middle_slots(self._run):
            header = self._run.planes[slot].header
            if self._seen.get(header.section) != header.arrival_ns:
                self.take(header, self._run.read(slot))

    def _line(self, section: int, matrix: Array, shape: tuple[int, ...]) -> tuple[object, ...]:
        """Where the middle of the section lies, how it is turned, and how much it looks like the one before."""
        assert self._aligner is not None
        middle = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
        x, y = (applied(matrix, middle) - middle)[0]
        last = len(self._sections) - 1
        found = self._aligner.pairs.get((last - 1, last))
        alike = ("", "") if found is None else (f"{found.correlation:.4f}", int(found.believed))
        return section, f"{x:.3f}", f"{y:.3f}", f"{deformation(matrix).rotation_deg:.4f}", *alike

    def write(self, folder: Path) -> None:
        """Solve for all sections together and write what ``process align`` writes."""
        from processing.align_report import write_alignment  # noqa: PLC0415  takes seconds to load, and is not needed
        from processing.align_work import Work  # noqa: PLC0415  before the end

        stack, sections = middle_planes(self._run)
        matched = self._aligner if sections == self._sections else None
        work = Work(stack, SystemClock(), model=MODEL)
        alignment, report = work.solved(quiet=True, matched=matched)
        report |= {"sections": sections, "live": matched is not None}
        write_alignment(folder, stack, alignment, report, lambda _: None, {})


def middle_slots(run: StoredRun) -> list[int]:
    """Return the slots of the middle planes that were taken, in the order of the sections."""
    layout = run.layout
    return [slot for slot in sorted(run.planes) if layout.place(slot)[1:] == (0, layout.planes_each // 2)]


def middle_planes(run: StoredRun) -> tuple[Stack, list[int]]:
    """Return the middle plane of each section that was taken, as a stack, and which sections these are.

    Raises
    ------
    InputError
        ``align-one``: fewer than two were taken.
    """
    layout, there = run.layout, middle_slots(run)
    sections = [layout.place(slot)[0] for slot in there]
    if len(there) < 2:
        raise InputError(f"{len(there)} sections were taken.", fix="take two or more.", code="align-one")
    depth_nm, notes = depths_nm(run, sections) if is_cut(run) else (None, [])
    z_um = None if depth_nm is None else (depth_nm[0] - depth_nm) / NM_PER_UM
    recording = Recording(
        len(there),
        lambda k: run.read(there[k]),
        z_um=z_um,
        pixel_um=layout.pixel_um,
        notes=tuple(notes),
        label=lambda k: f"plane {there[k]}",
    )
    return Stack(run.folder, recording, z_um), sections


def warm() -> None:
    """Have everything compiled or loaded before the first section comes."""
    aligner = SectionAligner(MODEL)
    for picture in np.random.default_rng(0).integers(0, 255, (2, WARM_SIDE, WARM_SIDE)).astype(np.uint8):
        aligner.add(picture)


def follow(reader: RingReader, live: LiveAlignment) -> None:
    """Match sections as they come, until the run gives no more; looks at the disk where the ring was too quick."""
    idle = 0
    while True:
        try:
            frame = reader.read(LOOK_S)
        except WriterGone:
            return
        idle = 0 if frame is not None else idle + 1
        anew = frame is not None and frame.header.section > live.newest
        if (live.owes and anew) or idle == LOOKS or (live.owes and idle > LOOKS and idle % LOOKS == 0):
            live.catch_up()
        if frame is not None:
            live.take(frame.header, frame.pixels)


def observe(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:  # noqa: ARG001
    """Observe `LiveAlignment`; see `acquire.observe`."""
    clock = SystemClock()
    stored = open_run(run)
    live = LiveAlignment(stored, out)
    with joined(ring, clock) as reader:
        ready()
        if reader is not None:
            follow(reader, live)
    wait_for_end(stored, clock)
    live.catch_up()
    live.write(out)
