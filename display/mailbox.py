"""Complete pairs of views from the process that draws them to the one that flips them: the newest wins.

A file in shared memory: one page of 64-bit words and three places for a pair. The writer fills a place that is neither
the newest nor being read, then names it the newest; so neither end ever waits for the other, and no eye ever gets a
picture of another pair than its fellow. As in `acquire.ring_layout`, a word is touched only through
``memoryview.cast("Q")``, which writes it in one instruction; a place carries a number that is odd while it is written,
so that a reader who was overtaken notices.
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Picture = NDArray[np.uint8]

PAGE, WORD, PLACES, COLOURS, EYES = 4096, 8, 3, 3, 2
MAGIC = int.from_bytes(b"twoviews", "little")
NAMED = "stereotome-views-"
SHARED = Path("/dev/shm")  # noqa: S108  the kernel's own place for shared memory; files are made 0600


class At:
    """Index of each word in the first page; words with different writers lie on different cache lines."""

    MAGIC, WIDTH, HEIGHT = range(3)
    NEWEST, STOP, SWAP = 8, 9, 10  # the drawing end's; NEWEST: pairs so far times PLACES, plus the place
    NUMBERS = 11
    READING, TOLD = 24, 25  # the flipping end's; READING: place + 1; TOLD: numbers about how it goes
    TOLD_WORDS = 16


class Mailbox:
    """Both ends of it; one process writes, one reads.

    Attributes
    ----------
    path : Path
        Of the file.
    size : (int, int)
        Width and height of a view in pixels.
    """

    def __init__(self, path: Path, size: tuple[int, int], memory: mmap.mmap) -> None:
        self.path = path
        self.size = size
        self._memory = memory
        self._bytes = memoryview(memory)
        self._words = self._bytes[:PAGE].cast("Q")
        width, height = size
        shape = (PLACES, EYES, height, width, COLOURS)
        self._place = self._number = 0
        self._places: Picture = np.frombuffer(memory, np.uint8, offset=PAGE, count=int(np.prod(shape))).reshape(shape)

    @classmethod
    def create(cls, size: tuple[int, int]) -> Mailbox:
        """Make the file for views of (width, height); the end that draws does so, and removes it with `remove`.

        Files whose makers were killed are removed.
        """
        handle, name = tempfile.mkstemp(prefix=f".{NAMED}", dir=SHARED if SHARED.is_dir() else None)
        try:
            path = _kept_for(handle, Path(name))
            os.ftruncate(handle, _bytes_of(size))
            box = cls(path, size, mmap.mmap(handle, _bytes_of(size)))
        finally:
            os.close(handle)
        box._words[At.WIDTH], box._words[At.HEIGHT] = size
        box._words[At.MAGIC] = MAGIC
        return box

    @classmethod
    def open(cls, path: Path) -> Mailbox:
        """Open the file another process made; raises `DisplayError` when it is none."""
        try:
            with path.open("r+b") as file:
                memory = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise DisplayError(f"{path}: no pairs to show: {error}") from None
        words = memoryview(memory)[:PAGE].cast("Q") if len(memory) >= PAGE else [0] * PLACES
        size = (int(words[At.WIDTH]), int(words[At.HEIGHT]))
        if words[At.MAGIC] != MAGIC or len(memory) != _bytes_of(size):
            raise DisplayError(f"{path}: no pairs to show: not a file of ours.")
        return cls(path, size, memory)

    def publish(self, left: Picture, right: Picture) -> None:
        """Make a pair the newest; both views (height, width, 3) uint8, row 0 the top."""
        pairs, newest = divmod(self._words[At.NEWEST], PLACES)
        taken = {newest if pairs else -1, self._words[At.READING] - 1}
        place = next(k for k in range(PLACES) if k not in taken)
        self._words[At.NUMBERS + place] += 1
        self._places[place, 0], self._places[place, 1] = left, right
        self._words[At.NUMBERS + place] += 1
        self._words[At.NEWEST] = (pairs + 1) * PLACES + place

    @property
    def pairs(self) -> int:
        """How many pairs were published."""
        return self._words[At.NEWEST] // PLACES

    @contextmanager
    def newest(self) -> Iterator[tuple[Picture, Picture] | None]:
        """Lend the newest pair to the reader, without a copy; None when there is none.

        What was done with it counts only if `intact` is true at the end.
        """
        place = self._claim()
        self._number = self._words[At.NUMBERS + place]
        self._place = place
        try:
            yield None if self.pairs == 0 else (self._places[place, 0], self._places[place, 1])
        finally:
            self._words[At.READING] = 0

    @property
    def intact(self) -> bool:
        """Whether nobody wrote into the pair that is lent."""
        return self._number % 2 == 0 and self._words[At.NUMBERS + self._place] == self._number

    def _claim(self) -> int:
        """Say which place is being read; again, if another became the newest meanwhile."""
        while True:
            newest = self._words[At.NEWEST]
            self._words[At.READING] = newest % PLACES + 1
            if self._words[At.NEWEST] == newest:
                return int(newest % PLACES)

    @property
    def stopped(self) -> bool:
        """Whether the drawing end wants the show to end."""
        return bool(self._words[At.STOP])

    def stop(self) -> None:
        """Ask the flipping end to end the show."""
        self._words[At.STOP] = 1

    @property
    def swap(self) -> bool:
        """Whether the drawing end wants the eyes exchanged."""
        return bool(self._words[At.SWAP])

    @swap.setter
    def swap(self, swap: bool) -> None:
        self._words[At.SWAP] = int(swap)

    def tell(self, numbers: Sequence[int]) -> None:
        """Write up to 16 numbers for the drawing end to look at; each is whole, all together need not be."""
        for k, number in enumerate(numbers[: At.TOLD_WORDS]):
            self._words[At.TOLD + k] = number

    def told(self, count: int) -> tuple[int, ...]:
        """Return what the flipping end told last."""
        return tuple(self._words[At.TOLD : At.TOLD + count])

    def close(self) -> None:
        """Let go of the memory."""
        self._places = np.empty((0, 0, 0, 0, 0), np.uint8)
        self._words.release()
        self._bytes.release()
        with suppress(BufferError):  # a view that somebody still holds keeps the memory until it goes
            self._memory.close()

    def remove(self) -> None:
        """Let go of the memory and remove the file."""
        self.close()
        self.path.unlink(missing_ok=True)


def _kept_for(handle: int, hidden: Path) -> Path:
    """Lock a new file for as long as its memory is in use, so that nobody sweeps it, and give it its name."""
    path = hidden.with_name(hidden.name.removeprefix("."))
    if sys.platform == "linux":
        from acquire.ring_janitor import sweep_stale  # noqa: PLC0415  such locks are Linux's alone
        from acquire.ring_layout import WRITER_BYTE  # noqa: PLC0415
        from acquire.ring_locks import try_lock  # noqa: PLC0415

        sweep_stale(hidden.parent, f"{NAMED}*")
        try_lock(handle, WRITER_BYTE)
    return hidden.rename(path)


def _bytes_of(size: Any) -> int:
    return int(PAGE + PLACES * EYES * size[0] * size[1] * COLOURS)
