"""Who has a port open, as far as this system tells."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

PROCESSES = Path("/proc")


@dataclass(frozen=True)
class Holder:
    """A program that has a port open."""

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (process {self.pid})"


def holders_of(device: str, processes: Path = PROCESSES) -> list[Holder]:
    """Return the programs that have a device open; only those of this user, unless root asks.

    Parameters
    ----------
    device : str
        A device or a link to one.
    processes : Path
        Where the system keeps its processes; nothing is found on systems without.
    """
    real = os.path.realpath(device)
    pids = sorted(int(entry.name) for entry in processes.glob("[0-9]*"))
    return [Holder(pid, _name(processes / str(pid))) for pid in pids if _has_open(processes / str(pid), real)]


def _has_open(process: Path, device: str) -> bool:
    try:
        return any(_target(handle) == device for handle in (process / "fd").iterdir())
    except OSError:  # of another user, or just ended
        return False


def _target(handle: Path) -> str | None:
    try:
        return str(handle.readlink())
    except OSError:
        return None


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return "?"
