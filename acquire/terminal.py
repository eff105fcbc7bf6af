"""Questions of a run put to the person at the terminal, while the run itself goes on being watched."""

from __future__ import annotations

import os
import queue
import sys
import threading
from typing import TYPE_CHECKING, Any

from acquire.standing import END
from acquire.state import Question, RunState
from devices.errors import StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable

LINE_BYTES = 4096


class Terminal:
    """Puts the questions of a run to the terminal, and takes the answers to the run.

    A line that was typed before a question was seen does not answer it; one that comes when the run no longer asks,
    because the cause went away or the run was ended, answers nothing.

    Parameters
    ----------
    answer : callable
        Takes an answer; raises `StereotomeError` when it is none.
    """

    def __init__(self, answer: Callable[[str], None]) -> None:
        self._answer = answer
        self._asked: Question | None = None
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._over = threading.Event()
        # Not by sys.stdin: a thread that waits in it cannot be left behind when the program ends.
        threading.Thread(target=self._read, args=(sys.stdin.fileno(),), name="terminal", daemon=True).start()

    def heard(self, event: dict[str, Any]) -> None:
        """Take notice of an event of the run: a question, or that it is over."""
        if event["event"] == "hold" and event["asks"]:
            self._forget_lines()
            self._asked = Question(event["code"], event["question"], event["answers"])
            _put(self._asked)
        elif event["event"] == "state" and event["state"] != RunState.HOLD:
            self._asked = None

    def take_answers(self) -> None:
        """Give the run what was typed."""
        while self._asked is not None and (typed := self._typed()) is not None:
            try:
                self._answer(typed)
            except StereotomeError as error:
                sys.stderr.write(error.message() + "\n")
                _put(self._asked)
            else:
                self._asked = None

    def _typed(self) -> str | None:
        """Return the next line, the word that ends the run when none can come any more, None when none came yet."""
        if not self._lines.empty():
            return self._lines.get()
        return END if self._over.is_set() else None

    def _forget_lines(self) -> None:
        while not self._lines.empty():
            self._lines.get()

    def _read(self, source: int) -> None:
        begun = b""
        while typed := os.read(source, LINE_BYTES):
            *lines, begun = (begun + typed).split(b"\n")
            for line in lines:
                self._lines.put(line.decode(errors="replace").strip())
        self._over.set()


def _put(question: Question) -> None:
    choices = "".join(f"  {choice:<10} {meaning}\n" for choice, meaning in question.answers.items())
    sys.stderr.write(f"\nHOLD [{question.code}]: {question.words}\n{choices}? ")
    sys.stderr.flush()
