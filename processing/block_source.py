"""The stack that parts of a job read, wherever they are done."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from pathlib import Path


def when_changed(path: Path) -> int:
    """Return when a file or folder was changed last, in ns; 0 of a pattern of names."""
    return path.stat().st_mtime_ns if path.exists() else 0


@dataclass(frozen=True)
class Source:
    """A stack by its name and what the user said about it; opened once by whoever reads it.

    Attributes
    ----------
    path : Path
    step_um, channel, time
        As for `open_stack`.
    """

    path: Path
    step_um: float | None = None
    channel: int | None = None
    time: int | None = None

    @property
    def stack(self) -> Stack:
        """The stack, opened."""
        return _opened(self, when_changed(self.path))

    @property
    def absolute(self) -> Source:
        """The same under a name that holds in other programs."""
        return replace(self, path=self.path.absolute())

    def told(self) -> dict[str, Any]:
        """Return what must be the same for parts to be used again."""
        return {**asdict(self), "path": str(self.path.resolve()), "changed": when_changed(self.path)}


@lru_cache(maxsize=4)
def _opened(source: Source, _changed: int) -> Stack:
    return open_stack(source.path, step_um=source.step_um, channel=source.channel, time=source.time)
