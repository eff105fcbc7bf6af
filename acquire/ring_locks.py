"""Who is alive: one byte of the ring's file is locked by each party, and the kernel unlocks it when that party dies.

The locks are open-file-description locks (Linux): they belong to one `os.open`, not to a process, so two readers in
one process are two parties; they survive nothing, not even ``kill -9``; and asking about one does not take it.
A process that forks without exec shares them with its child, so a holder must not fork while it holds a ring.
"""

from __future__ import annotations

import struct
import sys

from devices.errors import StoreError

if sys.platform != "linux":
    raise StoreError(
        "frames cannot be passed between processes on this system",
        why="the ring needs Linux: locks that die with their owner, and memory reserved beforehand.",
        fix="run on Linux; stacks on disk can be processed on any system.",
        code="ring-platform",
    )

import fcntl

# struct flock: type, whence, start, length, pid. The pid must be 0 for open-file-description locks.
_FLOCK = struct.Struct("hhqqi0q")


def try_lock(fd: int, byte: int) -> bool:
    """Lock ``byte`` of the file for the life of ``fd``; False when another party holds it."""
    try:
        _control(fd, fcntl.F_OFD_SETLK, fcntl.F_WRLCK, byte)
    except BlockingIOError:
        return False
    return True


def unlock(fd: int, byte: int) -> None:
    """Give up ``byte``. Closing ``fd`` is not enough: a memory map of the file keeps a copy of it."""
    _control(fd, fcntl.F_OFD_SETLK, fcntl.F_UNLCK, byte)


def is_locked(fd: int, byte: int) -> bool:
    """Return whether another party holds ``byte``, without touching the lock (0.5 µs)."""
    return _control(fd, fcntl.F_OFD_GETLK, fcntl.F_WRLCK, byte) != fcntl.F_UNLCK


def _control(fd: int, command: int, kind: int, byte: int) -> int:
    reply = fcntl.fcntl(fd, command, _FLOCK.pack(kind, 0, byte, 1, 0))
    return int(_FLOCK.unpack(reply)[0])
