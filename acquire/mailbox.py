"""A queue that a loop waiting for sockets can wait for as well."""

from __future__ import annotations

import contextlib
import queue
import socket
from typing import Generic, TypeVar

T = TypeVar("T")
ROOM = 4096


class Mailbox(Generic[T]):
    """Many threads put, one takes; its file number is readable while something is in it."""

    def __init__(self) -> None:
        self._letters: queue.SimpleQueue[T] = queue.SimpleQueue()
        self._bell, self._ear = socket.socketpair()
        self._bell.settimeout(0)
        self._ear.settimeout(0)

    def fileno(self) -> int:
        """Return what to wait for."""
        return self._ear.fileno()

    def put(self, letter: T) -> None:
        """Leave something; never waits, from any thread."""
        self._letters.put(letter)
        with contextlib.suppress(BlockingIOError):  # then it rings already
            self._bell.send(b"!")

    def take_all(self) -> list[T]:
        """Return what was left, in order."""
        with contextlib.suppress(BlockingIOError):
            self._ear.recv(ROOM)
        letters = []
        with contextlib.suppress(queue.Empty):
            while True:
                letters.append(self._letters.get_nowait())
        return letters

    def close(self) -> None:
        """Let go of the sockets."""
        self._bell.close()
        self._ear.close()
