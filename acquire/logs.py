"""The log files of consoles and instrument processes, and the command ``stereotome logs`` that shows them."""

from __future__ import annotations

import heapq
import logging
import os
import re
import sys
from collections import deque
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from acquire.watch import RUN_LOG, QuietFile
from devices.clock import SystemClock
from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

LARGEST_BYTES, OLDER = 5_000_000, 4
LOOK_S = 0.5
BEGINS = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+ (?P<level>[A-Z]+) ")
CLOCK = SystemClock()
Level = Literal["info", "warning", "error"]


def logs_folder() -> Path:
    """Return the folder of this user's logs."""
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "stereotome"


@contextmanager
def logged(program: str) -> Iterator[None]:
    """Have what the program tells, from INFO on, written to its log file, the oldest of it thrown away.

    Where no file can be written, one line says so and the program goes on: its work does not depend on it.

    Parameters
    ----------
    program : str
        Which log: ``console``, or ``serve-`` and the name of the instrument.
    """
    root = logging.getLogger()
    file = logs_folder() / f"{re.sub(r'[^A-Za-z0-9._-]', '_', program)[:80]}.log"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.open("a").close()
    except OSError as cause:
        sys.stderr.write(f"no log is kept: {cause}\n")
        yield
        return
    handler = QuietFile(file, LARGEST_BYTES, OLDER)
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()


def logs(
    *,
    run: Path | None = None,
    last: Annotated[int, Parameter(name=["--last", "-n"])] = 50,
    level: Level = "info",
    follow: Annotated[bool, Parameter(name=["--follow", "-f"], negative="")] = False,
) -> None:
    """Show what consoles and instrument processes wrote down, or what happened in a run.

    Parameters
    ----------
    run
        A run's folder: its own log instead.
    last
        How many of the newest entries.
    level
        Only what is at least so bad.
    follow
        Go on with what comes, until Ctrl-C.
    """
    files = _files(run)
    if not files or not all(file.exists() for file in files):
        raise InputError(
            f"there is no log in {logs_folder() if run is None else run}.",
            why="nothing was served or shown yet." if run is None else "it is no run's folder, or has not begun.",
            fix="name a run: stereotome logs --run FOLDER",
            code="no-log",
        )
    tails = {file: Tail(file, level) for file in files}
    kept = (chain(_before(tail), tail.entries()) for tail in tails.values())
    _show(deque(heapq.merge(*kept), maxlen=max(last, 0)))
    with suppress(KeyboardInterrupt):
        while follow:
            CLOCK.sleep(LOOK_S)
            tails |= {file: Tail(file, level) for file in _files(run) if file not in tails}
            _show(heapq.merge(*(tail.entries() for tail in tails.values())))


class Tail:
    """What is added to a log file; one that was begun anew is read from its start.

    An entry is a line with its time, and those after it that have none, such as a traceback.
    """

    def __init__(self, file: Path, level: Level) -> None:
        self.file = file
        self.level = level
        self._read = 0

    def entries(self) -> list[str]:
        """Return the entries added since the last call."""
        if not self.file.exists():  # it makes room for another one just now
            return []
        with self.file.open("rb") as file:
            if os.fstat(file.fileno()).st_size < self._read:
                self._read = 0
            file.seek(self._read)
            whole = file.read().rpartition(b"\n")
        self._read += len(whole[0]) + len(whole[1])
        return list(entries(whole[0].decode(errors="replace").split("\n"), self.level))


def _files(run: Path | None) -> list[Path]:
    """Return the log of a run, or those of all consoles and instrument processes so far."""
    return [run / RUN_LOG] if run is not None else sorted(logs_folder().glob("*.log"))


def entries(lines: Iterable[str], level: Level) -> Iterator[str]:
    """Put lines together to entries, and leave out those that are less bad."""
    least, entry, counts = logging.getLevelName(level.upper()), "", False
    for line in lines:
        if begins := BEGINS.match(line):
            if counts:
                yield entry
            number = logging.getLevelName(begins["level"])
            entry, counts = "", isinstance(number, int) and number >= least
        entry += f"{line}\n"
    if counts:
        yield entry


def _before(tail: Tail) -> Iterator[str]:
    """Yield what is left of the files before this one, oldest first."""
    for number in range(OLDER, 0, -1):
        older = tail.file.with_name(f"{tail.file.name}.{number}")
        if older.exists():
            yield from Tail(older, tail.level).entries()


def _show(found: Iterable[str]) -> None:
    sys.stdout.writelines(found)
    sys.stdout.flush()
