"""What the instrument process and its clients say to each other: msgspec structs in MessagePack, one tag per message.

A message is three frames: ``b"ST1"``, a `Header` and a body. The digit is the major version: peers of another one are
told so and nothing of theirs is read further. Within a major version fields are only ever added, each with a default,
and a reader passes over what it does not know. ``tests/golden/messages-1.json`` holds the bytes of every message.
"""

from __future__ import annotations

from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta, Struct

from acquire.replies import AnyReply, Telling
from acquire.requests import AnyRequest, Name

MAJOR = b"ST1"
MINOR = 0
FRAMES = 3
MAX_REQUEST_BYTES = 1 << 20


class Header(Struct, frozen=True, kw_only=True):
    """Who asks what, for how long, and by which right.

    Attributes
    ----------
    client : str
        Random name of the asking end, made anew each time it connects.
    number : int
        Counts its requests from 1. A repeated number gets the same answer again and is not carried out twice.
    minor : int
        Minor version of the sender.
    epoch : str
        Life of the instrument process the sender means; empty in a `Hello`. Another one is refused.
    key : str
        The word from the connection file that lets in its owner's programs only.
    lease : str
        Token of the one who commands; empty for others.
    wait_ms : int
        How long the request may wait for its turn, from its arrival; then it is refused and not carried out.
    """

    client: Name
    number: Annotated[int, Meta(ge=1)]
    minor: int = MINOR
    epoch: Name = ""
    key: Name = ""
    lease: Name = ""
    wait_ms: Annotated[int, Meta(ge=0, le=600_000)] = 10_000


_encoder = msgspec.msgpack.Encoder()
_headers = msgspec.msgpack.Decoder(Header)
_requests: msgspec.msgpack.Decoder[AnyRequest] = msgspec.msgpack.Decoder(AnyRequest)
_replies: msgspec.msgpack.Decoder[AnyReply] = msgspec.msgpack.Decoder(AnyReply)
_tellings = msgspec.msgpack.Decoder(Telling)

T = TypeVar("T")


def encode(message: Struct) -> bytes:
    """Return a message as bytes."""
    return _encoder.encode(message)


def decode_header(data: bytes) -> Header:
    """Return a header; raises `msgspec.DecodeError` with the place of what is wrong for anything else."""
    return _decoded(_headers, data)


def decode_request(data: bytes) -> AnyRequest:
    """Return a request; raises as `decode_header` does."""
    return _decoded(_requests, data)


def decode_reply(data: bytes) -> AnyReply:
    """Return a reply; raises as `decode_header` does."""
    return _decoded(_replies, data)


def pack_telling(topic: str, telling: Telling) -> bytes:
    """Return the one frame that goes out on a topic: its name, a zero byte, the value."""
    return topic.encode() + b"\0" + _encoder.encode(telling)


def unpack_telling(frame: bytes) -> tuple[str, Telling]:
    """Return topic and value of a frame; raises as `decode_header` does."""
    topic, _, value = frame.partition(b"\0")
    return topic.decode(errors="replace"), _decoded(_tellings, value)


def _decoded(decoder: msgspec.msgpack.Decoder[T], data: bytes) -> T:
    """Decode; msgspec lets two errors of the bytes through as what they are: text that is none, and too deep a nest."""
    try:
        return decoder.decode(data)
    except (UnicodeDecodeError, RecursionError) as cause:
        raise msgspec.DecodeError(str(cause)) from None
