"""What happened, for the log panel: lines with a level, newest last; kept in memory and given to the program's log."""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.errors import StereotomeError

Level = Literal["info", "warning", "error"]
LEVELS: tuple[Level, ...] = ("info", "warning", "error")
KEPT = 2000
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """One line: when, how bad, in which part of the console, and the words."""

    at: datetime
    level: Level
    place: str
    words: str

    def __str__(self) -> str:
        return f"{self.at.astimezone():%H:%M:%S} {self.level:7} {self.place}: {self.words}"


class Journal:
    """Lines any thread may add.

    Attributes
    ----------
    version : int
        Counts the lines ever added.
    """

    def __init__(self, now: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self._now = now
        self._lines: deque[Line] = deque(maxlen=KEPT)
        self._lock = threading.Lock()
        self.version = 0

    def add(self, level: Level, place: str, words: str) -> None:
        """Add a line."""
        line = Line(self._now(), level, place, words)
        with self._lock:
            self._lines.append(line)
            self.version += 1
        log.log(getattr(logging, level.upper()), "%s: %s", place, words)

    def error(self, place: str, error: StereotomeError) -> None:
        """Add an error as people read it."""
        self.add("error", place, words_of(error))

    def since(self, version: int) -> tuple[int, list[Line]]:
        """Return the version now, and the lines added since another, as far as they are kept."""
        with self._lock:
            new = min(self.version - version, len(self._lines))
            return self.version, [self._lines[k] for k in range(-new, 0)]

    def lines(self, least: Level = "info") -> list[Line]:
        """Return the lines that are at least so bad."""
        with self._lock:
            return [line for line in self._lines if LEVELS.index(line.level) >= LEVELS.index(least)]


def words_of(error: StereotomeError) -> str:
    """Return an error in a line: what, why and the first fix."""
    parts = [error.what, error.why, f"Fix: {error.fix[0]}" if error.fix else ""]
    return f"[{error.code}] " + " ".join(part for part in parts if part)


def event_words(event: dict[str, Any]) -> tuple[Level, str] | None:
    """Return what to tell of an event of a run; None for what happens all the time."""
    match event["event"]:
        case "start":
            return "info", f"started: {event['planned']} planes to {event['folder']}"
        case "done":
            state = event["state"]
            return ("info" if state == "COMPLETED" else "warning"), f"{state}: {event['folder']}"
        case "error" | "warn" as kind:
            return ("error" if kind == "error" else "warning"), f"[{event['code']}] {event['message']}"
        case "hold":
            return "warning", f"HOLD: {event['question']}"
        case "verdict" if event.get("finding") not in {"good", None}:
            return "warning", f"section {event['section'] + 1}: {event['finding']}: {event['words']}"
        case "pause":
            return "info", f"pause asked for, at the next {event['scope']}"
        case _:
            return None
