"""Pictures and volumes that lie in pieces on the disk, each made by one part of a work; and how large values rank."""

from __future__ import annotations

import os
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.marked import Marked
from processing.outputs import write_durably
from processing.tiles import Tile, tiles

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.tiles import Box

    Array = NDArray[Any]

ROWS = 256  # of a picture that are put together at once
PLANES_EACH = 8  # that are copied by one part
READ_BYTES = 16  # of each value of a plane while it is read and looked at; what opening the first took is counted, too


@dataclass(frozen=True)
class Tiled(Marked):
    """Work on tiles of the planes, each through all of them.

    Attributes
    ----------
    folder : Path
        Where pieces and marks are written.
    shape : tuple of int
        Of what is cut into tiles: (height, width), or (planes, height, width).
    side : int
        Rows and columns of a tile.
    halo : tuple of int
        By how much a tile is larger where it is read, along each axis of ``shape``.
    """

    shape: tuple[int, ...]
    side: int
    halo: tuple[int, ...]

    @property
    def places(self) -> list[Tile]:
        """All tiles, row by row."""
        sides = (*self.shape[:-2], self.side, self.side)
        return list(tiles(self.shape, sides, self.halo))

    def piece(self, name: str, k: int) -> Path:
        """Return where tile ``k`` of a picture lies."""
        return self.folder / f"{name}-{k}.npy"

    def keep(self, name: str, k: int, pixels: Array) -> None:
        """Write tile ``k`` of a picture; on the disk when this returns, and whole or not at all."""
        file = BytesIO()
        np.save(file, pixels, allow_pickle=False)
        aside = self.piece(name, k).with_suffix(".part")
        write_durably(aside, file.getbuffer())
        aside.replace(self.piece(name, k))

    def load(self, name: str, k: int) -> Array:
        """Return tile ``k`` of a picture; read where it is looked at."""
        pixels: Array = np.load(self.piece(name, k), mmap_mode="r", allow_pickle=False)
        return pixels

    def read(self, name: str, box: Box) -> Array:
        """Return a part of the whole picture."""
        whole: Array | None = None
        for k, place in enumerate(self.places):
            both = [_overlap(a, b) for a, b in zip(box, place.write, strict=True)]
            if any(s.stop <= s.start for s in both):
                continue
            pixels = self.load(name, k)
            if whole is None:
                whole = np.empty((*(s.stop - s.start for s in box), *pixels.shape[len(box) :]), pixels.dtype)
            there = tuple(_within(s, b) for s, b in zip(both, box, strict=True))
            whole[there] = pixels[tuple(_within(s, b) for s, b in zip(both, place.write, strict=True))]
        assert whole is not None
        return whole

    def bands(self, name: str) -> Iterator[Array]:
        """Yield a picture (height, width[, bands]) from top to bottom, some rows at a time."""
        height, width = self.shape
        for start in range(0, height, ROWS):
            yield self.read(name, (slice(start, min(start + ROWS, height)), slice(0, width)))


@dataclass(frozen=True)
class Cut(Marked):
    """Planes copied so that a tile can be read without the rest of them; each is looked at as a whole on the way.

    A part is a file of a few planes; in it lies, tile after tile, what each of its planes shows there.

    Attributes
    ----------
    folder : Path
        Where files and marks are written.
    count : int
        Planes.
    shape : tuple of int
        Of a plane, (height, width) or (height, width, bands).
    dtype : str
    side : int
        Rows and columns of a tile.
    """

    count: int
    shape: tuple[int, ...]
    dtype: str
    side: int

    def plane(self, z: int) -> Array:
        """Return plane ``z``; for subclasses."""
        raise NotImplementedError

    def look(self, plane: Array) -> Any:
        """Return what must be known of a whole plane; for subclasses."""
        raise NotImplementedError

    @property
    def places(self) -> list[Tile]:
        """Some planes each."""
        return list(tiles((self.count,), (PLANES_EACH,), (0,)))

    @property
    def boxes(self) -> list[Box]:
        """Rows and columns of every tile, row by row."""
        return [tile.write for tile in tiles(self.shape[:2], (self.side, self.side), (0, 0))]

    def do(self, k: int) -> dict[str, Any]:
        """Copy some planes."""
        here, said = self.places[k].write[0], []
        aside = self._file(k).with_suffix(".part")
        with aside.open("wb") as file:
            for z in range(here.start, here.stop):
                plane = self.plane(z)
                said.append(self.look(plane))
                for rows, columns in self.boxes:
                    file.seek(self._place(z, rows, columns))
                    file.write(np.ascontiguousarray(plane[rows, columns]).data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(self._file(k))
        return {"planes": said}

    def looked(self) -> list[Any]:
        """Return what is known of every plane."""
        return [about for said in self.found() for about in said["planes"]]

    def part(self, z: int, rows: slice, columns: slice) -> Array:
        """Return a part of plane ``z``."""
        part = np.empty((rows.stop - rows.start, columns.stop - columns.start, *self.shape[2:]), self.dtype)
        for down in self._tiles(rows, self.shape[0]):
            for right in self._tiles(columns, self.shape[1]):
                both = _overlap(rows, down), _overlap(columns, right)
                pixels = self._stored(z, down, right)
                part[_within(both[0], rows), _within(both[1], columns)] = pixels[
                    _within(both[0], down), _within(both[1], right)
                ]
        return part

    def _tiles(self, along: slice, length: int) -> list[slice]:
        starts = range(along.start // self.side * self.side, along.stop, self.side)
        return [slice(start, min(start + self.side, length)) for start in starts]

    def _stored(self, z: int, rows: slice, columns: slice) -> Array:
        shape = (rows.stop - rows.start, columns.stop - columns.start, *self.shape[2:])
        place = self._place(z, rows, columns)
        return np.memmap(self._file(z // PLANES_EACH), self.dtype, "r", offset=place, shape=shape)

    def _place(self, z: int, rows: slice, columns: slice) -> int:
        """Return where in its file a tile of plane ``z`` begins."""
        here = self.places[z // PLANES_EACH].write[0]
        height, width = rows.stop - rows.start, columns.stop - columns.start
        before = (here.stop - here.start) * (rows.start * self.shape[1] + columns.start * height)
        each = int(np.prod(self.shape[2:])) * np.dtype(self.dtype).itemsize
        return int((before + (z - here.start) * height * width) * each)

    def _file(self, k: int) -> Path:
        return self.folder / f"planes-{k}.raw"


def _overlap(a: slice, b: slice) -> slice:
    return slice(max(a.start, b.start), min(a.stop, b.stop))


def _within(part: slice, whole: slice) -> slice:
    return slice(part.start - whole.start, part.stop - whole.start)


def ranked(chunks: Callable[[], Iterable[Array]], ranks: Callable[[int], Sequence[int]]) -> list[float]:
    """Return the values that have some ranks among all, counted from 0, without having all at once.

    Parameters
    ----------
    chunks : callable
        Yields all values, float32 and none of them NaN, the same whenever it is called.
    ranks : callable
        Takes how many values there are, and returns the ranks that are wanted.

    Notes
    -----
    Two passes: the upper half of each value's bits is counted first, then the lower one of those that matter.
    """
    upper = np.zeros(1 << 16, np.int64)
    for values in chunks():
        upper += np.bincount(_in_order(values) >> 16, minlength=upper.size)
    ends = np.cumsum(upper)
    wanted = ranks(int(ends[-1]))
    tops = np.searchsorted(ends, wanted, side="right")
    lower = {int(top): np.zeros(1 << 16, np.int64) for top in tops}
    for values in chunks():
        keys = _in_order(values)
        for top in lower:
            lower[top] += np.bincount(keys[keys >> 16 == top] & 0xFFFF, minlength=1 << 16)
    found = []
    for rank, top in zip(wanted, map(int, tops), strict=True):
        before = int(ends[top] - upper[top])
        found.append(top << 16 | int(np.searchsorted(np.cumsum(lower[top]), rank - before, side="right")))
    return [float(v) for v in _values(np.array(found, np.uint32))]


def _in_order(values: Array) -> NDArray[np.int64]:
    """Return whole numbers that are ordered as single floats are."""
    bits = np.ascontiguousarray(values, np.float32).ravel().view(np.uint32)
    return np.where(bits >> 31, ~bits, bits | np.uint32(1 << 31)).astype(np.int64)


def _values(keys: NDArray[np.uint32]) -> NDArray[np.float32]:
    return np.where(keys >> 31, keys & np.uint32(0x7FFFFFFF), ~keys).astype(np.uint32).view(np.float32)


def percentiles(chunks: Callable[[], Iterable[Array]], percents: Sequence[float]) -> list[float]:
    """Return percentiles as `numpy.percentile` does, linear between values; values as for `ranked`, at least one."""
    places: list[float] = []

    def ranks(count: int) -> list[int]:
        places[:] = [(count - 1) * percent / 100 for percent in percents]
        return [int(side(place)) for place in places for side in (np.floor, np.ceil)]

    values = ranked(chunks, ranks)
    pairs = zip(values[::2], values[1::2], places, strict=True)
    return [low + (high - low) * (place % 1) for low, high, place in pairs]
