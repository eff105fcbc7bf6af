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
    """

    payload: bytes
    decode: Callable[[bytes], T]
    repeatable: bool = True
