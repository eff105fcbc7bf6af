"""The run of an instrument process: one at a time, in a thread of its own, watched through frozen values."""

from __future__ import annotations

import logging
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.engine import FINAL, RunState
from acquire.lanes import failed
from acquire.planning import plan_run
from acquire.recipe import recipe_from_text
from acquire.replies import Planned, Question, RunView, Started
from acquire.resume import interrupted_run
from acquire.session import Options, cost_of, needed_bytes, new_session, resumed_session, run_folder
from acquire.store import free_bytes
from devices.errors import InputError
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire import state
    from acquire.recipe import Recipe
    from acquire.requests import ContinueRun, PlanRun, StartRun
    from acquire.session import Outcome, Session
    from devices.protocols import Clock
    from devices.rig import Rig
    from devices.values import CameraCaps

log = logging.getLogger(__name__)
JUDGED = Options(inspect=None)


class HostedRun:
    """Starts runs and says how the present one, or the last one, stands.

    Parameters
    ----------
    tell : callable
        Told of every event of a run, in the run's thread.
    ended : callable
        Called when a run is over, in the run's thread.
    """

    def __init__(
        self, rig: Rig, clock: Clock, tell: Callable[[dict[str, Any]], None], ended: Callable[[], None]
    ) -> None:
        self._rig = rig
        self._clock = clock
        self._tell = tell
        self._ended = ended
        self._session: Session | None = None
        self._outcome: Outcome | None = None
        self._name = ""
        self._number = 0
        self._thread: threading.Thread | None = None
        self._started_s = 0.0
        self._taken_before = 0

    @property
    def active(self) -> bool:
        """Whether a run has the devices."""
        return self._thread is not None

    @property
    def ring_path(self) -> str:
        """File of the run's ring; empty without a run."""
        session = self._session
        return str(session.ring_path) if session is not None and self.active else ""

    def planned(self, asked: PlanRun, caps: CameraCaps) -> Planned:
        """Say what a recipe would do and cost; raises every problem of recipe and plan."""
        recipe, folder = self._read(asked)
        here_um = self._rig.stage.position_um() if recipe.stack.starts_here and not self.active else 0.0
        plan = plan_run(recipe, self._rig.spec, here_um)
        cost, stack = cost_of(plan, self._rig.spec, caps), plan.stack
        return Planned(
            folder=str(folder),
            planes=cost.planes,
            sections=plan.times,
            planes_each=stack.count,
            first_um=to_um(stack.z_nm(0)),
            last_um=to_um(stack.z_nm(stack.count - 1)),
            step_um=to_um(stack.step_nm),
            seconds=cost.seconds,
            dose_s=cost.dose_s,
            bytes_on_disk=cost.bytes_on_disk,
            needed_bytes=needed_bytes(cost.bytes_on_disk, recipe.output.keep_free_gb),
            free_bytes=free_bytes(folder.absolute()),
        )

    def start(self, asked: StartRun) -> Started:
        """Begin what a recipe says; raises every problem of recipe, plan and disk before anything moves."""
        recipe, folder = self._read(asked)
        return self._begin(recipe.name, new_session(recipe, self._rig, folder, self._clock, self._tell, JUDGED))

    def go_on(self, asked: ContinueRun) -> Started:
        """Take what a run lacks."""
        stored = interrupted_run(Path(asked.folder), None)
        return self._begin(stored.manifest["name"], resumed_session(stored, self._rig, self._clock, self._tell, JUDGED))

    def session(self) -> Session:
        """Return the run under way; raises `InputError` when there is none."""
        if self._session is None or not self.active:
            raise InputError("no run is under way.", fix="start one", code="no-run-active")
        return self._session

    def view(self) -> RunView | None:
        """Return how the run stands, or how the last one ended; None before the first."""
        session, outcome = self._session, self._outcome
        if session is None:
            return None
        status = session.status
        error, asked = (None, status.question) if outcome is None else (outcome.error, outcome.held)
        begun = outcome is None and status.state is RunState.IDLE  # it waits for its observers: nobody is idle
        return RunView(
            number=self._number,
            name=self._name,
            folder=str(session.folder),
            state=str(RunState.ARMING if begun else status.state),
            phase=str(status.phase),
            section=status.section,
            sections=status.sections,
            plane=status.plane,
            planned=status.planned,
            taken=status.taken,
            durable=status.durable,
            missed=len(status.missed),
            pausing=str(status.pausing or ""),
            question=_asked(asked),
            left_s=self._left_s(session),
            error=None if error is None else failed(error),
            warnings=() if outcome is None else outcome.warnings,
        )

    def end(self) -> None:
        """End the run after the plane in work and wait for it."""
        thread, session = self._thread, self._session
        if thread is not None and session is not None:
            session.cancel()
            thread.join()

    def _read(self, asked: PlanRun | StartRun) -> tuple[Recipe, Path]:
        """Return the recipe and the folder its run would have."""
        recipe = recipe_from_text(asked.recipe, asked.name, asked.overrides)
        out = None if asked.out is None else Path(asked.out)
        folder = run_folder(recipe, self._rig.spec, out, datetime.now(UTC).astimezone())
        return recipe, folder.absolute()  # clients live in other folders than this process

    def _begin(self, name: str, session: Session) -> Started:
        self._thread = threading.Thread(target=self._execute, args=[session], name="run")  # from here on it is active
        self._name, self._session, self._outcome = name, session, None
        self._started_s = self._clock.now()
        self._taken_before = session.status.durable
        self._number += 1  # last: whoever is told this number must not be told that nothing is under way
        self._thread.start()
        return Started(number=self._number, folder=str(session.folder), planned=len(session.plan))

    def _execute(self, session: Session) -> None:
        try:
            self._outcome = outcome = session.execute()
            self._tell({"event": "done", "state": str(outcome.state), "folder": str(outcome.folder)})
        except Exception:  # the run's thread ends here: the bench must be free again, whatever happened
            log.exception("a run ended by a bug")
        finally:
            self._thread = None
            self._ended()

    def _left_s(self, session: Session) -> float | None:
        """Return the time left if planes go on as they came."""
        status = session.status
        taken, left = status.taken, status.planned - self._taken_before - status.taken
        if not taken or status.state in FINAL or status.state is RunState.ARMING:
            return None
        return (self._clock.now() - self._started_s) / taken * left


def _asked(question: state.Question | None) -> Question | None:
    return (
        None if question is None else Question(code=question.code, words=question.words, answers=dict(question.answers))
    )
