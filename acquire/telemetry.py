"""What the instrument process tells everybody who listens: values that may be lost, each numbered on its topic.

A listener that comes late gets the last value of each topic at once. One that cannot keep up loses values and can see
it from the numbers; it never holds up anybody. What must not be lost is in the journal.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import zmq

from acquire.mailbox import Mailbox
from acquire.messages import pack_telling
from acquire.replies import Telling

if TYPE_CHECKING:
    from acquire.replies import Event, State

HELD_BACK = 100  # values a slow listener may lag behind before it loses some
SUBSCRIBED = 1
POLL_MS = 500


class Telemetry:
    """Publishes from any thread; one thread of its own owns the socket, bound already, until `close`."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket
        self._lock = threading.Lock()
        self._last: dict[str, Telling] = {}
        self._out: Mailbox[tuple[str, Telling] | None] = Mailbox()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def tell(self, topic: str, told: State | Event) -> None:
        """Send a value; returns at once."""
        with self._lock:
            before = self._last.get(topic)
            telling = self._last[topic] = Telling(1 if before is None else before.number + 1, told)
            self._out.put((topic, telling))

    def values(self) -> dict[str, tuple[int, State | Event]]:
        """Return number and value last sent on each topic."""
        with self._lock:
            last = dict(self._last)
        return {topic: (telling.number, telling.told) for topic, telling in last.items()}  # type: ignore[misc]

    def close(self) -> None:
        """Send what is left and end."""
        self._out.put(None)
        self._thread.join()
        self._out.close()

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._out.fileno(), zmq.POLLIN)
        while self._send(self._out.take_all()):
            poller.poll(POLL_MS)
            self._greet()

    def _send(self, letters: list[tuple[str, Telling] | None]) -> bool:
        for letter in letters:
            if letter is None:
                return False
            self._socket.send(pack_telling(*letter), zmq.NOBLOCK)
        return True

    def _greet(self) -> None:
        """Send the last values again when somebody comes; who had them knows by their numbers."""
        while self._socket.poll(0):
            said = self._socket.recv()
            if said[:1] != bytes([SUBSCRIBED]):
                continue
            with self._lock:
                last = list(self._last.items())
            for topic, telling in last:
                if f"{topic}\0".encode().startswith(said[1:]):
                    self._socket.send(pack_telling(topic, telling), zmq.NOBLOCK)
