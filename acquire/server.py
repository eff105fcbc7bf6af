"""The sockets of the instrument process and the threads that own them."""

from __future__ import annotations

import logging
import os
import secrets
import threading
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import zmq

from acquire import messages, replies, requests
from acquire.host import Host
from acquire.lease import LeaseBook
from acquire.mailbox import Mailbox
from acquire.meeting import Meeting, claimed, write_meeting
from acquire.preview import Previews
from acquire.reception import Door, Reception, reply_frames
from acquire.telemetry import HELD_BACK, Telemetry
from devices.errors import DeviceBusy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from acquire.keys import ServerKeys
    from acquire.meeting import Channel
    from devices.protocols import Clock
    from devices.rig import Rig

log = logging.getLogger(__name__)
POLL_MS = 200
KINDS: dict[Channel, int] = {"control": zmq.ROUTER, "stop": zmq.ROUTER, "telemetry": zmq.XPUB, "preview": zmq.XPUB}
HELD: dict[Channel, int] = {"control": 1000, "stop": 1000, "telemetry": HELD_BACK, "preview": 2}
OUT_BYTES = 1 << 18  # a picture that waits in the system's buffer for a slow listener is old when it arrives

Socket = zmq.Socket[bytes]


class Loop(threading.Thread):
    """Receives on a ROUTER, in one thread that owns it, and beats while it does.

    Parameters
    ----------
    receive : callable
        From sender and frames to the frames of an answer, or None for none now.
    later : Mailbox
        Answers that come later: sender and frames.
    beat : callable
        Called at least every 0.2 s as long as the loop turns.
    """

    def __init__(
        self,
        name: str,
        socket: Socket,
        receive: Callable[[bytes, list[bytes]], list[bytes] | None],
        later: Mailbox[Callable[[], tuple[bytes, list[bytes]]]],
        beat: Callable[[], None],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._socket = socket
        self._receive = receive
        self._later = later
        self._beat = beat
        self._over = threading.Event()

    def run(self) -> None:
        """Turn until closed."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._later.fileno(), zmq.POLLIN)
        while not self._over.is_set():
            poller.poll(POLL_MS)
            self._beat()
            for make in self._later.take_all():
                self._send(*make())
            while self._socket.poll(0):
                self._take()

    def close(self) -> None:
        """End the loop."""
        self._over.set()
        self.join()

    def _take(self) -> None:
        sender, *frames = self._socket.recv_multipart()
        try:
            answer = self._receive(sender, frames)
        except Exception:  # the next message must be served whatever this one did
            log.exception("a message failed by a bug")
            answer = reply_frames(
                None, replies.Failed(code="bug", what="a bug; the traceback is in the instrument's log")
            )
        if answer is not None:
            self._send(sender, answer)

    def _send(self, sender: bytes, frames: list[bytes]) -> None:
        try:
            self._socket.send_multipart([sender, *frames], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # it left before its answer came, or does not take it
            log.info("an answer found nobody: %s", error)


@contextmanager
def serving(
    rig: Rig,
    clock: Clock,
    wanted: dict[Channel, str],
    *,
    keys: ServerKeys | None = None,
    beat: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Path, Host]]:
    """Serve an instrument as long as the context lasts; gives the connection file.

    Parameters
    ----------
    wanted : dict
        Addresses to serve at, from `acquire.meeting.addresses`.
    keys : ServerKeys, optional
        Admit those on its list only.
    beat : callable
        Called at least every 0.2 s while the process is able to serve.

    Raises
    ------
    DeviceBusy
        Another process serves this instrument, or the ports are taken.
    """
    with ExitStack() as stack:
        file = stack.enter_context(claimed(rig.spec.name))
        context = zmq.Context()
        stack.callback(context.term)
        if keys is not None:
            stack.enter_context(keys.gatekeeper(context))
        sockets, endpoints = _bound(stack, context, wanted, keys)
        key = "" if keys is not None else secrets.token_hex(16)
        host = _start(stack, rig, clock, sockets, key, beat)
        write_meeting(file, Meeting(rig.spec.name, os.getpid(), endpoints, key))
        yield file, host


def _start(
    stack: ExitStack, rig: Rig, clock: Clock, sockets: dict[Channel, Socket], key: str, beat: Callable[[], None]
) -> Host:
    epoch = secrets.token_hex(8)
    telemetry = Telemetry(sockets["telemetry"])
    stack.callback(telemetry.close)
    host = Host(rig, telemetry, clock)
    previews = Previews(sockets["preview"], lambda: host.ring, clock)
    stack.callback(previews.close)
    stack.callback(_control(host, telemetry, rig, clock, sockets["control"], Door(key, epoch), epoch, beat).close)
    stack.callback(_stop(host, sockets["stop"], Door(key, epoch)).close)
    stack.callback(host.close)  # before the loops: a stop is heard as long as anything may move
    return host


def _control(
    host: Host,
    telemetry: Telemetry,
    rig: Rig,
    clock: Clock,
    socket: Socket,
    door: Door,
    epoch: str,
    beat: Callable[[], None],
) -> Loop:
    later: Mailbox[Callable[[], tuple[bytes, list[bytes]]]] = Mailbox()
    reception = Reception(
        host,
        telemetry,
        LeaseBook(clock),
        spec=rig.spec,
        door=door,
        epoch=epoch,
        deliver=lambda sender, header, reply: later.put(lambda: (sender, reception.finished(header, reply))),
    )

    def turn() -> None:
        reception.tick()
        beat()

    loop = Loop("control", socket, reception.receive, later, turn)
    loop.start()
    return loop


def _stop(host: Host, socket: Socket, door: Door) -> Loop:
    """Serve the socket for a stop: a thread that does nothing else and waits for nothing."""

    def receive(_: bytes, frames: list[bytes]) -> list[bytes] | None:
        header, request = door.read(frames)
        if isinstance(request, requests.Stop):
            return reply_frames(header, host.stop_all())
        if isinstance(request, replies.Failed):
            return reply_frames(header, request)
        return None

    loop = Loop("stop", socket, receive, Mailbox(), lambda: None)
    loop.start()
    return loop


def _bound(
    stack: ExitStack, context: zmq.Context[Socket], wanted: dict[Channel, str], keys: ServerKeys | None
) -> tuple[dict[Channel, Socket], dict[Channel, str]]:
    """Make and bind every socket; return them and the addresses they got."""
    sockets: dict[Channel, Socket] = {}
    for channel, address in wanted.items():
        socket = sockets[channel] = context.socket(KINDS[channel])
        stack.callback(socket.close, 0)
        _prepare(channel, socket)
        if keys is not None:
            keys.guard(socket)
        try:
            socket.bind(address)
        except zmq.ZMQError as cause:
            raise DeviceBusy(
                f"nothing can be served at {address}: {cause}.", fix="choose another port: --bind", code="serve-busy"
            ) from None
    return sockets, {channel: _address(socket) for channel, socket in sockets.items()}


def _address(socket: Socket) -> str:
    bound = socket.getsockopt(zmq.LAST_ENDPOINT)
    assert isinstance(bound, bytes)
    return bound.rstrip(b"\0").decode()


def _prepare(channel: Channel, socket: Socket) -> None:
    socket.linger = 0
    socket.maxmsgsize = messages.MAX_REQUEST_BYTES
    socket.sndhwm = HELD[channel]
    socket.ipv6 = True
    if channel == "telemetry":
        socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # who comes second is to be greeted as well
    elif channel == "preview":
        socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        socket.sndbuf = OUT_BYTES
    else:
        socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
