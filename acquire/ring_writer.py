"""The writing end of the ring: see `acquire.ring`."""

from __future__ import annotations

import os
import secrets
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.ring_layout import (
    KIND_NAMES,
    LAYOUT,
    LOSSLESS,
    MAGIC,
    NS_PER_S,
    POLL_S,
    READER_BYTE,
    READERS,
    WRITER_BYTE,
    Entry,
    Fence,
    Geometry,
    RingMap,
    Word,
    clear_entry,
    entry_word,
    header_values,
)
from acquire.ring_locks import is_locked, try_lock, unlock
from devices.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType
    from typing import Self

    from acquire.frame import FrameHeader
    from acquire.ring_layout import ReaderKind
    from devices.protocols import Clock


class RingFull(StoreError):
    """A lossless reader held the slot the next frame needs; that frame was refused and counted."""

    code = "ring-full"


@dataclass(frozen=True)
class ReaderStatus:
    """A reader as the writer sees it.

    Attributes
    ----------
    pid : int
        Its process.
    kind : str
        ``"lossless"`` or ``"latest"``.
    cursor : int
        The next frame it wants; a lossless reader still needs this one and all after it.
    received, lost : int
        Frames it got and frames that were replaced before it looked, since it attached.
    alive : bool
        False when its process died without closing.
    """

    pid: int
    kind: ReaderKind
    cursor: int
    received: int
    lost: int
    alive: bool


@dataclass(frozen=True)
class OpenSlot:
    """A slot between two frames: fill ``pixels``, then call ``publish(header)``, which returns the frame number."""

    pixels: np.ndarray
    publish: Callable[[FrameHeader], int]


class RingWriter:
    """The one writer of a ring. Used by one thread; only `beat` and `readers` may be called from another."""

    def __init__(self, fd: int, path: Path, geometry: Geometry, clock: Clock) -> None:
        self.path = path
        self.geometry = geometry
        self.published = 0
        self.refused = 0
        self._fd = fd
        self._clock = clock
        self._map = RingMap(fd, geometry, writable=True)
        self._words = self._map.words
        self._fence = Fence()

    @classmethod
    def create(
        cls, stream: str, shape: tuple[int, ...], dtype: str, slots: int, *, clock: Clock, folder: Path | None = None
    ) -> Self:
        """Make a ring, all its memory reserved, and hold it until `close` or death.

        Parameters
        ----------
        stream : str
            Part of the file's name.
        shape, dtype
            Of every frame: (height, width) or (height, width, bands), ``"uint8"`` or ``"uint16"``. Frames of another
            geometry need another ring.
        slots : int
            Frames the ring holds, at least 2: the frame rate times the longest stall of a lossless reader.
        folder : Path, optional
            Where the file lies; ``/dev/shm`` when left out.

        Raises
        ------
        StoreError
            No room (``ring-no-memory``) or impossible geometry (``ring-geometry``).
        """
        geometry = Geometry(tuple(shape), str(np.dtype(dtype)), slots)
        generation = secrets.randbits(63) | 1
        path = (folder or shared_memory_folder()) / f"stereotome-{os.getpid()}-{stream}-{generation:016x}.ring"
        fd = _reserve(path.parent, geometry)
        writer = cls(fd, path, geometry, clock)
        writer._describe(generation)
        _give_name(fd, path)
        return writer

    def push(self, pixels: np.ndarray, header: FrameHeader, *, timeout_s: float = 2.0) -> int:
        """Copy a frame into the ring and return its number, counted from 0.

        Raises
        ------
        RingFull
            A lossless reader did not make room within ``timeout_s``. The frame is refused and counted in `refused`.
        StoreError
            The pixels have another shape or dtype than the ring (``ring-geometry``).
        """
        if pixels.shape != self.geometry.shape or pixels.dtype != self.geometry.dtype:
            raise _wrong_frame(pixels, self.geometry)
        with self.slot(timeout_s=timeout_s) as slot:
            np.copyto(slot.pixels, pixels)
            return slot.publish(header)

    @contextmanager
    def slot(self, *, timeout_s: float = 2.0) -> Iterator[OpenSlot]:
        """Lend the next slot to be filled in place; without ``publish`` it is as if nothing happened.

        Raises
        ------
        RingFull
            As `push`.
        """
        self._wait_for_room(timeout_s)
        number = self.published
        slot = number % self.geometry.slots
        self._words[self._map.sequence_words[slot]] = 2 * number + 1
        self._fence()
        yield OpenSlot(self._map.pixels[slot], partial(self._publish, number, slot))

    def beat(self) -> None:
        """Show that the writer is at work though no frame is due."""
        self._words[Word.HEARTBEAT_NS] = int(self._clock.now() * NS_PER_S)

    def readers(self) -> tuple[ReaderStatus, ...]:
        """Return every attached reader, dead ones included."""
        statuses = (self._status(reader) for reader in range(READERS))
        return tuple(status for status in statuses if status is not None)

    def detach_dead(self) -> tuple[ReaderStatus, ...]:
        """Forget the readers that died, so that they hold nothing any more, and return them for the log."""
        statuses = (self._detach_if_dead(reader) for reader in range(READERS))
        return tuple(status for status in statuses if status is not None)

    def close(self) -> None:
        """Remove the file; attached readers may read on to the last frame and then get `WriterGone`."""
        if self._fd < 0:
            return
        self.path.unlink(missing_ok=True)
        unlock(self._fd, WRITER_BYTE)
        os.close(self._fd)
        self._fd = -1
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _describe(self, generation: int) -> None:
        self._words[Word.MAGIC] = MAGIC
        self._words[Word.LAYOUT] = LAYOUT
        self._words[Word.GENERATION] = generation
        for word, value in enumerate(self.geometry.words(), Word.SLOTS):
            self._words[word] = value
        self._words[Word.WRITER_PID] = os.getpid()
        self.beat()

    def _publish(self, number: int, slot: int, header: FrameHeader) -> int:
        self._map.headers[slot][...] = header_values(header)
        self._fence()
        self._words[self._map.sequence_words[slot]] = 2 * number + 2
        self._fence()
        self.published = self._words[Word.HEAD] = number + 1
        self.beat()
        return number

    def _wait_for_room(self, timeout_s: float) -> None:
        if self._has_room():
            return
        deadline = self._clock.now() + timeout_s
        while holders := self._holders():
            if self._clock.now() >= deadline:
                self.refused = self._words[Word.REFUSED] = self.refused + 1
                raise _full(self.published, timeout_s, min(holders, key=lambda holder: holder.cursor))
            self._clock.sleep(POLL_S)

    def _has_room(self) -> bool:
        return all(cursor > self.published - self.geometry.slots for cursor in self._claims())

    def _claims(self) -> Iterator[int]:
        words = self._words
        for first in range(Word.READERS, Word.READERS + READERS * Entry.SIZE, Entry.SIZE):
            if words[first + Entry.KIND] == LOSSLESS:
                yield words[first + Entry.CURSOR]

    def _holders(self) -> list[ReaderStatus]:
        oldest = self.published - self.geometry.slots
        return [status for status in self.readers() if status.kind == "lossless" and status.cursor <= oldest]

    def _detach_if_dead(self, reader: int) -> ReaderStatus | None:
        if not try_lock(self._fd, READER_BYTE + reader):
            return None
        try:
            status = self._status(reader)
            clear_entry(self._words[entry_word(reader) :])
            return status
        finally:
            unlock(self._fd, READER_BYTE + reader)

    def _status(self, reader: int) -> ReaderStatus | None:
        entry = self._words[entry_word(reader) :]
        kind = KIND_NAMES.get(entry[Entry.KIND])
        if kind is None:
            return None
        return ReaderStatus(
            pid=entry[Entry.PID],
            kind=kind,
            cursor=entry[Entry.CURSOR],
            received=entry[Entry.RECEIVED],
            lost=entry[Entry.LOST],
            alive=is_locked(self._fd, READER_BYTE + reader),
        )


def shared_memory_folder() -> Path:
    """Return where rings lie when nothing else is asked for: shared memory, else the folder for temporary files."""
    folder = Path("/dev/shm")  # noqa: S108  the kernel's own place for shared memory; files are made 0600
    return folder if folder.is_dir() else Path(tempfile.gettempdir())


def _reserve(folder: Path, geometry: Geometry) -> int:
    """Return a locked, nameless file with all its memory reserved: without that, a full disk kills the writer."""
    fd = -1
    try:
        fd = os.open(folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        os.posix_fallocate(fd, 0, geometry.file_bytes)
    except OSError as error:
        if fd >= 0:
            os.close(fd)
        raise _no_memory(folder, geometry, error) from error
    try_lock(fd, WRITER_BYTE)
    return fd


def _give_name(fd: int, path: Path) -> None:
    """Let the finished, locked file appear under its name, so that nobody ever meets half a ring."""
    folder = os.open(path.parent, os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.link(f"/proc/self/fd/{fd}", path.name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)


def _full(number: int, timeout_s: float, holder: ReaderStatus) -> RingFull:
    state = "is too slow or stands still" if holder.alive else "died and was not detached"
    return RingFull(
        f"frame {number} found no free place in the ring within {timeout_s:g} s",
        why=f"the lossless reader in process {holder.pid} still needs frame {holder.cursor} on; it {state}.",
        fix=("see why that process does not keep up (a slow or full disk?).", "give the ring more frames."),
    )


def _no_memory(folder: Path, geometry: Geometry, error: OSError) -> StoreError:
    return StoreError(
        f"no room for {geometry.slots} frames ({geometry.file_bytes / 1e6:.0f} MB) in {folder}",
        why=f"{error.strerror}.",
        fix=("use fewer frames in the ring.", f"free memory, or make {folder} larger."),
        code="ring-no-memory",
    )


def _wrong_frame(pixels: np.ndarray, geometry: Geometry) -> StoreError:
    return StoreError(
        f"a frame of shape {pixels.shape} {pixels.dtype} does not fit a ring of {geometry.shape} {geometry.dtype}",
        why="the camera changed what it delivers after the ring was made.",
        fix="set up the camera before the run and leave it alone.",
        code="ring-geometry",
    )
