"""Who hears of a run beside the one who started it: the run's own log file, and a command of the user's."""

from __future__ import annotations

import json
import logging
import subprocess
from logging.handlers import RotatingFileHandler
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.recipe import NotifySpec

log = logging.getLogger("acquire.run")
RUN_LOG = "run.log"
FORMAT = "%(asctime)s.%(msecs)03d %(levelname)s %(name)s: %(message)s"


class QuietFile(RotatingFileHandler):
    """A log file with times, that a full disk does not make a nuisance; ``limit`` in bytes, 0 for none, begins another.

    Parameters
    ----------
    older : int
        How many files before it are kept.
    """

    def __init__(self, file: Path, limit: int = 0, older: int = 0) -> None:
        super().__init__(file, maxBytes=limit, backupCount=older, encoding="utf-8", delay=True)
        self.setFormatter(logging.Formatter(FORMAT, "%Y-%m-%dT%H:%M:%S"))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  the library's name
        """Let it go: the run itself meets the disk and says so."""


class RunLog:
    """``run.log`` in the run's folder: every event, and every warning of the program while the run lasts."""

    def __init__(self, folder: Path) -> None:
        self._handler = QuietFile(folder / RUN_LOG)
        logging.getLogger().addHandler(self._handler)
        log.setLevel(logging.INFO)

    def hear(self, event: dict[str, Any]) -> None:
        """Write an event down."""
        level = logging.WARNING if event["event"] in {"warn", "error", "hold"} else logging.INFO
        log.log(level, "%s", json.dumps(event, ensure_ascii=False))

    def close(self) -> None:
        """End the file."""
        logging.getLogger().removeHandler(self._handler)
        self._handler.close()


class Notifier:
    """Runs the user's command when something happens; the run never waits for it."""

    def __init__(self, spec: NotifySpec | None, name: str) -> None:
        self._spec = spec
        self._name = name

    def hear(self, event: dict[str, Any]) -> None:
        """Run the command if the recipe asks for it."""
        text = self._text(event)
        if self._spec is None or not text:
            return
        command = [word.replace("{text}", text) for word in self._spec.command]
        try:
            subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        except OSError as error:
            log.warning("notify: %s: %s", command[0], error)

    def _text(self, event: dict[str, Any]) -> str:
        spec, kind = self._spec, event["event"]
        if spec is None:
            return ""
        if kind == "error" and "error" in spec.on:
            return f"{self._name}: {event['message']}"
        if kind == "hold" and "hold" in spec.on:
            return f"{self._name} is on HOLD: {event['question']}"
        if kind == "ended" and "done" in spec.on:
            return f"{self._name}: {event['state']}, {event['durable']} of {event['planned']} planes"
        every = spec.every_sections
        if kind == "section" and every and (event["section"] + 1) % every == 0:
            return f"{self._name}: {event['section'] + 1} sections done"
        return ""


def all_of(*hear: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
    """Return one listener that passes everything on to all."""

    def everyone(event: dict[str, Any]) -> None:
        for one in hear:
            one(event)

    return everyone
