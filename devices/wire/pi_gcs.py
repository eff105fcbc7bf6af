"""Commands of PI controllers that speak GCS 2.0, for one axis.

Lengths are in the controller's own unit: µm for piezo drives, mm for motors. Source: PI, command documents of the E-709
and E-727; lists of errors there.

A set command has no reply. It is sent together with the question for the error it left, as one request, so that no
other question can come between. Errors 1 and 2 say that a line came damaged or unknown; they may be left over from an
earlier line, such as a question that was garbled on its way. They are taken for noise, and the request is sent again.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, TypeVar

from devices.errors import MalformedReply, Refused
from devices.wire.exchange import Request

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

TERMINATOR: Final = b"\n"
REFERENCE: Final = {"switch": "FRF", "negative-limit": "FNL", "positive-limit": "FPL"}
HALT_ALL: Final = b"\x18"
STOPPED: Final = 10
NOT_ALLOWED: Final = 5
SHORT_S: Final = 0.2
UNINTELLIGIBLE: Final = (1, 2)
ERRORS: Final = {
    1: "syntax error",
    2: "unknown command",
    5: "the servo is off, or the axis is not referenced",
    7: "the position is out of the travel",
    8: "the velocity is out of range",
    STOPPED: "stopped by command",
    15: "no such axis",
    17: "a parameter is out of range",
    23: "no such axis",
    51: "the joystick is active",
    84: "the motor is off",
    216: "a limit switch was hit",
    1024: "the axis did not follow its path and was switched off",
}
_IDENTITY = re.compile(r"[^,]+(,[^,]*){3,}")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def identity() -> Request[str]:
    """Ask for maker, model, serial number and firmware."""
    return Request(b"*IDN?\n", _identity)


def axes() -> Request[tuple[str, ...]]:
    """Ask for the names of the axes, one a line."""
    return Request(b"SAI?\n", _names, framing=lines)


def move(axis: str, target: float) -> Request[None]:
    """Start an absolute move."""
    return _set(f"MOV {axis} {target:.6f}", moves=True)


def position(axis: str) -> Request[float]:
    """Ask for the position."""
    return _query("POS?", axis, _number)


def on_target(axis: str) -> Request[bool]:
    """Ask whether the axis has settled at its target."""
    return _query("ONT?", axis, _flag)


def halt() -> Request[None]:
    """Stop all axes at once; error 10, stopped by command, is the success."""
    return Request(HALT_ALL + b"ERR?\n", lambda reply: _no_error(reply, allowed=(0, STOPPED)))


def servo(axis: str) -> Request[bool]:
    """Ask whether the servo is on."""
    return _query("SVO?", axis, _flag)


def referenced(axis: str) -> Request[bool]:
    """Ask whether the axis knows its zero; drives with an absolute sensor may leave it unanswered."""
    return Request(*_asked("FRF?", axis, _flag), repeatable=False, timeout_s=SHORT_S)


def reference(axis: str, by: str) -> Request[None]:
    """Search the reference, ``by`` a key of `REFERENCE`; the axis may go anywhere within its travel meanwhile."""
    return _set(f"{REFERENCE[by]} {axis}", moves=True)


def set_servo(axis: str, *, on: bool) -> Request[None]:
    """Switch the servo; without it nothing moves."""
    return _set(f"SVO {axis} {on:d}")


def set_speed(axis: str, units_s: float) -> Request[None]:
    """Set the speed of later moves; out of range is refused."""
    return _set(f"VEL {axis} {units_s:.6f}")


def speed(axis: str) -> Request[float]:
    """Ask for the speed."""
    return _query("VEL?", axis, _number)


def travel(axis: str) -> tuple[Request[float], Request[float]]:
    """Ask for the ends of the travel, lower and upper."""
    return _query("TMN?", axis, _number), _query("TMX?", axis, _number)


def error() -> Request[int]:
    """Ask which error is waiting, 0 for none; asking clears it."""
    return Request(b"ERR?\n", _code)


def lines(received: bytes) -> bytes | None:
    """Frame a reply of several lines: each ends with space and LF but the last, which ends with LF alone."""
    end = 0
    while (end := received.find(b"\n", end)) >= 0:
        if not received[:end].endswith(b" "):
            return received[:end]
        end += 1
    return None


def _second_word(reply: bytes, axis: str) -> str:
    """Return what is told about the axis in ``axis=value``."""
    name, found, value = _text(reply).partition("=")
    if not found or name != axis:
        raise _malformed(reply)
    return value


def _query(name: str, axis: str, meaning: Callable[[bytes, str], T]) -> Request[T]:
    return Request(*_asked(name, axis, meaning))


def _asked(name: str, axis: str, meaning: Callable[[bytes, str], T]) -> tuple[bytes, Callable[[bytes], T]]:
    return f"{name} {axis}\n".encode("ascii"), lambda reply: meaning(reply, _second_word(reply, axis))


def _set(words: str, *, moves: bool = False) -> Request[None]:
    return Request(f"{words}\nERR?\n".encode("ascii"), _no_error, moves=moves)


def _text(reply: bytes) -> str:
    try:
        return reply.decode("ascii").strip()
    except UnicodeDecodeError:
        raise _malformed(reply) from None


def _malformed(reply: bytes) -> MalformedReply:
    return MalformedReply(f"no valid reply: {reply[:40]!r}.", reply=reply)


def _identity(reply: bytes) -> str:
    text = reply.decode("latin-1").strip()
    if not text.isprintable() or _IDENTITY.fullmatch(text) is None:
        raise _malformed(reply)
    return text


def _names(reply: bytes) -> tuple[str, ...]:
    names = tuple(line.strip() for line in _text(reply).split("\n"))
    if not all(name.isalnum() for name in names):
        raise _malformed(reply)
    return names


def _number(reply: bytes, word: str) -> float:
    if _NUMBER.fullmatch(word) is None:
        raise _malformed(reply)
    return float(word)


def _flag(reply: bytes, word: str) -> bool:
    if word not in ("0", "1"):
        raise _malformed(reply)
    return word == "1"


def _code(reply: bytes) -> int:
    text = _text(reply)
    if re.fullmatch(r"-?\d{1,6}", text, re.ASCII) is None:
        raise _malformed(reply)
    return int(text)


def _no_error(reply: bytes, allowed: tuple[int, ...] = (0,)) -> None:
    code = _code(reply)
    if code in UNINTELLIGIBLE:
        raise _malformed(reply)
    if code not in allowed:
        fix = "switch the servo on, and reference the axis with its way clear." if code == NOT_ALLOWED else ()
        raise Refused(f"the controller refused: {ERRORS.get(code, 'error')} ({code}).", reason=str(code), fix=fix)
