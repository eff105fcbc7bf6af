"""What installed packages contribute, by group of entry points: drivers, commands, operators, observers."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoints, entry_points


@cache
def installed(group: str) -> EntryPoints:
    """Return the entry points of a group; to read the records of all packages takes a tenth of a second, once."""
    return entry_points(group=group)
