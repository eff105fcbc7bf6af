"""From the camera to the disk: frames go through the ring, one writer thread makes them durable."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.ring import RingFull, RingReader, RingWriter, WriterGone
from acquire.store import SIDE_BY_SIDE, free_bytes
from devices.errors import StereotomeError, StoreError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import numpy as np

    from acquire.frame import FrameHeader, Missed
    from acquire.store import RunEnd, RunStore
    from acquire.verdict import SectionPlanes
    from devices.protocols import Clock

GROUP = 8  # planes committed together when frames come faster than the disk can confirm them one by one
IDLE_S = 0.05
RING_BYTES = 256 * 1024**2
SAFE_SO_FAR = "Planes taken so far are safe; no further plane is exposed."
MIN_SLOTS, MAX_SLOTS, MAX_SLOTS_AT_CAMERA_RATE = 4, 32, 256


def ring_slots(frame_bytes: int, free_shm_bytes: int, *, camera_waits: bool = True) -> int:
    """Return how many frames the ring holds: enough for the worst stall of a disk, within half of the free memory.

    A camera that does not wait for anybody gives some hundred frames in the second such a stall may take.
    """
    room = min(RING_BYTES, free_shm_bytes // 2)
    return max(MIN_SLOTS, min(MAX_SLOTS if camera_waits else MAX_SLOTS_AT_CAMERA_RATE, room // frame_bytes))


class DiskLow(StoreError):
    """The disk has no room for the next frames; nothing failed yet, and nothing is lost if somebody makes room."""

    code = "disk-full"


class Recorder:
    """The engine's way to the disk.

    `put` copies a frame into the ring and returns; the writer thread, a lossless reader of the ring, stores it. An
    error of the disk is kept and raised at the next `put` or `check`, so that no further plane is exposed.
    """

    def __init__(self, store: RunStore, ring: RingWriter, clock: Clock, *, keep_free_bytes: int = 0) -> None:
        self._store = store
        self._ring = ring
        self._keep_free_bytes = keep_free_bytes
        self._frame_bytes = ring.geometry.frame_bytes
        self._handed_over = self._stored = self._durable = 0
        self._settled = threading.Condition()
        self._reader = RingReader.attach(ring.path, "lossless", clock=clock)
        self._error: StereotomeError | None = None
        self._thread = threading.Thread(target=self._drain, name="writer", daemon=True)
        self._thread.start()

    @property
    def durable(self) -> int:
        """Planes on disk, verified and in the journal."""
        return self._store.durable

    def check(self) -> None:
        """Raise `StoreError` if the disk failed or is about to be full; called before each exposure."""
        self.check_room(1)

    def check_room(self, frames: int) -> None:
        """Raise `StoreError` if the disk failed, or has no room for ``frames`` frames and the reserve."""
        if self._error is not None:
            raise self._error
        under_way = self._handed_over - self._durable  # planes are written side by side: put is not yet on the disk
        free = free_bytes(self._store.folder) - (frames + under_way) * self._frame_bytes
        if free < self._keep_free_bytes:
            raise DiskLow(
                f"data: less than the reserve of {size(self._keep_free_bytes)} would be free on the disk.",
                why=SAFE_SO_FAR,
                fix=("free some space", "choose another folder: --out DIR"),
            )

    def put(self, pixels: np.ndarray, header: FrameHeader) -> None:
        """Hand over one frame; raises `StoreError` when the disk failed or cannot keep up."""
        if self._error is not None:
            raise self._error
        try:
            self._ring.push(pixels, header)
            self._handed_over += 1
        except RingFull:
            if self._error is not None:  # the writer gave up while this frame waited for its slot
                raise self._error from None
            raise

    def missed(self, missed: Missed) -> None:
        """Record that a plane stays empty, and why."""
        place = {"section": missed.section, "band": missed.band, "plane": missed.plane}
        self.note({"e": "missed", **place, "reason": missed.reason})

    def note(self, record: dict[str, Any]) -> None:
        """Put a record into the journal; raises `StoreError` when the disk refuses it."""
        try:
            self._store.journal.append(record)
        except OSError as error:
            raise disk_failed(error) from error

    def settle(self) -> None:
        """Wait until every frame handed over is durable; raises what kept one from becoming it."""
        with self._settled:
            self._settled.wait_for(lambda: self._error is not None or self._durable == self._handed_over)
        if self._error is not None:
            raise self._error

    def reject(self, slots: Collection[int], reason: str) -> None:
        """Take planes back: they are to be taken again."""
        self.settle()
        with disk_errors():
            self._store.reject(slots, reason)

    def commit_section(self, section: int, waived: Collection[int]) -> None:
        """Record that a section is complete but for ``waived`` planes, and show it to readers."""
        self.settle()
        with disk_errors():
            self._store.commit_section(section, waived)

    def planes(self, section: int) -> SectionPlanes:
        """Return the durable planes of a section."""
        return _Durable(self._store, section)

    def finish(self, end: RunEnd, reason: str = "") -> RunEnd:
        """Wait until every frame is on disk, write the last record and return how the run really ended."""
        self._ring.close()
        self._thread.join()
        try:
            if self._error is not None:
                self._store.abandon(f"{self._error.code}: {self._error}")
                raise self._error
            return self._store.finalise(end, reason)
        except (OSError, ValueError) as error:
            raise disk_failed(error) from error
        finally:
            self._store.close()

    def _drain(self) -> None:
        try:
            while self._store_next():
                pass
            self._store.commit()
        except StereotomeError as error:
            self._error = error
        except (OSError, ValueError) as error:  # tensorstore wraps what the disk says in ValueError
            self._error = disk_failed(error)
        finally:
            with self._settled:
                self._settled.notify_all()
            self._reader.close()

    def _store_next(self) -> bool:
        try:
            frame = self._reader.read(IDLE_S)
        except WriterGone:
            return False
        if frame is not None:
            self._store.put(frame)
            self._reader.release()
            self._stored += 1
        more = self._reader.unread
        if not more or self._store.pending >= GROUP + SIDE_BY_SIDE:
            self._store.commit(leave=SIDE_BY_SIDE if more else 0)
            with self._settled:
                self._durable = self._stored - self._store.pending
                self._settled.notify_all()
        return True


class _Durable:
    """The durable planes of a section, read as they are asked for."""

    def __init__(self, store: RunStore, section: int) -> None:
        self._store = store
        self.section = section
        each = store.layout.slots_each
        self.slots = tuple(slot for slot in range(section * each, (section + 1) * each) if slot in store.durable_planes)

    def header(self, slot: int) -> FrameHeader:
        return self._store.record(slot).header

    def pixels(self, slot: int) -> np.ndarray:
        return self._store.read(slot)


@contextmanager
def disk_errors() -> Iterator[None]:
    """Turn what a disk says into a `StoreError`."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise disk_failed(error) from error


def size(count: float) -> str:
    """Return a number of bytes in words: ``61.0 GB``."""
    for unit in ("bytes", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def disk_full(what: str, why: str = SAFE_SO_FAR) -> StoreError:
    """Return the error of a full disk."""
    return StoreError(
        f"data: {what}",
        why=why,
        fix=("free some space", "choose another folder: --out DIR"),
        code="disk-full",
    )


def disk_failed(error: Exception) -> StoreError:
    """Return the error of a disk that refused a write."""
    text = " ".join(str(error).split())
    if "No space left" in text or "RESOURCE_EXHAUSTED" in text:
        return disk_full("the disk is full.")
    return StoreError(
        f"data: the disk refused a write: {text}",
        why="Planes committed before are safe; no further plane is exposed.",
        fix="check the disk, then repeat the run in another folder: --out DIR",
        code="disk-failed",
    )
