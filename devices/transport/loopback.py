"""A twin in this process, bytes in and bytes out, as a transport: no port, no thread, any clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from devices.protocols import Clock


class Loopback:
    """A transport whose far end is a function.

    Parameters
    ----------
    feed : callable
        Takes the bytes sent, returns the replies.
    clock : Clock
        Waits when there is nothing to read.
    """

    name = "loopback"

    def __init__(self, feed: Callable[[bytes], Iterable[bytes]], clock: Clock) -> None:
        self._feed = feed
        self._clock = clock
        self._pending = b""

    def write(self, data: bytes) -> None:
        """Send all of ``data`` to the twin."""
        self._pending += b"".join(self._feed(data))

    def read(self, wait_s: float) -> bytes:
        """Return the twin's replies; nothing, after ``wait_s``, when there are none."""
        if not self._pending:
            self._clock.sleep(wait_s)
        data, self._pending = self._pending, b""
        return data

    def close(self) -> None:
        """Nothing to release."""
