"""What the engine is given beside the devices: what it may decide, and where its frames and records go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from acquire.gate import TakesFrames

if TYPE_CHECKING:
    from collections.abc import Collection

    from acquire.frame import Missed
    from acquire.store import RunEnd
    from acquire.verdict import Finding, SectionPlanes


@dataclass(frozen=True)
class Policy:
    """What the engine may decide by itself.

    Attributes
    ----------
    gap_on_error : bool
        Record a plane that cannot be taken as missing and go on, instead of ending the run.
    triggered : bool
        Let stage and camera trigger each other; planes that this does not bring are taken one by one.
    asks : bool
        Ask the operator where the run would otherwise end.
    attended : bool
        Somebody may answer; without, a question ends the run as HELD.
    answers : tuple of str
        Given beforehand to the questions to come.
    accepts : collection of Finding
        Faults of a face that are noted and left as they are, where the operator would be asked.
    """

    gap_on_error: bool = False
    triggered: bool = False
    asks: bool = False
    attended: bool = True
    answers: tuple[str, ...] = ()
    accepts: frozenset[Finding] = frozenset()


CAREFUL = Policy()


class FrameOut(TakesFrames, Protocol):
    """Where the frames of a run go; `acquire.recorder.Recorder` at the bench."""

    @property
    def durable(self) -> int:
        """Planes that are verified on disk."""
        ...

    def check(self) -> None:
        """Raise if no further plane can be kept."""
        ...

    def missed(self, missed: Missed) -> None:
        """Record a plane that stays empty."""
        ...

    def finish(self, end: RunEnd, reason: str = "") -> RunEnd:
        """Make everything durable and return how the run really ended."""
        ...


class SectionOut(FrameOut, Protocol):
    """Where the frames of a run of sections go."""

    def note(self, record: dict[str, Any]) -> None:
        """Put a record into the journal; it is durable upon return."""
        ...

    def settle(self) -> None:
        """Wait until every frame handed over is durable."""
        ...

    def reject(self, slots: Collection[int], reason: str) -> None:
        """Take planes back: they are to be taken again."""
        ...

    def check_room(self, frames: int) -> None:
        """Raise unless that many frames can be kept."""
        ...

    def commit_section(self, section: int, waived: Collection[int]) -> None:
        """Record that a section is complete but for ``waived`` planes, and show it to readers."""
        ...

    def planes(self, section: int) -> SectionPlanes:
        """Return the durable planes of a section."""
        ...
