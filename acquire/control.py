"""What people ask of a running run, from any thread; the engine heeds it between its steps."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Any

from acquire.state import RunState, Scope
from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.state import Board, Question
    from devices.protocols import Clock

    Note = Callable[[dict[str, Any]], None]

WAIT_S = 0.01
END = "end"


class Cancelled(Exception):
    """The operator ended the run; raised between steps, caught by the engine alone."""


class Held(Exception):
    """A question came up and nobody is there to answer; caught by the engine alone.

    Attributes
    ----------
    question : Question
        What has to be decided.
    """

    def __init__(self, question: Question) -> None:
        super().__init__(question.words)
        self.question = question


class Control:
    """Pause, cancel, stop and answers.

    Parameters
    ----------
    board : Board
        Where the run stands.
    note : callable
        Writes a record into the journal.
    tell : callable
        Told of each change.
    attended : bool
        Whether somebody may answer; without, a question ends the run as HELD.
    answers : sequence of str
        Given beforehand to the questions to come, in this order, as far as they are answers to them.
    """

    def __init__(
        self,
        board: Board,
        clock: Clock,
        *,
        note: Note = lambda _: None,
        tell: Note = lambda _: None,
        attended: bool = True,
        answers: Sequence[str] = (),
    ) -> None:
        self._board = board
        self._clock = clock
        self._note = note
        self._tell = tell
        self._attended = attended
        self._prepared = deque(answers)
        self._cancelled = threading.Event()
        self._stopped = threading.Event()
        self._choice: str | None = None
        self.pausing: Scope | None = None
        self.question: Question | None = None

    @property
    def cancelled(self) -> bool:
        """Whether the run is to end."""
        return self._cancelled.is_set()

    @property
    def stopped(self) -> bool:
        """Whether all motion is to end."""
        return self._stopped.is_set()

    def pause(self, scope: Scope = Scope.PLANE) -> None:
        """Wait at the end of the ``scope`` in work until `resume` or `cancel`."""
        self.pausing = scope
        self._tell({"event": "pause", "scope": str(scope)})

    def resume(self) -> None:
        """Go on after `pause`."""
        self.pausing = None

    def cancel(self) -> None:
        """End at the next step."""
        self._cancelled.set()

    def stop(self) -> None:
        """End at once."""
        self._stopped.set()
        self._cancelled.set()

    def answer(self, choice: str) -> None:
        """Answer the question of a run on HOLD.

        Raises
        ------
        InputError
            Nothing is asked, or this is none of the answers.
        """
        question = self.question
        if question is None:
            raise InputError(
                "nothing is asked at the moment.", fix="wait until the run is on HOLD.", code="no-question"
            )
        if choice not in question.answers:
            raise InputError(
                f"'{choice}' is no answer to this.", fix=f"answer {' or '.join(question.answers)}", code="no-answer"
            )
        self._choice = choice

    def checkpoint(self) -> None:
        """Raise `Cancelled` if the run is to end."""
        if self.cancelled:
            raise Cancelled

    def enter(self, state: RunState) -> None:
        """Note the state and tell it."""
        self._board.state = state
        self._tell({"event": "state", "state": str(state)})

    def heed(self, boundary: Scope) -> None:
        """Wait here if a pause is due at this boundary; raise `Cancelled` if the run is to end."""
        if self._due(boundary):
            self.enter(RunState.PAUSED)
            while self._due(boundary) and not self.cancelled:
                self._clock.sleep(WAIT_S)
            self.enter(RunState.RUNNING)
        self.checkpoint()

    def _due(self, boundary: Scope) -> bool:
        pausing = self.pausing
        return pausing is not None and pausing.within(boundary)

    def ask(self, question: Question, *, solved: Callable[[], bool] = lambda: False) -> str:
        """Put the run on HOLD until its question is answered, or ``solved`` says that its cause is gone.

        Returns the choice; the first of the answers when the cause went away by itself.

        Raises
        ------
        Cancelled
            The run was cancelled, or the answer is to end it.
        Held
            Nobody is there to answer.
        """
        asked = {"code": question.code, "question": question.words, "answers": dict(question.answers)}
        self._note({"e": "hold", "section": self._board.section, **asked})
        prepared = bool(self._prepared) and self._prepared[0] in question.answers
        asks = self._attended and not prepared
        if asks:  # before it is told: who hears of it may answer at once
            self._choice, self.question = None, question
        self._tell({"event": "hold", "section": self._board.section, "asks": asks, **asked})
        if not (prepared or asks):
            raise Held(question)
        choice = self._prepared.popleft() if prepared else self._wait_for_answer(question, solved)
        self._note({"e": "answer", "section": self._board.section, "code": question.code, "choice": choice})
        if choice == END:
            self.cancel()
        self.checkpoint()
        return choice

    def _wait_for_answer(self, question: Question, solved: Callable[[], bool]) -> str:
        self.enter(RunState.HOLD)
        while not (choice := self._answered(question, solved)):
            self._clock.sleep(WAIT_S)
        self.question = None
        self.enter(RunState.RUNNING)
        return choice

    def _answered(self, question: Question, solved: Callable[[], bool]) -> str:
        """Return the answer, or what stands for one; empty while there is none."""
        if self.cancelled:
            return END
        return self._choice or (next(iter(question.answers)) if solved() else "")
