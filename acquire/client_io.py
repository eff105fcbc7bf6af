"""The client's end of the wires: one thread owns the sockets, asks until it is answered, and keeps the lease alive."""

from __future__ import annotations

import logging
import secrets
import threading
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec
import zmq
from zmq.utils.monitor import recv_monitor_message

from acquire import messages, replies, requests
from acquire.keys import KeysError
from acquire.lease import BEAT_S
from acquire.mailbox import Mailbox
from acquire.meeting import ServerGone
from devices.errors import DeviceBusy, DeviceError, InputError, PlanError, StereotomeError, StoreError, Unsafe

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.keys import ClientKeys
    from acquire.meeting import Channel, Meeting
    from devices.protocols import Clock

log = logging.getLogger(__name__)
POLL_MS = 100
ASK_AGAIN_S = 1.0
SILENT_S = 10.0
CLOSED = ServerGone("the connection was closed.")
KINDS: dict[Channel, int] = {"control": zmq.DEALER, "stop": zmq.DEALER, "telemetry": zmq.SUB, "preview": zmq.SUB}
BY_EXIT: dict[int, type[StereotomeError]] = {
    2: InputError,
    3: PlanError,
    4: DeviceError,
    5: Unsafe,
    6: StoreError,
    8: DeviceBusy,  # lease-held and lease-lost among them
}
TURNED_AWAY = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)

Socket = zmq.Socket[bytes]


def error_of(failed: replies.Failed) -> StereotomeError:
    """Return the error that a message tells, of the class that says what to do next."""
    kind = BY_EXIT.get(failed.exit_code, StereotomeError)
    return kind(failed.what, why=failed.why, fix=failed.fix, code=failed.code)


@dataclass
class _Asked:
    channel: Channel
    frames: list[bytes]
    answer: Future[replies.AnyReply] = field(default_factory=Future)
    sent_s: float = float("-inf")
    heard_s: float = 0.0


class Wires(threading.Thread):
    """Asks and listens, for any thread.

    Parameters
    ----------
    meeting : Meeting
        Where the instrument is.
    keys : ClientKeys, optional
        Of a client on another computer.
    told : callable
        Called in this thread with each value of the telemetry.
    """

    def __init__(
        self, meeting: Meeting, clock: Clock, told: Callable[[replies.Told], None], *, keys: ClientKeys | None = None
    ) -> None:
        super().__init__(name="instrument client", daemon=True)
        self.epoch = ""
        self.lease = ""
        self._meeting = meeting
        self._clock = clock
        self._told = told
        self._keys = keys
        self._client = secrets.token_hex(12)
        self._numbers = iter(range(1, 1 << 62))
        self._number_lock = threading.Lock()
        self._out: Mailbox[tuple[int, _Asked] | None] = Mailbox()
        self._pending: dict[int, _Asked] = {}
        self._newest: dict[str, int] = {}
        self._beaten_s = float("-inf")
        self._turned_away = False
        self._context: zmq.Context[Socket] = zmq.Context()
        self._sockets = {channel: self._connected(channel) for channel in ("control", "stop", "telemetry")}
        self._monitor = self._sockets["control"].get_monitor_socket(TURNED_AWAY)
        self._previews: Socket | None = None
        self.start()

    def ask(self, request: requests.AnyRequest, *, wait_s: float = 10.0) -> Future[replies.AnyReply]:
        """Send a request; the answer comes as the future's result, or its exception.

        Parameters
        ----------
        wait_s : float
            How long it may wait for its turn at the instrument.
        """
        with self._number_lock:
            number = next(self._numbers)
        header = messages.Header(
            client=self._client,
            number=number,
            epoch=self.epoch,
            key=self._meeting.key,
            lease=self.lease,
            wait_ms=round(wait_s * 1000),
        )
        channel: Channel = "stop" if isinstance(request, requests.Stop) else "control"
        asked = _Asked(
            channel, [messages.MAJOR, messages.encode(header), messages.encode(request)], heard_s=self._clock.now()
        )
        if self.is_alive():
            self._out.put((number, asked))
        else:
            asked.answer.set_exception(CLOSED)
        return asked.answer

    def close(self) -> None:
        """Ask nothing more; what was not answered never will be."""
        self._out.put(None)
        self.join()
        self._out.close()

    def run(self) -> None:
        """Turn until closed."""
        poller = zmq.Poller()
        for waited in (*self._sockets.values(), self._monitor, self._out.fileno()):
            poller.register(waited, zmq.POLLIN)
        while self._take_out():
            self._beat()
            self._send_due()
            poller.poll(POLL_MS)
            self._receive()
        self._fail_all(CLOSED)
        self._sockets["control"].disable_monitor()
        self._monitor.close(0)
        for socket in self._sockets.values():
            socket.close(0)
        self._context.term()

    def _connected(self, channel: Channel) -> Socket:
        socket = self._context.socket(KINDS[channel])
        socket.linger = 0
        socket.ipv6 = True
        socket.reconnect_ivl_max = 1000
        if KINDS[channel] == zmq.DEALER:
            socket.immediate = True  # nothing waits in a queue for a server that is not there
        else:
            socket.rcvhwm = 1000
            socket.subscribe(b"")
        if self._keys is not None:
            self._keys.use(socket)
        socket.connect(self._meeting.endpoints[channel])
        return socket

    def _take_out(self) -> bool:
        for letter in self._out.take_all():
            if letter is None:
                return False
            number, asked = letter
            self._pending[number] = asked
        return True

    def _beat(self) -> None:
        """Say that the one who commands is alive."""
        now = self._clock.now()
        if self.lease and now - self._beaten_s >= BEAT_S:
            self._beaten_s = now
            self.ask(requests.KeepLease()).add_done_callback(self._kept)

    def _kept(self, answer: Future[replies.AnyReply]) -> None:
        error = answer.exception()
        if isinstance(error, StereotomeError) and error.code == "lease-lost":
            log.warning("%s", error.what)
            self.lease = ""

    def _send_due(self) -> None:
        """Send what was not sent yet, and again what was not answered: the same number is carried out once."""
        now = self._clock.now()
        for number, asked in list(self._pending.items()):
            if now - asked.heard_s > SILENT_S:
                del self._pending[number]
                asked.answer.set_exception(self._silence())
            elif now - asked.sent_s >= ASK_AGAIN_S:
                try:
                    self._sockets[asked.channel].send_multipart(asked.frames, zmq.NOBLOCK)
                    asked.sent_s = now
                except zmq.Again:
                    continue  # nobody is there now

    def _receive(self) -> None:
        while self._monitor.poll(0):
            recv_monitor_message(self._monitor)
            self._turned_away = True
            self._fail_all(self._silence())
        for channel in ("control", "stop"):
            while self._sockets[channel].poll(0):
                self._answered(self._sockets[channel].recv_multipart())
        while self._sockets["telemetry"].poll(0):
            self._heard(self._sockets["telemetry"].recv())

    def _answered(self, frames: list[bytes]) -> None:
        try:
            _, head, body = frames
            header, reply = messages.decode_header(head), messages.decode_reply(body)
        except (msgspec.DecodeError, ValueError) as cause:
            log.warning("an answer that cannot be read: %s", cause)
            return
        if not header.client and isinstance(
            reply, replies.Failed
        ):  # what we sent was not understood: no number is known
            self._fail_all(error_of(reply))
        asked = self._pending.get(header.number)
        if asked is None or header.client != self._client:
            return
        if isinstance(reply, replies.Working):
            asked.heard_s = self._clock.now()
            return
        del self._pending[header.number]
        if isinstance(reply, replies.Failed):
            asked.answer.set_exception(error_of(reply))
        else:
            asked.answer.set_result(reply)

    def _heard(self, frame: bytes) -> None:
        try:
            topic, telling = messages.unpack_telling(frame)
        except msgspec.DecodeError as cause:
            log.warning("telemetry that cannot be read: %s", cause)
            return
        if telling.number > self._newest.get(topic, 0):
            self._newest[topic] = telling.number
            self._told(telling.told)

    def _fail_all(self, error: StereotomeError) -> None:
        for asked in self._pending.values():
            asked.answer.set_exception(error)
        self._pending.clear()

    def _silence(self) -> StereotomeError:
        if self._turned_away:
            return KeysError(
                "the instrument did not admit this client.",
                why="Its keys are missing, or not on the instrument's list, or it was met without keys.",
                fix="have it admitted: stereotome keys DIR --client NAME",
            )
        return ServerGone(
            f"the instrument process '{self._meeting.instrument}' does not answer.",
            fix="see whether it still runs; start it: stereotome serve",
        )
