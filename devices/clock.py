"""The clock of the bench."""

from __future__ import annotations

import time


class SystemClock:
    """Real time, as `devices.protocols.Clock` wants it."""

    def now(self) -> float:
        """Return CLOCK_MONOTONIC in seconds: the same for every process of this machine."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for ``seconds``; returns at once for zero and less."""
        if seconds > 0:
            time.sleep(seconds)  # noqa: TID251  the one place where real time passes
