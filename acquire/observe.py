"""Observers: programs of their own that watch a run through the ring and cannot hold it up.

An observer is a function named in the entry-point group ``stereotome.observers``. Each runs in its own process, at
lower priority, as a reader that claims nothing; when it dies the run is told and goes on.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from devices.errors import PlanError, StereotomeError
from devices.installed import installed

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.metadata import EntryPoint

    Observe = Callable[[Path, Path, Path, dict[str, Any], Callable[[], None]], None]

GROUP = "stereotome.observers"
READY = b"ready\n"
NICENESS = 5


class Observer:
    """One observer's process, as the run sees it."""

    def __init__(self, name: str, ring: Path, run: Path, out: Path, options: dict[str, Any]) -> None:
        self.name = name
        self._log = run / f"observer-{name}.log"
        arguments = [name, str(ring), str(run), str(out), json.dumps(options)]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "acquire.observe", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,  # Ctrl-C is for the run; an observer ends when the run does
            )

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Wait until the observer watches; False if it does not within ``timeout_s``. The run starts either way."""
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], timeout_s)
        return bool(readable) and self._process.stdout.readline() == READY

    def finish(self, timeout_s: float) -> str:
        """Wait for the observer to end; return what went wrong in words, empty if nothing did."""
        if self._stands_still():
            return f"{self.name} stood still and was ended."
        try:
            self._process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self._end()
            return f"{self.name} was not done after {timeout_s:.0f} s and was ended."
        if self._process.returncode == 0:
            return ""
        return self._last_words()

    def _stands_still(self) -> bool:
        """End a process that somebody stopped: it would never be done."""
        status = Path(f"/proc/{self._process.pid}/stat")
        try:
            stopped = status.read_text(encoding="utf-8").rpartition(")")[2].split()[0] in {"T", "t"}
        except OSError:
            return False
        if stopped:
            self._end()
        return stopped

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _last_words(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines() or ["it said nothing"]
        return f"{self.name} failed: {lines[-1].strip()} (all of it: {self._log})"


def known_observer(name: str) -> EntryPoint:
    """Return where the observer of that name is; raises `PlanError` when none is installed."""
    found = installed(GROUP).select(name=name)
    if not found:
        known = ", ".join(sorted(installed(GROUP).names))
        raise PlanError(f"no observer is called {name!r}.", fix=f"installed are: {known}")
    return next(iter(found))


def load(name: str) -> Observe:
    """Return the observer of that name; raises as `known_observer`."""
    observe: Observe = known_observer(name).load()
    return observe


def main(arguments: list[str]) -> int:
    """Run one observer: NAME RING RUN OUT OPTIONS."""
    name, ring, run, out, options = arguments
    os.nice(NICENESS)
    try:
        load(name)(Path(ring), Path(run), Path(out), json.loads(options), _say_ready)
    except StereotomeError as error:
        sys.stderr.write(error.message() + "\n")
        return error.exit_code
    return 0


def _say_ready() -> None:
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
