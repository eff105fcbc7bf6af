"""The instrument as the console has it: asked without ever waiting, found again when it was gone."""

from __future__ import annotations

import getpass
import threading
from collections import deque
from typing import TYPE_CHECKING

from msgspec import structs

from acquire import replies, requests
from acquire.meeting import ServerGone
from devices.clock import SystemClock
from devices.errors import DeviceBusy, StereotomeError
from display.console.journal import event_words

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from acquire.client import Instrument
    from devices.protocols import Clock
    from devices.rig import RigSpec
    from display.console.journal import Journal

    Answered = Callable[[replies.AnyReply | StereotomeError], None]

GONE_S = 4.0  # it tells its state once a second at least
AGAIN_S = 0.5


class Bench:
    """One instrument, its state as told last, and what was asked of it.

    A thread of its own connects, takes command and looks whether the instrument is still there. `settle` hands the
    answers over in the thread that calls it, so that the panels need no locks.

    Parameters
    ----------
    connect : callable
        Returns a connected client; may wait.
    journal : Journal
        Told of what goes wrong and of what happens in a run.
    anew : callable
        Ends the instrument's process and starts it again; False when that is not this console's to do.

    Attributes
    ----------
    rig : RigSpec or None
        What the instrument is, once it was met.
    wake : callable
        Called, in another thread, when something was told that differs from what was told before.
    stop_asked : bool
        STOP was pressed and the instrument did not yet say that it is stopped.
    """

    def __init__(
        self,
        connect: Callable[[], Instrument],
        journal: Journal,
        clock: Clock | None = None,
        *,
        anew: Callable[[], bool] = lambda: False,
    ) -> None:
        self.actor = getpass.getuser()
        self.rig: RigSpec | None = None
        self.stop_asked = False
        self.wake: Callable[[], None] = lambda: None
        self._connect = connect
        self._anew = anew
        self._wants_anew = False
        self._journal = journal
        self._clock = clock or SystemClock()
        self._instrument: Instrument | None = None
        self._wants_command = True
        self._answers: deque[tuple[Answered, replies.AnyReply | StereotomeError]] = deque()
        self._said = ""
        self._news: replies.State | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="bench", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether the instrument answers."""
        instrument = self._instrument
        return instrument is not None and instrument.silent_s < GONE_S

    @property
    def state(self) -> replies.State | None:
        """How things stand, as told last; None before."""
        instrument = self._instrument
        return None if instrument is None else instrument.told

    @property
    def commands(self) -> bool:
        """Whether this console commands the instrument."""
        instrument = self._instrument
        return instrument is not None and instrument.commands and self.connected

    @property
    def ring(self) -> str:
        """File of the ring in which frames appear now; empty for none."""
        state = self.state
        return state.ring if state is not None and self.connected else ""

    @property
    def instrument(self) -> Instrument | None:
        """The connection; None while there is none."""
        return self._instrument

    def take_command(self) -> None:
        """Become the one who commands as soon as nobody else does."""
        self._wants_command = True

    def give_command(self) -> None:
        """Let somebody else command."""
        self._wants_command = False

    def start_anew(self) -> None:
        """Have the instrument's process started again: devices that were lost are opened anew, nothing moves."""
        self._wants_anew = True

    def ask(
        self, request: requests.AnyRequest, place: str, answered: Answered | None = None, *, quiet: bool = False
    ) -> None:
        """Ask; an error goes to the journal under ``place``, the answer to ``answered`` when `settle` is called."""
        instrument = self._instrument
        if instrument is None or not self.connected:
            error = ServerGone("the instrument does not answer. Nothing was done.")
            if not quiet:
                self._journal.error(place, error)
            if answered is not None:
                self._answers.append((answered, error))
            return
        asked = instrument.ask(request)
        asked.add_done_callback(lambda answer: self._answered(answer, "" if quiet else place, answered))

    def stop(self) -> None:
        """Stop all motion now; waits for nothing."""
        instrument = self._instrument
        self.stop_asked = True
        if instrument is None:
            self._journal.add("error", "STOP", "the instrument does not answer: stop it at the hardware.")
            return
        asked = instrument.ask(requests.Stop())
        asked.add_done_callback(lambda answer: self._answered(answer, "STOP", self._stopped))

    def settle(self) -> None:
        """Hand over the answers that came since the last call."""
        while self._answers:
            answered, answer = self._answers.popleft()
            answered(answer)

    def close(self) -> None:
        """Leave; the instrument goes on."""
        self._over.set()
        self._thread.join()
        self._leave()

    def _stopped(self, answer: replies.AnyReply | StereotomeError) -> None:
        self.stop_asked = isinstance(answer, StereotomeError)
        if isinstance(answer, replies.Stopped):
            level = "error" if answer.failed else "warning"
            self._journal.add(
                level,  # type: ignore[arg-type]
                "STOP",
                f"stopped: {', '.join(answer.told) or 'nothing'}"
                + (f"; not stopped: {', '.join(answer.failed)}" if answer.failed else ""),
            )

    def _answered(self, answer: Future[replies.AnyReply], place: str, answered: Answered | None) -> None:
        """Note an answer, in the client's thread; an error is told unless ``place`` is empty."""
        error = answer.exception()
        if isinstance(error, StereotomeError) and place:
            self._journal.error(place, error)
        if answered is not None:
            self.wake()
            self._answers.append((answered, error if isinstance(error, StereotomeError) else answer.result()))

    def _keep(self) -> None:
        """Connect, and connect again when the instrument was gone."""
        while not self._over.is_set():
            try:
                self._look()
            except StereotomeError as error:
                self._say("warning", error.what)
            self._over.wait(AGAIN_S)

    def _look(self) -> None:
        if self._wants_anew:
            self._wants_anew = False
            self._start_anew()
        if self._instrument is not None and self._instrument.silent_s > GONE_S:
            self._say("error", "the instrument fell silent; looking for it again.")
            self._leave()
        if self._instrument is None:
            self._meet()
        assert self._instrument is not None
        if self._wants_command and not self._instrument.commands:
            self._command(self._instrument)
        elif self._instrument.commands and not self._wants_command:
            self._instrument.release()

    def _start_anew(self) -> None:
        self._say("info", "the instrument's process is started anew ...")
        self._leave()
        if not self._anew():
            self._say("warning", "it was started elsewhere: end it there, and start it again: stereotome serve")

    def _meet(self) -> None:
        instrument = self._connect()
        try:
            self.rig = instrument.instrument()
            instrument.listen(self._heard)
            instrument.refresh()
        except BaseException:
            instrument.close()
            raise
        self._instrument = instrument
        if self.stop_asked:  # by one who pressed it while nothing answered: it may have been lost on the way
            self.stop()
        self._say("info", f"connected to {instrument.welcome.instrument}")

    def _command(self, instrument: Instrument) -> None:
        try:
            instrument.command(self.actor)
        except DeviceBusy as error:  # somebody else commands; asked again until they stop
            self._say("warning", error.what)
        else:
            self._say("info", f"{self.actor} commands")

    def _leave(self) -> None:
        instrument, self._instrument = self._instrument, None
        if instrument is not None:
            instrument.close()

    def _heard(self, told: replies.Told) -> None:
        if isinstance(told, replies.State):
            news, before = structs.replace(told, z_age_s=0.0, utc_ns=0), self._news
            if news != before:
                self._news = news
                self.wake()
            if news.why_stopped and (before is None or not before.why_stopped):
                self._journal.add("error", "STOP", news.why_stopped)
        if isinstance(told, replies.Event) and (words := event_words(told.event)):
            self._journal.add(words[0], "run", words[1])

    def _say(self, level: str, words: str) -> None:
        """Say once what goes on, however often it is met."""
        if words != self._said:
            self._said = words
            self._journal.add(level, "instrument", words)  # type: ignore[arg-type]
