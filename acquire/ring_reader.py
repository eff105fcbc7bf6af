"""The reading end of the ring: see `acquire.ring`."""

from __future__ import annotations

import mmap
import os
from typing import TYPE_CHECKING

from acquire.frame import Frame
from acquire.ring_layout import (
    LATEST,
    LOSSLESS,
    NS_PER_S,
    PAGE,
    POLL_S,
    READER_BYTE,
    READERS,
    WORD,
    WRITER_BYTE,
    Entry,
    Fence,
    RingMap,
    Word,
    clear_entry,
    entry_word,
    not_a_ring,
    read_geometry,
)
from acquire.ring_locks import is_locked, try_lock, unlock
from devices.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    import numpy as np

    from acquire.ring_layout import ReaderKind
    from devices.protocols import Clock


class WriterGone(StoreError):
    """The writer closed the ring or died, and every frame it published has been read."""

    code = "ring-writer-gone"


class RingReader:
    """One reader of a ring, used by one thread.

    Attributes
    ----------
    received, lost : int
        Frames delivered, and frames replaced before a latest reader looked, since it attached.
    torn : int
        Copies thrown away because the writer came by while they were made; a newer frame was read instead.
    """

    def __init__(self, fd: int, path: Path, kind: ReaderKind, clock: Clock) -> None:
        self.path = path
        self.kind = kind
        self.geometry = read_geometry(fd, path)
        self.received = 0
        self.lost = 0
        self.torn = 0
        self._fd = fd
        self._clock = clock
        self._fence = Fence()
        self._reader = _claim_entry(fd, path)
        self._map = RingMap(fd, self.geometry, writable=False)
        self._words = self._map.words
        self._entry = memoryview(mmap.mmap(fd, PAGE)).cast("Q")[entry_word(self._reader) :][: Entry.SIZE]
        self._take = self._view if kind == "lossless" else self._copy
        self._held = 0
        self._cursor = self._register()

    @classmethod
    def attach(cls, path: Path, kind: ReaderKind, *, clock: Clock) -> Self:
        """Join a ring; the first frame delivered is the first one published from now on.

        Raises
        ------
        StoreError
            The file is missing or no ring of this version (``ring-file``), or has no room for another reader
            (``ring-readers``).
        """
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise not_a_ring(path, f"it cannot be opened ({error.strerror})") from error
        try:
            return cls(fd, path, kind, clock)
        except StoreError:
            os.close(fd)
            raise

    def read(self, timeout_s: float) -> Frame | None:
        """Wait for a frame.

        Parameters
        ----------
        timeout_s : float
            Longest wait; 0 looks once.

        Returns
        -------
        Frame or None
            Lossless: the next frame, in place and read-only, valid until `release` or the next `read`. Latest: a
            copy of the newest frame not yet seen. None when none came in time.

        Raises
        ------
        WriterGone
            The writer closed or died, and nothing is left to read.
        """
        self.release()
        deadline = self._clock.now() + timeout_s
        while (frame := self._take()) is None and self._wait(deadline):
            pass
        return frame

    def look_back(self) -> None:
        """Let a latest reader that just attached see the newest frame there is already, as if it came now."""
        if self.kind == "latest" and self._words[Word.HEAD] and not self.received + self.unread:
            self._advance(-1)

    def release(self) -> None:
        """Give the slot of the last frame back to the writer; nothing to do for a latest reader."""
        self._fence()
        self._advance(self._held)
        self._held = 0

    @property
    def unread(self) -> int:
        """Frames published and not yet delivered."""
        return self._words[Word.HEAD] - self._cursor - self._held

    @property
    def writer_alive(self) -> bool:
        """Whether the writer still holds the ring."""
        return is_locked(self._fd, WRITER_BYTE)

    @property
    def writer_idle_s(self) -> float:
        """Time since the writer last published or beat, in s."""
        return self._clock.now() - self._words[Word.HEARTBEAT_NS] / NS_PER_S

    def close(self) -> None:
        """Leave the ring; the writer is not held back any more. A frame still held in place may change from now on."""
        if self._fd < 0:
            return
        clear_entry(self._entry)
        unlock(self._fd, READER_BYTE + self._reader)
        os.close(self._fd)
        self._fd = -1
        self._entry.release()
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _register(self) -> int:
        """Enter the table and return the first frame wanted.

        The claim is staked before ``head`` is read a second time: a writer that did not see it yet can be at most one
        frame further, and that one lies in another slot.
        """
        self._entry[Entry.CURSOR] = self._words[Word.HEAD]
        self._entry[Entry.RECEIVED] = self._entry[Entry.LOST] = 0
        self._entry[Entry.PID] = os.getpid()
        self._fence()
        self._entry[Entry.KIND] = LOSSLESS if self.kind == "lossless" else LATEST
        self._fence()
        cursor = self._entry[Entry.CURSOR] = self._words[Word.HEAD]
        return cursor

    def _wait(self, deadline: float) -> bool:
        """Return whether to look again, after a pause unless a frame is waiting."""
        alive = self.writer_alive  # asked first: what it published before it died is then seen below
        left_s = deadline - self._clock.now()
        if not self.unread:
            if not alive:
                raise _writer_gone(self.path, self._cursor)
            self._clock.sleep(max(0.0, min(POLL_S, left_s)))
        return left_s > 0

    def _view(self) -> Frame | None:
        if not self.unread:
            return None
        number, slot = self._cursor, self._cursor % self.geometry.slots
        self._fence()
        if not self._intact(number, slot):
            raise _overrun(self.path, number)
        self._held = 1
        self._count(received=1, lost=0)
        return Frame(number, self._map.header(slot), self._map.pixels[slot])

    def _copy(self) -> Frame | None:
        number = self._words[Word.HEAD] - 1
        if number < self._cursor or (frame := self._snapshot(number)) is None:
            return None
        self._count(received=1, lost=number - self._cursor)
        self._advance(number + 1 - self._cursor)
        return frame

    def _snapshot(self, number: int) -> Frame | None:
        """Copy a frame, or return None when the writer reached its slot before the copy was complete.

        One look at the sequence, after the copy, is enough: it grows and never comes back to this frame's value.
        """
        slot = number % self.geometry.slots
        self._fence()
        frame = Frame(number, self._map.header(slot), self._duplicate(self._map.pixels[slot]))
        self._fence()
        if self._intact(number, slot):
            return frame
        self.torn += 1
        return None

    def _duplicate(self, pixels: np.ndarray) -> np.ndarray:
        copy = pixels.copy()
        copy.setflags(write=False)
        return copy

    def _intact(self, number: int, slot: int) -> bool:
        return self._words[self._map.sequence_words[slot]] == 2 * number + 2

    def _count(self, *, received: int, lost: int) -> None:
        self.received += received
        self.lost += lost
        self._entry[Entry.RECEIVED] = self.received
        self._entry[Entry.LOST] = self.lost

    def _advance(self, frames: int) -> None:
        self._cursor += frames
        self._entry[Entry.CURSOR] = self._cursor


def _claim_entry(fd: int, path: Path) -> int:
    """Lock a free entry of the readers' table and return its index; what the dead left is the writer's to clear."""
    for reader in range(READERS):
        if try_lock(fd, READER_BYTE + reader):
            if os.pread(fd, WORD, entry_word(reader) * WORD) == bytes(WORD):
                return reader
            unlock(fd, READER_BYTE + reader)
    raise StoreError(
        f"{path} has {READERS} readers already",
        fix="close a viewer that is not needed.",
        code="ring-readers",
    )


def _writer_gone(path: Path, published: int) -> WriterGone:
    return WriterGone(
        f"the acquisition writing {path.name} ended after frame {published - 1}",
        why="it closed the ring, or its process died.",
        fix="look at the run's own messages; every frame it published has been read.",
    )


def _overrun(path: Path, number: int) -> StoreError:
    return StoreError(
        f"frame {number} of {path.name} was overwritten before it was read",
        why="this reader was detached as dead, or the ring's memory was changed by another program.",
        fix="run it again.",
        code="ring-overrun",
    )
