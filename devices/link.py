"""One conversation at a time over one transport: deadline, bounded repetition, no answer to an older question."""

from __future__ import annotations

import logging
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

from devices.errors import LinkError, LinkLost, NoReply

if TYPE_CHECKING:
    from devices.protocols import Clock, Transport
    from devices.wire.exchange import Request

T = TypeVar("T")
log = logging.getLogger(__name__)

SLICE_S = 0.02
QUIET_AFTER_INTERRUPTION_S = 0.02  # both replies are on their way; a cancelled run may not wait longer


class Link:
    """Asks requests of a controller that ends each reply with a terminator.

    A reply that comes too late looks like the answer to the next question. So nothing is asked after a silence or a
    garbled reply before the line has been quiet for one ``timeout_s`` (or noisy for two); after an interruption, before
    it has been quiet for a moment.

    Parameters
    ----------
    transport : Transport
        The bytes' way.
    clock : Clock
        Time.
    terminator : bytes
        Ends every reply.
    timeout_s : float
        For one reply, from the request's last byte to the terminator.
    attempts : int
        How often a repeatable request is sent at most.
    """

    def __init__(
        self, transport: Transport, clock: Clock, *, terminator: bytes, timeout_s: float = 0.5, attempts: int = 3
    ) -> None:
        self.name = transport.name
        self._transport = transport
        self._clock = clock
        self._terminator = terminator
        self._timeout_s = timeout_s
        self._attempts = attempts
        self._conversation = Lock()
        self._writing = Lock()
        self._quiet_s = 0.0
        self._interruptions = 0

    def ask(self, request: Request[T]) -> T:
        """Send a request and return the meaning of its reply; waits for its turn.

        Raises
        ------
        NoReply, MalformedReply
            After the last attempt; the first one, when the request is not repeatable.
        LinkLost
            The transport is gone.
        Refused
            The controller said no; never asked again.
        """
        for _ in range(self._attempts - 1 if request.repeatable else 0):
            try:
                return self._once(request)
            except LinkLost:
                raise
            except LinkError as error:
                log.warning("%s: %s asking again", self.name, error.what)
        return self._once(request)

    def interrupt(self, request: Request[T]) -> T:
        """Send a request without waiting for the conversation going on, then ask it in turn for its reply.

        The conversation it breaks into gets no answer, and asks again if it may.
        """
        if self._conversation.locked():
            with self._writing:
                self._interruptions += 1
                self._quiet_s = max(self._quiet_s, QUIET_AFTER_INTERRUPTION_S)
                self._transport.write(request.payload)
        return self.ask(request)

    def close(self) -> None:
        """Release the transport."""
        self._transport.close()

    def _once(self, request: Request[T]) -> T:
        with self._conversation:
            before = self._interruptions
            if self._quiet_s:
                self._drain()
            self._discard()
            try:
                return request.decode(self._exchange(request.payload, before))
            except LinkError:
                if self._interruptions == before:
                    self._quiet_s = self._timeout_s
                raise

    def _exchange(self, payload: bytes, before: int) -> bytes:
        """Send and receive; an interruption since ``before`` makes the next reply somebody else's."""
        with self._writing:
            if self._interruptions == before:
                self._transport.write(payload)
        deadline = self._clock.now() + self._timeout_s
        received = b""
        while self._terminator not in received:
            left_s = deadline - self._clock.now()
            received += self._transport.read(min(left_s, SLICE_S)) if left_s > 0 else b""
            if left_s <= 0 or self._interruptions != before:
                raise self._no_reply(payload, received)
        return received.partition(self._terminator)[0]

    def _no_reply(self, payload: bytes, received: bytes) -> NoReply:
        got = f"only {received[:40]!r}" if received else "no reply"
        return NoReply(f"{self.name}: {got} to {payload!r} within {self._timeout_s:g} s.", received=received)

    def _discard(self) -> None:
        """Drop what came unasked: it cannot be the answer to what is asked next."""
        stale = self._transport.read(0)
        if stale:
            log.warning("%s: unasked: %r", self.name, stale)

    def _drain(self) -> None:
        """Read until the line was quiet for as long as it has to be, at most for two timeouts."""
        quiet_s, self._quiet_s = self._quiet_s, 0.0
        now = self._clock.now()
        end, quiet_since = now + 2 * self._timeout_s, now
        while now < min(end, quiet_since + quiet_s):
            late = self._transport.read(SLICE_S)
            now = self._clock.now()
            if late:
                log.warning("%s: came late: %r", self.name, late)
                quiet_since = now
