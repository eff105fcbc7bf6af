"""A command and the meaning of its reply, as one value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


@dataclass(frozen=True)
class Request(Generic[T]):
    """What to send, what its reply means, and whether it may be sent again when the reply is lost.

    Attributes
    ----------
    payload : bytes
        The whole command with its terminator.
    decode : callable
        From the reply without its terminator to its meaning; raises `MalformedReply` for noise, `Refused` for a no.
    repeatable : bool
        Doing it twice is the same as doing it once. False for relative moves and everything like them.
    moves : bool
        It sets something in motion: not sent while the position is unknown, and never after a halt that came later
        than the wish.
    framing : callable or None
        From all bytes received so far to the whole reply, None while it is incomplete; None stands for up to the
        link's terminator. A command without a reply has `no_reply`.
    timeout_s : float or None
        For the whole reply; None is as the link has it.
    """

    payload: bytes
    decode: Callable[[bytes], T]
    repeatable: bool = True
    moves: bool = False
    framing: Callable[[bytes], bytes | None] | None = None
    timeout_s: float | None = None


def until(terminator: bytes) -> Callable[[bytes], bytes | None]:
    """Return the framing of replies that end with a terminator."""

    def framing(received: bytes) -> bytes | None:
        reply, found, _ = received.partition(terminator)
        return reply if found else None

    return framing


def no_reply(_received: bytes) -> bytes | None:
    """Frame the reply of a command that has none: it is complete before it begins."""
    return b""
