"""Extended focus and range while a run is taken: a reader of the ring that cannot hold it up.

The newest frame is measured as it comes. Frames it came too late for are read back from the run's folder once they are
durable there, so the result lacks nothing; it has the same bits as `processing.focus.focus_stack` on the run's folder
without registration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from acquire.ring import WriterGone
from acquire.store import open_run
from devices.clock import SystemClock
from processing.focus import FocusResult, FocusSweep, focus_stack
from processing.outputs import about_stack, peak_memory_mb, write_focus_result
from processing.stack import open_stack
from processing.watchers import LOOK_S, joined, wait_for_end

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.frame import Frame
    from acquire.ring import RingReader
    from acquire.store import StoredRun
    from devices.protocols import Clock
    from processing.focus_tracks import Options

    Array = NDArray[Any]

KEEP_BYTES = 1024**3  # planes of a run up to this size stay in memory for the last step
WARM_SIDE = 16


class LiveFocus:
    """The planes of a run in their order, measured as soon as each and all before it are there.

    Parameters
    ----------
    run : StoredRun
        The run's folder, being written.
    options : Options
        Of `FocusSweep`.
    """

    def __init__(self, run: StoredRun, options: Options) -> None:
        self.run = run
        height, width = run.layout.shape[:2]
        self._sweep = FocusSweep((height, width), **options)
        self._waiting: dict[int, Frame] = {}
        self._z_um: list[float] = []
        self._kept: list[Array] = []
        self._next = 0

    @property
    def complete(self) -> bool:
        """Whether every planned plane was measured or is known to be missing."""
        return self._next == self.run.layout.planned

    def take(self, frame: Frame) -> None:
        """Take a frame from the ring, in any order."""
        if frame.header.plane >= self._next:
            self._waiting[frame.header.plane] = frame
        self.advance()

    def advance(self) -> None:
        """Measure all planes that are there, up to the first that is not."""
        while not self.complete and self._take_next():
            self._next += 1

    def _take_next(self) -> bool:
        frame = self._waiting.pop(self._next, None)
        if frame is not None:
            self._measure(frame.pixels, frame.header.z_um)
            return True
        return bool(self._waiting) and self._take_from_disk()

    def _take_from_disk(self) -> bool:
        """Fill in a plane that was overtaken; False while the disk does not have it yet."""
        self.run.refresh()
        record = self.run.planes.get(self._next)
        if record is not None:
            self._measure(self.run.read(self._next), record.header.z_um)
        return record is not None or self._next in self.run.missed

    def _measure(self, pixels: Array, z_um: float) -> None:
        self._sweep.add(pixels)
        self._z_um.append(z_um)
        if pixels.nbytes * self.run.layout.planned <= KEEP_BYTES:
            self._kept.append(pixels)

    def result(self) -> FocusResult | None:
        """Return the result, or None when it has to be made from the finished run's folder.

        That is so when planes stayed away without a word, are not in the order of their positions, or are too many to
        be kept in memory.
        """
        z_um = np.array(self._z_um)
        steps = np.diff(z_um)
        in_order = (steps > 0).all() or (steps < 0).all()
        if not (self.complete and in_order and self._kept):
            return None
        known = z_um if z_um.size > 1 else None
        image = self._sweep.finish(known)
        result = self._sweep.compose(self._kept, image, unit="plane" if known is None else "um")
        result.parameters["registration"] = {"applied": False, "why": "planes are not moved while they are taken"}
        return result


def observe(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:
    """Measure a run while it is taken and write what ``stereotome process focus`` writes; see `acquire.observe`.

    Parameters
    ----------
    ring, run, out : Path
        The run's ring, its folder, and where the results go.
    options : dict
        ``method``, ``threshold`` and ``band`` as in `FocusSweep`.
    ready : callable
        As in `follow_run`.
    """
    clock = SystemClock()
    begin_s = clock.now()
    result, late_s = follow_run(ring, run, options=focus_options(options), ready=ready, clock=clock)
    measured_s = clock.now() - begin_s
    wait_for_end(open_run(run), clock)
    stack = open_stack(run)
    took = {"seconds": round(measured_s, 3), "seconds_after_last_plane": round(late_s, 3)}
    facts = {**about_stack(stack), **took, "peak_memory_mb": round(peak_memory_mb(), 1)}
    write_focus_result(result, out, pixel_um=stack.pixel_um, facts=facts)


def follow(reader: RingReader, live: LiveFocus) -> None:
    """Feed frames from the ring until all planes are there or the run gives no more."""
    while not live.complete:
        try:
            frame = reader.read(LOOK_S)
        except WriterGone:
            return
        if frame is None:
            live.advance()
        else:
            live.take(frame)


def focus_options(given: dict[str, Any]) -> Options:
    """Return what is for the focus measurement among the options of an observer."""
    return cast("Options", {name: given[name] for name in ("method", "threshold", "band") if name in given})


def from_folder(run: StoredRun, options: Options) -> FocusResult:
    """Measure the finished run's folder, as `stereotome process focus` does without registration."""
    stack = open_stack(run.folder)
    return focus_stack(stack, z_um=stack.z_um, register=False, **options)


def follow_run(
    ring: Path, folder: Path, *, options: Options, ready: Callable[[], None], clock: Clock
) -> tuple[FocusResult, float]:
    """Measure a run while it is taken.

    Parameters
    ----------
    ring, folder : Path
        The run's ring and its folder.
    options : Options
        Of `FocusSweep`.
    ready : callable
        Called once when frames are being watched and no compiling stands in the way any more.

    Returns
    -------
    FocusResult, float
        What was measured, and how many seconds after the last plane it was ready.

    Raises
    ------
    StoreError
        The ring or the folder is not usable.
    InputError
        The run ended without a plane.
    """
    with joined(ring, clock) as reader:
        live = LiveFocus(open_run(folder), options)
        warm(live.run, options)
        ready()
        if reader is not None:
            follow(reader, live)
    last_s = clock.now()
    result = live.result()
    if result is None:
        wait_for_end(live.run, clock)
        result = from_folder(live.run, options)
    return result, clock.now() - last_s


def warm(run: StoredRun, options: Options) -> None:
    """Have everything compiled or loaded before the first frame comes."""
    layout = run.layout
    shape = (WARM_SIDE, WARM_SIDE, *layout.shape[2:])
    focus_stack(list(np.zeros((3, *shape), layout.dtype)), register=False, **options)
