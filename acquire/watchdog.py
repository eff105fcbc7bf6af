"""Stops all motion when the instrument process dies or hangs; a process of its own, so that neither takes it along.

The instrument process sends a beat through a pipe from the loop that serves it. The pipe's end is its death, at once;
no beat for five seconds is a hang. Then each device is halted by the halt that works past whoever holds its port.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import subprocess
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

from devices.clock import SystemClock
from devices.halt_rig import halt_rig
from devices.rig import RigSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType
    from typing import Self

    from devices.protocols import Clock

log = logging.getLogger(__name__)
DEAD_AFTER_S = 5.0
LOOK_EVERY_S = 0.25
BEAT_EVERY_S = 0.5
SECOND_HALT_S = 3.0
READY_S = 60.0
BEAT, BYE = b".", b"q"
READY, HALTED = b"r", b"h"


class Watch:
    """Knows from the beats whether it is time to halt: once for each silence, and again when a silent one wakes.

    One that wakes may go on with what it was about, without knowing that it was given up.
    """

    def __init__(self, clock: Clock, dead_after_s: float = DEAD_AFTER_S) -> None:
        self._clock = clock
        self._dead_after_s = dead_after_s
        self._heard_s = clock.now()
        self._given_up = False

    def heard(self) -> bool:
        """Note a beat; return whether to halt because it came from one given up."""
        woke, self._given_up = self._given_up, False
        self._heard_s = self._clock.now()
        return woke

    def silent(self) -> bool:
        """Return whether to halt because it has been silent for too long; once."""
        if self._given_up or self._clock.now() - self._heard_s < self._dead_after_s:
            return False
        self._given_up = True
        return True


class Watchdog:
    """The watching process as the watched one sees it.

    Parameters
    ----------
    spec : RigSpec
        What to halt.

    Attributes
    ----------
    halted : callable
        Called, in a thread of its own, after the watchdog had to halt the devices.
    """

    def __init__(self, spec: RigSpec, clock: Clock) -> None:
        self.halted: Callable[[], object] = lambda: None
        self._clock = clock
        self._beaten_s = float("-inf")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "acquire.watchdog", spec.model_dump_json(by_alias=True)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the watched one
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._to, False)

    @property
    def pid(self) -> int:
        """Of the watching process."""
        return self._process.pid

    def wait_until_ready(self) -> None:
        """Wait until it watches; says so in the log if it does not."""
        if not select.select([self._from], [], [], READY_S)[0] or os.read(self._from, 1) != READY:
            log.error("the watchdog did not start: nothing stops the devices if this process dies")

    def beat(self) -> None:
        """Say that the process is alive, and hear whether it was given up meanwhile; to be called often, cheap."""
        now = self._clock.now()
        if now - self._beaten_s < BEAT_EVERY_S:
            return
        self._beaten_s = now
        with contextlib.suppress(OSError):  # it has died, or has not read for long: nobody can be told
            os.write(self._to, BEAT)
        if halts := self._halts(0.0):
            log.error("the watchdog halted the devices: this process was silent for %g s", DEAD_AFTER_S)
            threading.Thread(target=self.halted, name="given up", daemon=True).start()
            if halts % 2:  # one more comes now that this process woke: what is commanded before would be halted by it
                self._halts(SECOND_HALT_S)

    def _halts(self, wait_s: float) -> int:
        """Return how often it said that it has halted the devices, waiting for the first word."""
        return len(os.read(self._from, 64)) if select.select([self._from], [], [], wait_s)[0] else 0

    def close(self) -> None:
        """Send it away, and wait until it has gone."""
        with contextlib.suppress(OSError):
            os.write(self._to, BYE)
        with contextlib.suppress(OSError):
            self._process.communicate()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


@contextmanager
def watched(spec: RigSpec, clock: Clock, halted: Callable[[], object]) -> Iterator[None]:
    """Have a process of its own halt the devices should this one die, or stand still as a whole, meanwhile.

    Parameters
    ----------
    halted : callable
        As of `Watchdog`.
    """
    over = threading.Event()
    with Watchdog(spec, clock) as watchdog:
        watchdog.halted = halted
        watchdog.wait_until_ready()
        beating = threading.Thread(target=_beat, args=[watchdog, over], name="beat", daemon=True)
        beating.start()
        try:
            yield
        finally:
            over.set()
            beating.join()


def _beat(watchdog: Watchdog, over: threading.Event) -> None:
    watchdog.beat()
    while not over.wait(BEAT_EVERY_S):
        watchdog.beat()


def watch(beats: int, say: int, watch: Watch, halt: Callable[[], None]) -> None:
    """Read beats from a file until its end or a good-bye, and halt whenever it is time.

    Parameters
    ----------
    beats, say : int
        Open files: from the watched process, and back to it.
    """
    os.write(say, READY)
    while True:
        readable, _, _ = select.select([beats], [], [], LOOK_EVERY_S)
        said = os.read(beats, 4096) if readable else None
        if said is not None and BYE in said:
            return
        if said == b"":
            log.error("the instrument process died; halting the devices")
            halt()
            return
        if (watch.heard() if said else False) or watch.silent():
            log.error("the instrument process is or was silent for %g s; halting the devices", DEAD_AFTER_S)
            halt()
            with contextlib.suppress(OSError):
                os.write(say, HALTED)


def main(arguments: list[str]) -> None:
    """Watch over standard input: SPEC."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s watchdog: %(message)s")
    spec = RigSpec.model_validate_json(arguments[0])

    def halt() -> None:
        told, failed = halt_rig(spec)
        for words in (*told, *failed):
            log.error("%s", words)

    watch(sys.stdin.fileno(), sys.stdout.fileno(), Watch(SystemClock()), halt)


if __name__ == "__main__":
    main(sys.argv[1:])
