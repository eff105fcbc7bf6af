"""Whether work fits into memory, asked before it is begun."""

from __future__ import annotations

import os

from devices.errors import InputError

SHARE = 0.8  # of what is free; the rest is for everything else


def free_bytes() -> int:
    """Bytes that can be taken now without swapping."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:  # noqa: PTH123  no file of ours
            known = dict(line.split(":", 1) for line in lines)
        return int(known["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def check_memory(needed: float, what: str, fix: str) -> None:
    """Refuse work that needs more bytes than there are.

    Raises
    ------
    InputError
        ``memory``, with both figures.
    """
    free = SHARE * free_bytes()
    if needed > free:
        raise InputError(
            f"{what} needs {needed / 1e9:.1f} GB of memory; {free / 1e9:.1f} GB can be used.", fix=fix, code="memory"
        )
