"""Remove the rings of writers that died: a killed process cannot unlink its own file."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from acquire.ring_layout import WRITER_BYTE
from acquire.ring_locks import try_lock

if TYPE_CHECKING:
    from pathlib import Path


def sweep_stale(folder: Path, pattern: str = "stereotome-*.ring") -> tuple[Path, ...]:
    """Unlink every ring in ``folder``, or other file so locked, whose writer is gone, and return their paths.

    Readers still attached to one keep their memory. Other users' files are left alone.
    """
    return tuple(path for path in sorted(folder.glob(pattern)) if _unlink_if_stale(path))


def _unlink_if_stale(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:  # swept by somebody else, or not ours
        return False
    try:
        if stale := try_lock(fd, WRITER_BYTE):
            path.unlink(missing_ok=True)
        return stale
    finally:
        os.close(fd)
