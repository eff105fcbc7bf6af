"""A run that another process takes, with the face of a session of one's own."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.client import Instrument
from acquire.client_io import error_of
from acquire.frame import Missed
from acquire.meeting import connection_file, is_served
from acquire.replies import Event
from acquire.requests import CancelRun, Stop
from acquire.session import Outcome
from acquire.state import Phase, Question, RunState, RunStatus, Scope
from devices.errors import InputError
from devices.rig import load_rig

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import ExitStack

    from acquire import replies


def served_instrument(stack: ExitStack, server: bool | str, instrument: Path | None) -> Instrument | None:  # noqa: FBT001
    """Connect to the process that serves an instrument, None when it is to be opened here.

    Parameters
    ----------
    server : bool or str
        As on the command line: False for none in particular, True for the one there is, or a name as of
        `acquire.client.Instrument.connect`.
    instrument : Path or None
        An instrument file; when its instrument is being served, its devices are that process's.

    Raises
    ------
    ServerGone
        One is asked for and nobody answers.
    """
    name = load_rig(instrument).name if instrument is not None else None
    if isinstance(server, str):
        return stack.enter_context(Instrument.connect(server))
    if server or (name is not None and is_served(connection_file(name))):
        return stack.enter_context(Instrument.connect(name))
    return None


def remote_session(
    instrument: Instrument,
    recipe: Path | None,
    resume: Path | None,
    overrides: Sequence[str],
    out: Path | None,
    tell: Callable[[dict[str, Any]], None],
) -> RemoteSession:
    """Command an instrument process and begin a run there.

    Raises
    ------
    DeviceBusy
        Somebody else commands it, or a run is under way.
    StereotomeError
        Everything `acquire.session.new_session` raises.
    """
    instrument.command()
    if resume is not None:
        return RemoteSession(instrument, partial(instrument.continue_run, resume.absolute()), tell)
    if recipe is None:
        raise InputError("no recipe is given.", fix=("name its file", "go on with a run: --resume RUN"), code="usage")
    where = None if out is None else out.absolute()
    return RemoteSession(instrument, partial(instrument.start_run, recipe, overrides=overrides, out=where), tell)


class RemoteSession:
    """What `acquire.session.Session` is, for a run of an instrument process.

    Parameters
    ----------
    instrument : Instrument
        Commanded by this program.
    begin : callable
        Begins the run.
    tell : callable
        Told of the run's events; of those that were lost on the way it is not.
    """

    def __init__(
        self, instrument: Instrument, begin: Callable[[], replies.Started], tell: Callable[[dict[str, Any]], None]
    ) -> None:
        self._instrument = instrument
        self._tell = tell
        instrument.listen(self._heard)
        started = begin()
        self.folder = Path(started.folder)
        self.plan = range(started.planned)
        self._number = started.number

    @property
    def run(self) -> RemoteSession:
        """What can be cancelled and stopped: itself."""
        return self

    @property
    def status(self) -> RunStatus:
        """Where the run stood when it was heard of last."""
        return _status(self._view())

    def cancel(self) -> None:
        """End after the exposure or cut in progress; returns before it is done."""
        self._instrument.ask(CancelRun())

    def stop(self) -> None:
        """End and stop all motion at once; returns before it is done."""
        self._instrument.ask(Stop())

    def answer(self, choice: str) -> None:
        """Answer the question of a run on HOLD."""
        self._instrument.answer(choice)

    def execute(self) -> Outcome:
        """Wait until the run is over and return how it ended; raises `ServerGone` when its process fell silent."""
        view = self._instrument.wait_for_run()
        status = _status(view)
        error = None if view.error is None else error_of(view.error)
        return Outcome(status.state, error, self.folder, view.durable, view.planned, view.warnings, status.question)

    def _view(self) -> replies.RunView:
        state = self._instrument.wait_for(self._knows_it, float("inf"))
        assert state.run is not None
        return state.run

    def _knows_it(self, state: replies.State) -> bool:
        return state.run is not None and state.run.number >= self._number

    def _heard(self, told: replies.Told) -> None:
        if isinstance(told, Event) and told.event.get("event") != "done":  # our own report says that
            self._tell(told.event)


def _status(view: replies.RunView) -> RunStatus:
    asked = view.question
    question = None if asked is None else Question(asked.code, asked.words, asked.answers)
    return RunStatus(
        state=RunState(view.state),
        phase=Phase(view.phase),
        plane=view.plane,
        planned=view.planned,
        taken=view.taken,
        durable=view.durable,
        missed=(Missed(-1, "told by the run's own journal"),) * view.missed,
        section=view.section,
        sections=view.sections,
        question=question,
        pausing=Scope(view.pausing) if view.pausing else None,
    )
