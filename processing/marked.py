"""Work in parts that stand for themselves: each is done by whoever comes, written, and then marked as done."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.ome_zarr import replace_json

if TYPE_CHECKING:
    from pathlib import Path

    from processing.tiles import Tile


@dataclass(frozen=True)
class Marked:
    """Work in parts. They can be done in any order, by threads or other machines, more than once, or another day.

    Attributes
    ----------
    folder : Path
        Where results and marks are written.
    """

    folder: Path

    @property
    def places(self) -> list[Tile]:
        """Where every part lies, in order; for subclasses."""
        raise NotImplementedError

    def do(self, k: int) -> dict[str, Any]:
        """Do part ``k``, what it writes being on the disk upon return; returns what it has to say; for subclasses."""
        raise NotImplementedError

    def mark(self, k: int) -> Path:
        """Return the file that says that part ``k`` is done."""
        return self.folder / f"part-{k}.json"

    def pending(self) -> list[int]:
        """Numbers of the parts that are not done."""
        return [k for k in range(len(self.places)) if not self.mark(k).exists()]

    def found(self) -> list[dict[str, Any]]:
        """Return what every part said, in order."""
        return [self.said(k) for k in range(len(self.places))]

    def said(self, k: int) -> dict[str, Any]:
        """Return what a part said that is done."""
        said: dict[str, Any] = json.loads(self.mark(k).read_text(encoding="utf-8"))
        return said

    def make_ready(self) -> None:
        """Make what the parts write into; what is left of it is kept with its marks."""
        self.folder.mkdir(parents=True, exist_ok=True)

    def forget(self) -> None:
        """Take the marks away: what the parts wrote is gone."""
        for k in range(len(self.places)):
            self.mark(k).unlink(missing_ok=True)

    def run(self, k: int) -> None:
        """Do part ``k`` and mark it, unless it is marked."""
        if not self.mark(k).exists():
            replace_json(self.mark(k), self.do(k))


def run_part(work: Marked, k: int) -> int:
    """Do a part; a plain function, so that it can be sent to other machines."""
    work.run(k)
    return k
