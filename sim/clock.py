"""A clock without waiting: a simulated hour takes no time."""

from __future__ import annotations


class SimClock:
    """Time that moves on only when somebody sleeps; a `devices.protocols.Clock`."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now(self) -> float:
        """Return the simulated time in seconds."""
        return self._now_s

    def sleep(self, seconds: float) -> None:
        """Move on by ``seconds``; by nothing for zero and less."""
        self._now_s += max(seconds, 0.0)
