"""The bench's trigger cables: camera exposure-out to stage TTL in, stage TTL out to camera trigger-in."""

from __future__ import annotations

from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from sim.faults import pulses_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock
    from sim.faults import Faults

POLL_S = 0.001


@runtime_checkable
class TriggerLines(Protocol):
    """The two lines at a stage's controller."""

    def ttl_in(self) -> None:
        """Take a pulse: the end of an exposure."""
        ...

    def ttl_out_s(self) -> float | None:
        """Return when the output rose last or, while a move is under way, will rise; None if never."""
        ...


class FaultyLines:
    """The cables to and from a stage's controller, which may lose a pulse on the way, or bring it twice."""

    def __init__(self, lines: TriggerLines, faults: Faults) -> None:
        self._lines = lines
        self._faults = faults

    def ttl_in(self) -> None:
        """Bring a pulse to the stage, if it arrives."""
        kinds = self._faults.strike(pulses_of("z"))
        for _ in range(0 if "z.pulse-lost" in kinds else 2 if "z.pulse-doubled" in kinds else 1):
            self._lines.ttl_in()

    def ttl_out_s(self) -> float | None:
        """Return when the stage's output rose last or will rise."""
        return self._lines.ttl_out_s()


class Burst:
    """Exposes upon each rising edge of the stage's output, and pulses the stage's input at the end of each exposure.

    Edges that come during an exposure are missed, as real cameras miss them.

    Parameters
    ----------
    lines : TriggerLines
        The stage's end of the cables.
    clock : Clock
        Time.
    expose : callable
        Exposes one frame; what it returns is handed to ``deliver`` after the pulse.
    deliver : callable
        Takes the frame away.
    faults : Faults
        Edges that do not arrive.
    """

    def __init__(
        self,
        lines: TriggerLines,
        clock: Clock,
        expose: Callable[[], dict[str, Any] | None],
        deliver: Callable[[dict[str, Any] | None], None],
        faults: Faults,
    ) -> None:
        self._faults = faults
        self._lines = lines
        self._clock = clock
        self._expose = expose
        self._deliver = deliver
        self._ended = Event()
        self._seen_s = clock.now()
        self._thread: Thread | None = None

    def start(self, frames: int) -> None:
        """Wait for edges in a thread of its own."""
        self._thread = Thread(target=self.run, args=[frames], daemon=True)
        self._thread.start()

    def run(self, frames: int) -> None:
        """Take ``frames`` frames, or fewer if ended before."""
        for _ in range(frames):
            if not self._wait_for_edge():
                return
            frame = self._expose()
            self._seen_s = self._clock.now()
            self._lines.ttl_in()
            self._deliver(frame)

    def end(self) -> None:
        """Wait for no more edges; returns when the exposure under way is over."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _wait_for_edge(self) -> bool:
        while not self._ended.is_set():
            edge_s = self._lines.ttl_out_s()
            left_s = POLL_S if edge_s is None or edge_s <= self._seen_s else edge_s - self._clock.now()
            if left_s <= 0:
                self._seen_s = edge_s or 0.0
                if "camera.pulse-lost" not in self._faults.strike(pulses_of("camera")):
                    return True
            self._clock.sleep(max(left_s, 0.0))
        return False
