"""Halts that no command given at the same moment outlives, and that never stop the way back."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from devices.errors import StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Feed, Stage

REPEAT_S, SELDOM_S = 0.05, 0.8


class Halting:
    """Halts what a run moves, from any thread, until the run has left its steps.

    Two races are closed here. A halt that reaches a driver just before the run's own command to move stops nothing: so
    a stop is repeated until the run has left. And a halt meant for a move of the stack, sent a moment late, would stop
    the stage on its way back: so none is sent any more once the run has left.

    Parameters
    ----------
    stage : Stage
        Halted in any case.
    feed : Feed or None
        Halted by `stop` alone.
    """

    def __init__(self, stage: Stage, feed: Feed | None) -> None:
        self._stage = stage
        self._feed = feed
        self._lock = threading.RLock()  # a signal may come in the thread that holds it
        self._left = threading.Event()
        self._repeating = False

    def stage_if(self, moving: Callable[[], bool]) -> None:
        """Halt the stage if the run is ``moving`` it and has not left."""
        with self._lock:
            if moving() and not self._left.is_set():
                self._stage.halt()

    def stop(self) -> None:
        """Halt everything now, and again until the run has left; returns after the first time."""
        try:
            self.everything()
        finally:
            self._keep_halting()

    def everything(self) -> None:
        """Halt stage and feed at the same time: neither waits for the other's answer, which may never come."""
        if self._feed is None:
            self._stage.halt()
            return
        failures: list[StereotomeError] = []
        beside = threading.Thread(target=_noting, args=(self._feed.halt, failures), name="halting feed", daemon=True)
        beside.start()
        try:
            self._stage.halt()
        finally:
            beside.join()
        if failures:
            raise failures[0]

    def leave(self) -> None:
        """Note that the run gives no further command but the way back."""
        with self._lock:
            self._left.set()

    def _keep_halting(self) -> None:
        """Start to repeat, once: many at a time break into each other's conversations, and nothing is ever answered."""
        with self._lock:
            starts, self._repeating = not self._repeating, True
        if starts:
            threading.Thread(target=self._repeat, name="halting", daemon=True).start()

    def _repeat(self) -> None:
        """Halt again, each time after twice as long: what the run asks meanwhile is answered in between."""
        wait_s = REPEAT_S
        while not self._left.wait(wait_s):
            with suppress(StereotomeError):  # the run's own thread meets the same fault, and tells it
                self.everything()
            wait_s = min(2 * wait_s, SELDOM_S)


def _noting(halt: Callable[[], None], failures: list[StereotomeError]) -> None:
    try:
        halt()
    except StereotomeError as error:
        failures.append(error)
