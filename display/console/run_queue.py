"""Runs one after the other: recipes that wait, the next started when the one before has completed, and only then."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING

from acquire import replies, requests
from acquire.state import FINAL, RunState
from devices.errors import StereotomeError
from processing.outputs import write_durably

if TYPE_CHECKING:
    from pathlib import Path

    from display.console.model import Console

GOOD = RunState.COMPLETED


@dataclass(frozen=True)
class Queued:
    """A run to come: its name and the recipe's text."""

    name: str
    recipe: str


@cache
def queue_file(folder: Path, instrument: str) -> Path:
    """Return the file in which the runs that wait for an instrument are kept."""
    return folder / f"queue-{re.sub(r'[^A-Za-z0-9._-]', '_', instrument)[:60]}.json"


def stored(file: Path) -> list[Queued]:
    """Return the runs kept in a file; none where it is not there, or is no such file."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        return [Queued(str(each["name"]), str(each["recipe"])) for each in told]
    except (OSError, ValueError, TypeError, KeyError):
        return []


@dataclass
class RunQueue:
    """Runs that wait their turn; kept in a file, so that they outlive this console.

    Attributes
    ----------
    waiting : list of Queued
        The next first.
    going : bool
        The next is started as soon as that can be done.
    held : str
        Why it goes on no longer, in words.
    """

    waiting: list[Queued] = field(default_factory=list)
    going: bool = False
    held: str = ""
    _file: Path | None = None
    _known: list[Queued] = field(default_factory=list)
    _asked: bool = False
    _number: int = 0

    def keep(self, file: Path) -> None:
        """Write each change into a file; what another console left in it is taken over, and starts when told to.

        Raises
        ------
        OSError
            It cannot be written; not tried again before the next change.
        """
        if self._file != file:
            self._file, left = file, stored(file)
            if left != self._known:
                added = [each for each in self.waiting if each not in self._known]
                self.waiting, self.going, self.held = left + added, False, "these were left by another console"
            self._known = left
        if self._known != self.waiting:
            self._known = list(self.waiting)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_durably(file, json.dumps([asdict(each) for each in self.waiting], ensure_ascii=False).encode())

    def leave(self) -> None:
        """Leave the file alone while this console does not command: another one may change it."""
        self._file = None

    def add(self, name: str, recipe: str) -> None:
        """Let a recipe wait behind the others."""
        self.waiting.append(Queued(name, recipe))

    def move(self, place: int, by: int) -> None:
        """Exchange a run with a neighbour."""
        other = place + by
        if 0 <= other < len(self.waiting):
            self.waiting[place], self.waiting[other] = self.waiting[other], self.waiting[place]

    def go(self, console: Console) -> None:
        """Start the next, and the others after it; a run under way is waited for."""
        self.going, self.held = True, ""
        self._number = console.run.number if console.running and console.run is not None else 0

    def hold(self, why: str) -> None:
        """Start nothing more until `go`."""
        self.going, self.held = False, why

    def tick(self, console: Console) -> None:
        """Start what is due."""
        if not self.going or self._asked or console.running:
            return
        run = console.run
        if (0 if run is None else run.number) < self._number:
            return  # it began, and its state is not told yet
        if run is not None and run.number == self._number and run.state in FINAL and run.state != GOOD:
            self.hold(f"the run before ended as {run.state}")
            console.journal.add("error", "queue", f"{self.held}: {len(self.waiting)} runs wait.")
        elif not self.waiting:
            self.going = False
        elif why := console.why_no_motion():
            self.held = why
        else:
            self._start(console)

    def _start(self, console: Console) -> None:
        self._asked, self.held = True, ""
        first = self.waiting[0]
        console.bench.ask(
            requests.StartRun(recipe=first.recipe, name=first.name), "queue", partial(self._started, first)
        )

    def _started(self, first: Queued, answer: replies.AnyReply | StereotomeError) -> None:
        self._asked = False
        if isinstance(answer, replies.Started):
            self._number = answer.number
            self.waiting = [each for each in self.waiting if each is not first]
        elif isinstance(answer, StereotomeError):
            self.hold(answer.what)
