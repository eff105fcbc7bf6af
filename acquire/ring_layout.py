"""How the ring lies in its file: one page of 64-bit words and the readers' table, then the slots.

A slot is one page with the sequence word and the frame's header, then the pixels, page-aligned. Every word has one
writer, is 8-byte aligned, and is touched only through ``memoryview.cast("Q")``: that is one machine instruction,
whereas `struct` fills the destination byte by byte and is seen half-written by other processes.
"""

from __future__ import annotations

import math
import mmap
import os
import platform
import threading
import zlib
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from acquire.frame import FrameHeader
from devices.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

PAGE = 4096
WORD = 8
READERS = 16
MIN_SLOTS = 2
POLL_S = 0.001  # how often a waiting end looks whether the other went on: 0.5 ms late on average, 3 % of a core
NS_PER_S = 1_000_000_000

_NUMBERS = {"int": "<i8", "float": "<f8"}
HEADER_DTYPE = np.dtype([(field.name, _NUMBERS[str(field.type)]) for field in fields(FrameHeader)])
header_values = attrgetter(*HEADER_DTYPE.names or ())

MAGIC = int.from_bytes(b"stereoto", "little")
LAYOUT = zlib.crc32(f"1 {HEADER_DTYPE.descr}".encode())


class Word:
    """Index of each 64-bit word in the first page; words with different writers lie on different cache lines."""

    MAGIC, LAYOUT, GENERATION, SLOTS, HEIGHT, WIDTH, BANDS, ITEM_BYTES = range(8)
    HEAD = 8  # frames ever published: the truth every reader polls
    WRITER_PID, HEARTBEAT_NS, REFUSED = 16, 17, 18
    READERS = 64


class Entry:
    """Index of each word in a reader's entry, a cache line of the readers' table."""

    SIZE = 8
    PID, KIND, CURSOR, RECEIVED, LOST = range(5)


ReaderKind = Literal["lossless", "latest"]
FREE, LOSSLESS, LATEST = range(3)  # values of Entry.KIND
KIND_NAMES: dict[int, ReaderKind] = {LOSSLESS: "lossless", LATEST: "latest"}
WRITER_BYTE = 0  # the byte of the file the writer holds locked; reader k holds READER_BYTE + k
READER_BYTE = 1


def entry_word(reader: int) -> int:
    """Return the index of the first word of a reader's entry."""
    return Word.READERS + reader * Entry.SIZE


def clear_entry(entry: memoryview) -> None:
    """Free a reader's entry: first its claim, and last the word by which it is taken."""
    entry[Entry.KIND] = FREE
    entry[Entry.PID] = 0


@dataclass(frozen=True)
class Geometry:
    """What fits into a ring: ``slots`` frames of one shape, (height, width) or (height, width, bands), and dtype."""

    shape: tuple[int, ...]
    dtype: str
    slots: int

    def __post_init__(self) -> None:
        usable = len(self.shape) in (2, 3) and min(self.shape) > 0 and self.dtype in ("uint8", "uint16")
        if not usable or self.slots < MIN_SLOTS:
            raise StoreError(
                f"no ring of {self.slots} frames of shape {self.shape} {self.dtype} can be made",
                why=f"a ring holds {MIN_SLOTS} or more frames (height, width[, bands]) of uint8 or uint16.",
                fix="check what the camera says it delivers.",
                code="ring-geometry",
            )

    @property
    def frame_bytes(self) -> int:
        """Bytes of the pixels of one frame."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    @property
    def slot_bytes(self) -> int:
        """Distance between slots: the header's page and the pixels in whole pages."""
        return PAGE + -(-self.frame_bytes // PAGE) * PAGE

    @property
    def file_bytes(self) -> int:
        """Size of the whole ring."""
        return PAGE + self.slots * self.slot_bytes

    def words(self) -> tuple[int, ...]:
        """Return the words that describe this geometry, from `Word.SLOTS` on; 0 bands stand for a grey frame."""
        height, width, bands = (*self.shape, 0)[:3]
        return (self.slots, height, width, bands, np.dtype(self.dtype).itemsize)

    @classmethod
    def from_words(cls, words: Sequence[int]) -> Geometry:
        """Return the geometry written by `words`."""
        slots, height, width, bands, item_bytes = words
        shape = (height, width, bands) if bands else (height, width)
        return cls(shape, f"uint{8 * item_bytes}", slots)


class RingMap:
    """The file in memory: its words, and each slot's header and pixels as arrays.

    Parameters
    ----------
    fd : int
        The open file; stays the caller's.
    geometry : Geometry
        What the file holds.
    writable : bool
        False maps the pages read-only: not even a mistake can change a pixel.
    """

    def __init__(self, fd: int, geometry: Geometry, *, writable: bool) -> None:
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self._memory = mmap.mmap(fd, geometry.file_bytes, mmap.MAP_SHARED | mmap.MAP_POPULATE, protection)
        self.words = memoryview(self._memory).cast("Q")
        starts = [PAGE + slot * geometry.slot_bytes for slot in range(geometry.slots)]
        self.sequence_words = [start // WORD for start in starts]
        self.headers = [np.ndarray((), HEADER_DTYPE, self._memory, start + 64) for start in starts]
        self.pixels = [np.ndarray(geometry.shape, geometry.dtype, self._memory, start + PAGE) for start in starts]

    def header(self, slot: int) -> FrameHeader:
        """Return a slot's header; the caller checks the sequence before and after."""
        return FrameHeader(*self.headers[slot].item())

    def close(self) -> None:
        """Let go of the memory; pixels still held by somebody stay readable until they are dropped."""
        self.words.release()
        self.headers, self.pixels = [], []
        del self._memory


class Fence:
    """A full memory barrier on processors that reorder stores or loads.

    x86 keeps stores in order among stores and loads among loads, which is all the ring needs. Elsewhere (ARM) a
    lock of this thread is given back and taken again: what came before cannot pass the release, what comes after
    cannot pass the acquire, and the two do not pass each other.
    """

    _ORDERED = frozenset({"x86_64", "AMD64", "i686", "i386"})

    def __init__(self) -> None:
        self._lock = None if platform.machine() in self._ORDERED else threading.Lock()
        if self._lock:
            self._lock.acquire()

    def __call__(self) -> None:
        """Order everything before against everything after."""
        if self._lock:
            self._lock.release()
            self._lock.acquire()


def read_geometry(fd: int, path: Path) -> Geometry:
    """Return the geometry of an open file, or raise `StoreError` (``ring-file``) when it is no ring of this program."""
    page = os.pread(fd, PAGE, 0)
    if len(page) < PAGE:
        raise not_a_ring(path, f"it has only {len(page)} bytes")
    words = cast("Sequence[int]", memoryview(page).cast("Q"))
    if words[Word.MAGIC] != MAGIC:
        raise not_a_ring(path, "its first bytes are not those of a ring")
    if words[Word.LAYOUT] != LAYOUT:
        raise not_a_ring(path, "it was written by another version of this program")
    geometry = Geometry.from_words(words[Word.SLOTS : Word.ITEM_BYTES + 1])
    if (size := os.fstat(fd).st_size) != geometry.file_bytes:
        raise not_a_ring(path, f"it has {size} bytes instead of {geometry.file_bytes}")
    return geometry


def not_a_ring(path: Path, why: str) -> StoreError:
    """Return the error for a file that cannot be read as a ring."""
    fix = "give the path that the running acquisition announces, and run the same version on both sides."
    return StoreError(f"{path} is not a frame ring", why=f"{why}.", fix=fix, code="ring-file")
