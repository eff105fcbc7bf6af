"""What was answered to whom: a request that comes again gets the same answer and is not carried out again."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING

from acquire.replies import Failed, Picture, Working
from devices.errors import StereotomeError

if TYPE_CHECKING:
    from acquire.replies import AnyReply

KEPT = 16
PICTURES = 4
CLIENTS = 256
WORKING = Working()
FORGOTTEN = Failed(code="serve-request", what="the picture is forgotten by now: take another.", exit_code=2)


class RequestRefused(StereotomeError):
    """A request that cannot be carried out as it came; nothing was done."""

    code = "serve-request"
    exit_code = 2


@dataclass
class _Client:
    answers: OrderedDict[int, tuple[bytes, AnyReply]] = field(default_factory=OrderedDict)
    forgotten: int = 0


class Answers:
    """The last answers to each client, and of pictures the last few to anybody: they are large.

    A number older than those kept is refused: it may have been carried out. Clients not heard of for longest are
    forgotten with all their numbers.
    """

    def __init__(self, *, kept: int = KEPT, clients: int = CLIENTS) -> None:
        self._kept = kept
        self._most = clients
        self._clients: OrderedDict[str, _Client] = OrderedDict()
        self._pictures: deque[tuple[str, int]] = deque()

    def begin(self, client: str, number: int, body: bytes) -> AnyReply | None:
        """Return what was answered before, `Working` while it is under way, or None when it is new.

        Raises
        ------
        RequestRefused
            Its number is too old, or was another request's.
        """
        known = self._client(client)
        digest = blake2b(body, digest_size=16).digest()
        if number in known.answers:
            before, reply = known.answers[number]
            if before != digest:
                raise RequestRefused(f"number {number} was another request. Nothing was done.", code="serve-request")
            return reply
        if number <= known.forgotten:
            raise RequestRefused(f"number {number} is too old: its answer is forgotten. Nothing was done.")
        known.answers[number] = digest, WORKING
        self._forget_old(known)
        return None

    def finish(self, client: str, number: int, reply: AnyReply) -> None:
        """Keep an answer."""
        known = self._clients.get(client)
        if known is None or number not in known.answers:
            return
        known.answers[number] = known.answers[number][0], reply
        if isinstance(reply, Picture):
            self._pictures.append((client, number))
            if len(self._pictures) > PICTURES:
                self.finish(*self._pictures.popleft(), FORGOTTEN)

    def _client(self, name: str) -> _Client:
        if name not in self._clients:
            self._clients[name] = _Client()
            if len(self._clients) > self._most:
                self._clients.popitem(last=False)
        self._clients.move_to_end(name)
        return self._clients[name]

    def _forget_old(self, known: _Client) -> None:
        done = [number for number, (_, reply) in known.answers.items() if reply is not WORKING]
        for number in done[: max(0, len(known.answers) - self._kept)]:
            del known.answers[number]
            known.forgotten = max(known.forgotten, number)
