"""A USB serial link on simulated time: each way takes about as long as the bus needs, and varies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from devices.protocols import Clock


class UsbWire:
    """A `devices.protocols.Transport` whose far end is a function.

    Parameters
    ----------
    feed : callable
        Takes the bytes sent, returns the replies.
    clock : Clock
        Simulated; a write moves it on to the moment at which the bytes are there.
    delay_s, jitter_s : float
        Each way takes ``delay_s`` and up to ``jitter_s`` more, evenly spread: a full-speed bus has a frame of 1 ms.
    seed : int
        Of the jitter.
    """

    name = "usb"

    def __init__(
        self,
        feed: Callable[[bytes], Iterable[bytes]],
        clock: Clock,
        *,
        delay_s: float = 0.2e-3,
        jitter_s: float = 1e-3,
        seed: int = 0,
    ) -> None:
        self._feed = feed
        self._clock = clock
        self._delay_s = delay_s
        self._jitter_s = jitter_s
        self._chance = np.random.default_rng(seed).random
        self._pending = b""
        self._there_s = 0.0

    def write(self, data: bytes) -> None:
        """Send all of ``data``; returns when it has arrived."""
        self._clock.sleep(self._way_s())
        replies = b"".join(self._feed(data))
        if replies:
            self._pending += replies
            self._there_s = self._clock.now() + self._way_s()

    def read(self, wait_s: float) -> bytes:
        """Return what has arrived within ``wait_s``."""
        left_s = self._there_s - self._clock.now()
        if not self._pending or left_s > wait_s:
            self._clock.sleep(wait_s)
            return b""
        self._clock.sleep(left_s)
        data, self._pending = self._pending, b""
        return data

    def close(self) -> None:
        """Nothing to release."""

    def _way_s(self) -> float:
        return self._delay_s + self._jitter_s * float(self._chance())
