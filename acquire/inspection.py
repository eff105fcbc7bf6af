"""What becomes of a face that was imaged: wiped and taken again, taken again, accepted, or shown to the operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.standing import ACCEPT, AGAIN, END, ENDS
from acquire.state import Phase, Question
from acquire.verdict import Finding

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from acquire.control import Control
    from acquire.state import Board
    from acquire.verdict import Inspect, SectionPlanes, Verdict

RETAKES = 2
WORTH_RETAKING = {Finding.FROZEN, Finding.INCOMPLETE, Finding.SATURATED, Finding.BLURRED, Finding.DUPLICATE}


@dataclass(frozen=True)
class Hands:
    """What an inspection may have done.

    Attributes
    ----------
    planes : callable
        Gives the durable planes of a section, all that were taken.
    retake : callable
        Takes planes again, for a reason.
    sweep : callable or None
        Wipes the face of a section; None without a knife.
    note, tell : callable
        Journal and listeners.
    """

    planes: Callable[[int], SectionPlanes]
    retake: Callable[[Collection[int], str], None]
    sweep: Callable[[int], None] | None
    note: Callable[[dict[str, Any]], None]
    tell: Callable[[dict[str, Any]], None]


class Inspection:
    """Looks at each face before it is cut away.

    Parameters
    ----------
    inspect : callable
        Tells what is the matter.
    sweeps : int
        How often a face is wiped before the operator is asked.
    accepts : collection of Finding
        What is left as it is, noted in the journal, where the operator would be asked.
    """

    def __init__(
        self,
        inspect: Inspect,
        hands: Hands,
        control: Control,
        board: Board,
        *,
        sweeps: int,
        accepts: Collection[Finding] = (),
    ) -> None:
        self._inspect = inspect
        self._hands = hands
        self._control = control
        self._board = board
        self._sweeps = sweeps
        self._accepts = accepts

    def look(self, section: int) -> None:
        """Look at a section until it is good or accepted."""
        tries: dict[Finding, int] = {}
        while not (verdict := self._judge(section)).good:
            tries[verdict.finding] = tries.get(verdict.finding, 0) + 1
            if not self._mend(section, verdict, tries[verdict.finding]):
                return

    def _judge(self, section: int) -> Verdict:
        self._board.phase = Phase.INSPECTING
        previous = self._hands.planes(section - 1) if section else None
        verdict = self._inspect(self._hands.planes(section), previous)
        told = {"section": section, "finding": str(verdict.finding), "words": verdict.words}
        told |= {"planes": list(verdict.planes), "figures": dict(verdict.figures)}
        self._hands.note({"e": "verdict", **told})
        self._hands.tell({"event": "verdict", **told})
        return verdict

    def _mend(self, section: int, verdict: Verdict, tries: int) -> bool:
        """Do what may help; False when the section is accepted as it is."""
        sweep = self._hands.sweep
        if verdict.finding is Finding.DEBRIS and sweep and tries <= self._sweeps:
            sweep(section)
        elif not (verdict.finding in WORTH_RETAKING and tries <= RETAKES):
            if verdict.finding in self._accepts or self._ask(verdict) == ACCEPT:
                self._hands.note({"e": "accepted", "section": section, "finding": str(verdict.finding)})
                return False
            if verdict.finding is Finding.DEBRIS and sweep:
                sweep(section)
        slots = verdict.planes or self._hands.planes(section).slots
        self._hands.retake(slots, f"{verdict.finding}: {verdict.words}")
        return True

    def _ask(self, verdict: Verdict) -> str:
        wipes = "wipe the face once more and take it again" if verdict.finding is Finding.DEBRIS else "take it again"
        answers = {AGAIN: wipes, ACCEPT: "accept the section as it is", END: ENDS}
        return self._control.ask(Question(str(verdict.finding).replace(" ", "-"), verdict.words, answers))
