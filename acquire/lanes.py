"""Work done one piece after another, each lane in a thread of its own, so that whoever accepts it never waits."""

from __future__ import annotations

import logging
import queue
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.replies import Failed
from devices.errors import DeviceBusy, StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.replies import AnyReply
    from devices.protocols import Clock

log = logging.getLogger(__name__)
WAITING = 16


@dataclass(frozen=True)
class Job:
    """A piece of work, until when it may begin, whether it still may, and whom to give the answer."""

    work: Callable[[], AnyReply]
    begin_by_s: float
    wanted: Callable[[], bool]
    answer: Callable[[AnyReply], None]


def failed(error: StereotomeError) -> Failed:
    """Return an error as a message."""
    return Failed(code=error.code, what=error.what, why=error.why, fix=error.fix, exit_code=error.exit_code)


class Lane:
    """A queue of work and the thread that does it."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._jobs: queue.Queue[Job | None] = queue.Queue()
        self._busy = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a piece of work is under way."""
        return self._busy.is_set()

    def put(self, job: Job) -> None:
        """Take on a piece of work; raises `DeviceBusy` when too much waits already."""
        if self._jobs.qsize() >= WAITING:
            raise DeviceBusy(f"{WAITING} requests wait for {self.name} already. Nothing was done.", code="serve-full")
        self._jobs.put(job)

    def close(self) -> None:
        """End after the piece under way."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._busy.set()
            try:
                answer = self._do(job)
            finally:
                self._busy.clear()
            job.answer(answer)

    def _do(self, job: Job) -> AnyReply:
        if not job.wanted():
            return Failed(code="serve-stopped", what="a stop came before it. Nothing was done.", exit_code=5)
        if self._clock.now() > job.begin_by_s:
            return Failed(code="serve-late", what="its turn came too late. Nothing was done.", exit_code=8)
        try:
            return job.work()
        except StereotomeError as error:
            return failed(error)
        except Exception as bug:  # the last stop of this thread: whoever asked hears of it, the next request is served
            log.exception("a request failed by a bug")
            return Failed(code="bug", what=f"{type(bug).__name__}: {bug}; traceback in the instrument's log")
