"""The front of the instrument process: reads what comes in, turns away what may not, and passes the rest on."""

from __future__ import annotations

import logging
import os
import secrets
from importlib.metadata import version
from typing import TYPE_CHECKING

import msgspec

from acquire import messages, replies, requests
from acquire.answers import Answers, RequestRefused
from acquire.lanes import failed
from devices.errors import StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.host import Host
    from acquire.lease import LeaseBook
    from acquire.telemetry import Telemetry
    from devices.rig import RigSpec

log = logging.getLogger(__name__)
LOGGED_BYTES = 32


class Door:
    """Lets in messages of this program and version that know the word; used by one thread.

    Parameters
    ----------
    key : str
        The word of the connection file; empty where keys guard the sockets.
    epoch : str
        Life of this process.
    """

    def __init__(self, key: str, epoch: str) -> None:
        self._key = key
        self._epoch = epoch

    def read(self, frames: list[bytes]) -> tuple[messages.Header | None, requests.AnyRequest | replies.Failed | None]:
        """Return header and request; a refusal in place of the request; nothing at all for what is not ours."""
        if len(frames) != messages.FRAMES or not frames[0].startswith(b"ST"):
            log.warning("dropped: %d frames that are not ours: %r", len(frames), b"".join(frames[:1])[:LOGGED_BYTES])
            return None, None
        if frames[0] != messages.MAJOR:
            return None, _refused(
                f"this instrument speaks {messages.MAJOR.decode()}, not {frames[0][:8].decode(errors='replace')}."
            )
        try:
            header = messages.decode_header(frames[1])
        except msgspec.DecodeError as cause:
            return None, _refused(f"the header cannot be read: {cause}.")
        return header, self._admitted(header, frames[2])

    def _admitted(self, header: messages.Header, body: bytes) -> requests.AnyRequest | replies.Failed:
        if not secrets.compare_digest(header.key.encode(), self._key.encode()):
            return replies.Failed(
                code="serve-keys", what="the word of the connection file is not the right one.", exit_code=5
            )
        try:
            request = messages.decode_request(body)
        except msgspec.DecodeError as cause:
            return _refused(f"the request cannot be read: {cause}.")
        if header.epoch != self._epoch and not isinstance(request, requests.Hello):
            return replies.Failed(
                code="serve-epoch",
                what="this is another instrument process than the one that was meant. Nothing was done.",
                why="It was started anew in between.",
                fix=("connect again, and look how things stand",),
                exit_code=8,
            )
        return request


def _refused(what: str) -> replies.Failed:
    return failed(RequestRefused(what + " Nothing was done.", fix="use the same version of the program on both sides"))


def reply_frames(header: messages.Header | None, reply: replies.AnyReply) -> list[bytes]:
    """Return a reply as frames; its header names the request it answers."""
    client, number = ("", 1) if header is None else (header.client, header.number)
    return [messages.MAJOR, messages.encode(messages.Header(client=client, number=number)), messages.encode(reply)]


class Reception:
    """Answers at once what it can, has the rest carried out, and gives each request one answer, however often it comes.

    Used by one thread; ``deliver`` is called by others, with client, header and answer.
    """

    def __init__(
        self,
        host: Host,
        telemetry: Telemetry,
        book: LeaseBook,
        *,
        spec: RigSpec,
        door: Door,
        epoch: str,
        deliver: Callable[[bytes, messages.Header, replies.AnyReply], None],
    ) -> None:
        self._host = host
        self._telemetry = telemetry
        self._book = book
        self._spec = spec
        self._door = door
        self._epoch = epoch
        self._deliver = deliver
        self._answers = Answers()

    def receive(self, sender: bytes, frames: list[bytes]) -> list[bytes] | None:
        """Take in a message and return what to answer now, if anything."""
        header, request = self._door.read(frames)
        if header is None or request is None or isinstance(request, replies.Failed):
            return None if request is None else reply_frames(header, request)  # type: ignore[arg-type]
        try:
            reply = self._answers.begin(header.client, header.number, frames[2])
        except StereotomeError as error:
            return reply_frames(header, failed(error))
        if reply is None:
            reply = self._new(sender, header, request)
        return None if reply is None else reply_frames(header, reply)

    def finished(self, header: messages.Header, reply: replies.AnyReply) -> list[bytes]:
        """Keep an answer that came later, and return it as frames."""
        self._answers.finish(header.client, header.number, reply)
        return reply_frames(header, reply)

    def tick(self) -> None:
        """Look whether the one who commands is still there."""
        self._host.held_by(self._book.holder)

    def _new(self, sender: bytes, header: messages.Header, request: requests.AnyRequest) -> replies.AnyReply | None:
        """Carry out a request now, or have it done; then the answer comes later."""
        try:
            if request.needs_lease:
                self._book.keep(header.lease)
            if request.lane != "at once":
                self._host.put(request, header.wait_ms, lambda reply: self._deliver(sender, header, reply))
                return None
            reply = self._at_once(header, request)
        except StereotomeError as error:
            reply = failed(error)
        self._answers.finish(header.client, header.number, reply)
        self.tick()
        return reply

    def _at_once(self, header: messages.Header, request: requests.AnyRequest) -> replies.AnyReply:
        match request:
            case requests.Hello() | requests.GetInstrument():
                return self._about_us(request)
            case requests.GetState():
                return self._host.now()
            case requests.GetValues():
                return replies.Values(values=self._telemetry.values())
            case requests.TakeLease():
                return replies.Lease(token=self._book.take(request.actor), lasts_s=self._book.lasts_s)
            case requests.ReleaseLease():
                self._book.release(header.lease)
            case requests.KeepLease():
                pass
            case _:
                raise RequestRefused("this goes to the other socket. Nothing was done.")
        return replies.Done()

    def _about_us(self, request: requests.Hello | requests.GetInstrument) -> replies.AnyReply:
        if isinstance(request, requests.GetInstrument):
            return replies.InstrumentView(tables=self._spec.model_dump(mode="json", by_alias=True))
        limits = self._spec.stage.z.soft_limits
        return replies.Welcome(
            instrument=self._spec.name,
            epoch=self._epoch,
            program=version("stereotome"),
            pid=os.getpid(),
            stage_limits_um=(limits.min_um, limits.max_um),
        )
