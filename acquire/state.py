"""Where a run stands, as frozen snapshots that any thread may read."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquire.frame import Missed


class RunState(StrEnum):
    """Where a run stands; `acquire.engine.Run` draws the machine."""

    IDLE = "IDLE"
    ARMING = "ARMING"
    RUNNING = "RUNNING"
    PAUSED = "PAUSED"
    HOLD = "HOLD"
    CANCELLING = "CANCELLING"
    FAULTED = "FAULTED"
    FINALISING = "FINALISING"
    COMPLETED = "COMPLETED"
    COMPLETED_WITH_GAPS = "COMPLETED_WITH_GAPS"
    CANCELLED = "CANCELLED"
    FAILED = "FAILED"
    HELD = "HELD"


FINAL = {RunState.COMPLETED, RunState.COMPLETED_WITH_GAPS, RunState.CANCELLED, RunState.FAILED, RunState.HELD}


class Phase(StrEnum):
    """What a running run does at the moment."""

    WAITING = "waiting"
    PARKING = "parking"
    FEEDING = "feeding"
    CUTTING = "cutting"
    CLEARING = "clearing"
    CLEANING = "cleaning"
    INSPECTING = "inspecting"
    SWEEPING = "sweeping"
    FOCUSING = "focusing"
    MOVING = "moving"
    SETTLING = "settling"
    EXPOSING = "exposing"
    RETURNING = "returning"
    PERSISTING = "persisting"
    COMMITTING = "committing"


class Scope(StrEnum):
    """How far a run goes on before it pauses, the shortest first."""

    PLANE = "plane"
    STACK = "stack"
    SECTION = "section"
    BEFORE_CUT = "before_cut"

    def within(self, boundary: Scope) -> bool:
        """Tell whether a pause of this scope is due at a boundary."""
        order = list(Scope)
        return order.index(self) <= order.index(boundary)


@dataclass(frozen=True)
class Question:
    """What a run on HOLD wants to know.

    Attributes
    ----------
    code : str
        Stable name, that of the error or finding that led to it.
    words : str
        What happened and what has to be decided, for people.
    answers : dict of str to str
        Each choice and what it does, the safest last.
    """

    code: str
    words: str
    answers: Mapping[str, str]


@dataclass(frozen=True)
class RunStatus:
    """A snapshot of a run.

    Attributes
    ----------
    section, sections : int
        Section in work, from 0, and how many are planned; a single stack is one section.
    plane : int
        Plane of the stack in work, or the last one.
    planned, taken, durable : int
        Planes of the whole run that are planned, that were exposed, and that are verified on disk.
    missed : tuple of Missed
        Planes that were given up.
    question : Question or None
        What a run on HOLD asks; answer with `Run.answer`.
    pausing : Scope or None
        The pause that is asked for and not reached yet, or that holds now.
    """

    state: RunState
    phase: Phase
    plane: int
    planned: int
    taken: int
    durable: int
    missed: tuple[Missed, ...] = ()
    section: int = 0
    sections: int = 1
    question: Question | None = None
    pausing: Scope | None = None


@dataclass
class Board:
    """What the engine's parts write down and `RunStatus` is made from; written by the run's thread alone."""

    state: RunState = RunState.IDLE
    phase: Phase = Phase.WAITING
    section: int = 0
    plane: int = 0
    taken: int = 0
    missed: list[Missed] = field(default_factory=list)
