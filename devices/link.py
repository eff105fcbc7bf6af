"""One conversation at a time over one transport: deadline, bounded repetition, no answer to an older question."""

from __future__ import annotations

import logging
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

from devices.errors import DeviceError, Halted, LinkError, LinkLost, NoReply
from devices.wire.exchange import until

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock, Transport
    from devices.wire.exchange import Request

T = TypeVar("T")
log = logging.getLogger(__name__)

SLICE_S = 0.02
QUIET_AFTER_INTERRUPTION_S = 0.02  # both replies are on their way; a cancelled run may not wait longer
REOPEN_EVERY_S = 0.25
RECONNECT_S = 10.0


class Link:
    """Asks requests of a controller, and reads each reply to its end.

    A reply that comes too late looks like the answer to the next question. So nothing is asked after a silence or a
    garbled reply before the line has been quiet for one ``timeout_s`` (or noisy for two); after an interruption, before
    it has been quiet for a moment.

    A request that moves something is never sent after a halt that came later than the wish to move.

    Who gives ``reopen`` has a link that knows what it does not know: once the transport was lost, or nothing answered
    to the last attempt, the device may have been switched off, and its position is unknown. From then on requests that
    move are refused with the code position-unknown, until `reconnect` has opened the transport anew, identified the
    device and read its position.

    Parameters
    ----------
    transport : Transport
        The bytes' way.
    clock : Clock
        Time.
    terminator : bytes
        Ends every reply whose request says nothing else.
    timeout_s : float
        For one reply, from the request's last byte to its own, unless the request says something else.
    attempts : int
        How often a repeatable request is sent at most; those that a halt broke into are not counted.
    reopen : callable, optional
        Opens the transport anew.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        *,
        terminator: bytes,
        timeout_s: float = 0.5,
        attempts: int = 3,
        reopen: Callable[[], Transport] | None = None,
    ) -> None:
        self.name = transport.name
        self._transport = transport
        self._clock = clock
        self._framing = until(terminator)
        self._timeout_s = timeout_s
        self._attempts = attempts
        self._conversation = Lock()
        self._writing = Lock()
        self._quiet_s = 0.0
        self._interruptions = 0
        self._reopen = reopen
        self._lost: LinkLost | None = None
        self._unknown = False

    @property
    def position_known(self) -> bool:
        """Tell whether the device has been in touch without a break since it was identified."""
        return not self._unknown

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
        DeviceError
            It would move, but the position is unknown (position-unknown), or a halt came before (device-halted).
        """
        wished = self._interruptions
        left = self._attempts if request.repeatable else 1
        while True:
            before = self._interruptions
            try:
                return self._once(request, wished)
            except LinkLost:
                raise
            except LinkError as error:
                interrupted = self._interruptions != before
                left -= not (interrupted and request.repeatable)
                if not left:
                    self._unknown |= self._reopen is not None and isinstance(error, NoReply) and not interrupted
                    raise
                log.warning("%s: %s asking again", self.name, error.what)

    def interrupt(self, request: Request[T]) -> T:
        """Send a request without waiting for the conversation going on, then ask it in turn for its reply.

        The conversation it breaks into gets no answer, and asks again if it may.
        """
        if self._conversation.locked() and self._lost is None:
            with self._writing:
                self._interruptions += 1
                self._quiet_s = max(self._quiet_s, QUIET_AFTER_INTERRUPTION_S)
                self._transport.write(request.payload)
        return self.ask(request)

    def reconnect(self, greet: Callable[[], T], timeout_s: float = RECONNECT_S) -> T:
        """Open the transport anew, as often as it takes, and return what ``greet`` returns.

        Parameters
        ----------
        greet : callable
            Identifies the device and reads its position by asking this link; raises when it is another one.
        timeout_s : float
            After which no further attempt is begun.

        Raises
        ------
        DeviceError
            That of the last attempt. The position stays unknown.
        """
        self._unknown = True
        deadline = self._clock.now() + timeout_s
        while True:
            try:
                self._open_anew()
                met = greet()
            except DeviceError:
                if self._clock.now() >= deadline:
                    raise
                self._clock.sleep(REOPEN_EVERY_S)
            else:
                self._unknown = False
                return met

    def close(self) -> None:
        """Release the transport."""
        self._transport.close()

    def _open_anew(self) -> None:
        with self._conversation, self._writing:
            self._transport.close()
            if self._reopen is not None:
                self._transport = self._reopen()
            self._lost, self._quiet_s = None, self._timeout_s  # one that wakes up answers all it was asked before

    def _once(self, request: Request[T], wished: int) -> T:
        with self._conversation:
            self._check_allowed(request, wished)
            before = self._interruptions
            try:
                if self._quiet_s:
                    self._drain()
                self._discard()
                return request.decode(self._exchange(request, before))
            except LinkLost as lost:
                self._lost, self._unknown = lost, True
                raise
            except LinkError:
                if self._interruptions == before:
                    self._quiet_s = self._timeout_of(request)
                raise

    def _check_allowed(self, request: Request[T], wished: int) -> None:
        if request.moves and self._unknown:
            raise DeviceError(
                f"{self.name}: position unknown since the connection was lost. Nothing moved.",
                why="The device may have been switched off or moved meanwhile.",
                fix="reconnect, and look at the position it tells, before it moves again.",
                code="position-unknown",
            )
        if request.moves and self._interruptions != wished:
            raise Halted(f"{self.name}: a halt came before the move. Nothing was sent.")
        if self._lost is not None:
            raise LinkLost(self._lost.what, why=self._lost.why, fix=self._lost.fix)

    def _timeout_of(self, request: Request[T]) -> float:
        return self._timeout_s if request.timeout_s is None else request.timeout_s

    def _exchange(self, request: Request[T], before: int) -> bytes:
        """Send and receive; an interruption since ``before`` makes the next reply somebody else's."""
        framing, timeout_s = request.framing or self._framing, self._timeout_of(request)
        with self._writing:
            if self._interruptions == before:
                self._transport.write(request.payload)
        deadline = self._clock.now() + timeout_s
        received = b""
        while (reply := framing(received)) is None:
            left_s = deadline - self._clock.now()
            received += self._transport.read(min(left_s, SLICE_S)) if left_s > 0 else b""
            if left_s <= 0 or self._interruptions != before:
                raise self._no_reply(request, received)
        return reply

    def _no_reply(self, request: Request[T], received: bytes) -> NoReply:
        got = f"only {received[:40]!r}" if received else "no reply"
        timeout_s = self._timeout_of(request)
        return NoReply(f"{self.name}: {got} to {request.payload!r} within {timeout_s:g} s.", received=received)

    def _discard(self) -> None:
        """Drop what came unasked: it cannot be the answer to what is asked next."""
        stale = self._transport.read(0)
        if stale:
            log.info("%s: unasked: %r", self.name, stale)

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
