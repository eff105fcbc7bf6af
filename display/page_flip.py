"""Pairs of views to shutter glasses: starts the process that flips, sends it pairs, asks how it goes."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, NamedTuple

from devices.errors import DisplayError
from devices.glasses_timing import PhaseReport
from display.flip_process import READY, FlipOptions
from display.mailbox import Mailbox
from display.pacing import PaceReport
from display.shown_report import ShownReport

if TYPE_CHECKING:
    from types import TracebackType
    from typing import IO, Self

    from display.mailbox import Picture

START_S, END_S = 30.0, 10.0


class Going(NamedTuple):
    """How it goes so far; see `display.pacing.PaceReport`."""

    refreshes: int
    flips: int
    late: int
    wrong_eye: int
    longest_wrong: int
    period_ns: int


class PageFlip:
    """A show through shutter glasses, in a process of its own; use it as a context manager, or `close` it.

    Parameters
    ----------
    size : (int, int)
        Width and height of a view in pixels.
    options : FlipOptions
        How; its mailbox is made here.

    Raises
    ------
    DisplayError
        What kept the process from showing anything: ``no-display``, ``refresh-too-slow``, ``no-vsync``, or the glasses.
    """

    def __init__(self, size: tuple[int, int], options: FlipOptions) -> None:
        self._mailbox = Mailbox.create(size)
        self._said: list[str] = []
        try:
            self._process = self._started(replace(options, mailbox=str(self._mailbox.path)))
        except BaseException:
            self._mailbox.remove()
            raise

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a view in pixels."""
        return self._mailbox.size

    def show(self, left: Picture, right: Picture) -> None:
        """Make a pair the one that is seen from the next turns on; (height, width, 3) uint8. Never waits."""
        self._mailbox.publish(left, right)

    @property
    def swap(self) -> bool:
        """Whether the eyes are exchanged."""
        return self._mailbox.swap

    @swap.setter
    def swap(self, swap: bool) -> None:
        self._mailbox.swap = swap

    @property
    def pid(self) -> int:
        """Number of the process that flips."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether pictures are being flipped; False once the window was closed."""
        return self._process.poll() is None

    @property
    def going(self) -> Going:
        """How it goes."""
        return Going(*self._mailbox.told(len(Going._fields)))

    def wait(self, timeout_s: float) -> bool:
        """Wait for the show to end by itself; return whether it did."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> ShownReport | None:
        """End the show and return how it went; None if the process ended without a word. What it said is in `said`."""
        self._mailbox.stop()
        try:
            out, err = self._process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            out, err = self._process.communicate()
        self._mailbox.remove()
        self._said += err.splitlines()
        if self._process.returncode != 0 or not out.strip():
            return None
        return _report(out)

    @property
    def said(self) -> tuple[str, ...]:
        """What the process said about glasses and keys; complete after `close`."""
        return tuple(self._said)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._process.returncode is None:
            self.close()

    def _started(self, options: FlipOptions) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "display.flip_process", json.dumps(asdict(options))],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        if _first_line(process.stdout) == READY:
            return process
        process.kill()
        _, err = process.communicate()
        raise _failed(err)


def _first_line(stream: IO[str]) -> str:
    readable, _, _ = select.select([stream], [], [], START_S)
    return stream.readline().strip() if readable else ""


def _report(out: str) -> ShownReport:
    found = json.loads(out.splitlines()[-1])
    phase = None if found["phase"] is None else PhaseReport(**found["phase"])
    return ShownReport(found["refresh_hz"], PaceReport(**found["pace"]), phase)


def _failed(said: str) -> DisplayError:
    """Return the process's own error as one of this process."""
    lines = said.strip().splitlines()
    head = next((line for line in lines if line.startswith("error[")), "")
    if not head:
        return DisplayError("the pictures could not be flipped.", why=lines[-1] if lines else "Nothing came back.")
    code, what = head.removeprefix("error[").split("]: ", 1)
    parts = [line.strip().split(": ", 1) for line in lines[lines.index(head) + 1 :] if ": " in line]
    why = " ".join(words for label, words in parts if label == "why")
    return DisplayError(what, why=why, fix=tuple(words for label, words in parts if label in {"fix", "or"}), code=code)
