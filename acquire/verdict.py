"""What a look at a frame or a section found, in words the engine can act on and a person can read."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from acquire.frame import FrameHeader


class Finding(StrEnum):
    """What is the matter with a frame or a section."""

    GOOD = "good"
    DEBRIS = "debris"
    FROZEN = "frozen"
    INCOMPLETE = "incomplete"
    SATURATED = "saturated"
    BLURRED = "blurred"
    DUPLICATE = "duplicate"
    LOST = "lost specimen"
    LIGHT = "light changed"
    THICKNESS = "thickness"


@dataclass(frozen=True)
class Verdict:
    """The outcome of one check.

    Attributes
    ----------
    finding : Finding
        The gravest thing found.
    words : str
        What was found, with value and limit; for people.
    planes : tuple of int
        Slots of the planes meant, as `SectionPlanes.slots` names them; empty for the section as a whole.
    figures : dict of str to float
        What was measured; kept in the journal.
    """

    finding: Finding = Finding.GOOD
    words: str = ""
    planes: tuple[int, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Whether there is nothing to mend."""
        return self.finding is Finding.GOOD


GOOD = Verdict()


class SectionPlanes(Protocol):
    """The durable planes of one section, read from the disk one by one as they are asked for."""

    @property
    def section(self) -> int:
        """Number of the section, from 0."""
        ...

    @property
    def slots(self) -> tuple[int, ...]:
        """Which planes there are, in the order of the plan."""
        ...

    def header(self, slot: int) -> FrameHeader:
        """Return what is known of a plane beside its pixels."""
        ...

    def pixels(self, slot: int) -> np.ndarray:
        """Return a plane, (height, width[, bands]) uint8 or uint16, checked against its checksum."""
        ...


if TYPE_CHECKING:
    Inspect = Callable[[SectionPlanes, SectionPlanes | None], Verdict]
    CheckFrame = Callable[[np.ndarray, np.ndarray | None], Verdict]


def no_inspection(section: SectionPlanes, previous: SectionPlanes | None) -> Verdict:  # noqa: ARG001  an `Inspect`
    """Find everything good."""
    return GOOD
