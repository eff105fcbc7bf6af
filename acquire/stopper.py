"""Stop everything that moves, all at once, each device by its own halt; nothing here waits for a lock."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from acquire.replies import Stopped
from devices.errors import StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.rig import Rig

ANSWER_S = 2.0


class _Halt:
    """One halt in a thread of its own: a device that does not answer keeps no other waiting."""

    def __init__(self, name: str, halt: Callable[[], None]) -> None:
        self._name = name
        self._halt = halt
        self._said = f"{name}: told to stop, no answer within {ANSWER_S:g} s"
        self.done = False
        self._thread = threading.Thread(target=self._run, name=f"halt {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._halt()
        except StereotomeError as error:
            self._said = f"{self._name}: {error.what}"
        else:
            self.done, self._said = True, self._name

    def word(self) -> str:
        self._thread.join(ANSWER_S)
        return self._said


def stop_devices(rig: Rig, end_run: Callable[[], None] | None) -> Stopped:
    """Halt stage and feed, end the run that drives them, and return who was told; all of it is under way at once.

    Parameters
    ----------
    end_run : callable or None
        Lets the engine send no further move.
    """
    ways = {} if end_run is None else {"run": end_run}
    ways["z stage"] = rig.stage.halt
    if rig.feed is not None:
        ways["feed"] = rig.feed.halt
    halts = [_Halt(name, halt) for name, halt in ways.items()]
    words = [(halt.word(), halt.done) for halt in halts]
    return Stopped(
        told=tuple(word for word, done in words if done), failed=tuple(word for word, done in words if not done)
    )
