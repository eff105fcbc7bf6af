"""What lies between two stacks when nothing is removed: waiting for the time, and a specimen to be tilted by hand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.standing import DONE, END, ENDS
from acquire.state import Phase, Question, Scope

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.control import Control
    from acquire.run_plan import RunPlan, Step
    from acquire.state import Board
    from devices.protocols import Clock

LOOK_S = 0.05


class Between:
    """The steps WAIT and TILT."""

    def __init__(
        self, plan: RunPlan, clock: Clock, control: Control, board: Board, note: Callable[[dict[str, Any]], None]
    ) -> None:
        self._plan = plan
        self._clock = clock
        self._control = control
        self._board = board
        self._note = note
        self._interval_s = plan.series.interval_ms / 1000 if plan.series else 0.0
        self._begin_s = 0.0

    def begin(self, first: int) -> None:
        """Let time count so that point ``first`` of a series is due now."""
        self._begin_s = self._clock.now() - first * self._interval_s

    def wait(self, step: Step) -> None:
        """Wait until a point in time is due; one that is late already begins at once."""
        self._board.phase = Phase.WAITING
        due_s = self._begin_s + step.section * self._interval_s
        while (left_s := due_s - self._clock.now()) > 0:
            self._control.heed(Scope.SECTION)
            self._clock.sleep(min(left_s, LOOK_S))

    def tilt(self, step: Step) -> None:
        """Have the specimen tilted; the operator's word is all that is known of it."""
        angle_deg, views = self._plan.tilts_deg[step.section], self._plan.times
        words = f"View {step.section + 1} of {views}: tilt the specimen to {angle_deg:+g}° and find the field."
        self._control.ask(Question("tilt", words, {DONE: "it is tilted: take the view", END: ENDS}))
        self._note({"e": "tilt", "section": step.section, "angle_deg": angle_deg})
