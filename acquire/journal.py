"""The run's diary: JSON lines with a sequence number and a checksum, on disk before anything relies on them."""

from __future__ import annotations

import fcntl
import json
import os
import threading
import zlib
from typing import TYPE_CHECKING, Any

from devices.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from devices.protocols import Clock

Record = dict[str, Any]


def encode(record: Record) -> bytes:
    """Return a record as one line; its ``crc`` covers all other fields as they stand in the line."""
    body = json.dumps(record, separators=(",", ":"), ensure_ascii=False)
    crc = zlib.crc32(body.encode())
    return f'{body[:-1]},"crc":"{crc:08x}"}}\n'.encode()


def decode(line: bytes) -> Record | None:
    """Return the record of a line, or None when the line is torn or altered."""
    body, mark, rest = line.rpartition(b',"crc":"')
    if not mark or not rest.endswith(b'"}\n'):
        return None
    body += b"}"
    if f"{zlib.crc32(body):08x}".encode() != rest[:-3]:
        return None
    record: Record = json.loads(body)
    return record


def read(path: Path) -> tuple[list[Record], int]:
    """Return all whole records and the length in bytes they take up; a torn tail is left out.

    Raises
    ------
    StoreError
        A record before the last is damaged or missing: the journal was altered.
    """
    records: list[Record] = []
    good = 0
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in enumerate(lines):
        record = decode(line)
        if record is None and number == len(lines) - 1:
            break
        if record is None or record["n"] != number:
            raise StoreError(
                f"{path}: record {number} is damaged.",
                why="The journal was changed after it was written, or the disk is failing.",
                fix="the planes can still be read with any OME-Zarr reader; do not resume this run.",
                code="journal-damaged",
            )
        records.append(record)
        good += len(line)
    return records, good


def is_open_elsewhere(path: Path) -> bool:
    """Tell whether a living process is writing this journal; the kernel frees its lock when it dies."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


class Journal:
    """Append-only writer. `append` returns when the records are durable."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._file)
            raise StoreError(
                f"{path.parent} is being written by another run.",
                fix="wait for it to end, or choose another folder: --out DIR",
                code="run-busy",
            ) from None
        records, good = read(path)
        os.ftruncate(self._file, good)
        self._next = len(records)
        self._good = good

    def append(self, *events: Record) -> None:
        """Write records and wait until they are on the disk. Each event names itself in ``e``.

        Raises
        ------
        OSError
            The disk refused; nothing after the last durable record may be relied on.
        """
        with self._lock:
            t_ns = round(self._clock.now() * 1e9)
            data = b"".join(encode({"n": self._next + k, "t": t_ns, **event}) for k, event in enumerate(events))
            try:
                _write_all(self._file, data)
                os.fdatasync(self._file)
            except OSError:
                os.ftruncate(self._file, self._good)  # leave no torn line for the next record to follow
                raise
            self._next += len(events)
            self._good += len(data)

    def close(self) -> None:
        """Close the file and free the lock."""
        os.close(self._file)


def _write_all(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:  # a nearly full disk takes part of it and says nothing
        view = view[os.write(file, view) :]
