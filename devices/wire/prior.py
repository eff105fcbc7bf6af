"""Commands of Prior ProScan controllers for the focus drive.

Lengths are in steps; `resolution` tells how many µm one is. Source: Prior, manual of the ProScan III.

``R`` answers a move, in some firmware when it is accepted, in other when it is finished: then it comes at any time, in
front of the reply to whatever was asked meanwhile. So a move goes out together with the question for the status, which
is always answered at once, and an ``R`` in front of a reply means nothing.
"""

from __future__ import annotations

import re
from typing import Final

from devices.errors import MalformedReply, Refused
from devices.wire.exchange import Request

TERMINATOR: Final = b"\r"
Z_MOVING: Final = 4
UNKNOWN_COMMAND: Final = "5"
STANDARD_MODE: Final = 0
_DONE = b"R"
_STATUS = re.compile(rb"\d{1,3}")
_REFUSAL = re.compile(r"E,(\d{1,3})")
_STEPS = re.compile(r"[-+]?\d{1,12}")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_REFUSALS = {
    "1": "no stage",
    "2": "not idle",
    "3": "no drive",
    "4": "the command cannot be read",
    UNKNOWN_COMMAND: "unknown command",
    "7": "no focus drive",
    "8": "a value is out of range",
    **{str(10 + n): f"argument {n + 1} is out of range" for n in range(6)},
    "18": "too many moves are waiting",
    "20": "not fitted",
    "60": "encoder error",
    "61": "encoder error",
}


def identity() -> Request[str]:
    """Ask for the maker, the model and the date of the firmware: two lines."""
    return Request(b"DATE\r", lambda reply: " ".join(_text(reply).split("\r")), framing=_two_lines)


def standard_mode() -> Request[None]:
    """Leave the compatibility mode, in which replies look different."""
    return Request(b"COMP,0\r", _acknowledged, framing=line)


def resolution() -> Request[float]:
    """Ask for the length of a step in µm; negative for a drive that counts downwards."""
    return Request(b"RES,Z\r", _resolution, framing=line)


def position() -> Request[int]:
    """Ask for the position."""
    return Request(b"PZ\r", _steps, framing=line)


def set_position(steps: int) -> Request[None]:
    """Call the present place ``steps``."""
    return Request(f"PZ,{steps}\r".encode("ascii"), _acknowledged, framing=line, repeatable=False)


def move(target: int) -> Request[bool]:
    """Start an absolute move; its meaning is whether the axis is on its way."""
    return Request(f"V,{target}\r$\r".encode("ascii"), _moving, moves=True, framing=_up_to_the_status)


def move_by(distance: int) -> Request[bool]:
    """Start a relative move; never repeated, for it would go twice as far."""
    words = f"U,{distance}" if distance >= 0 else f"D,{-distance}"
    payload = f"{words}\r$\r".encode("ascii")
    return Request(payload, _moving, repeatable=False, moves=True, framing=_up_to_the_status)


def is_moving() -> Request[bool]:
    """Ask whether the focus drive is moving."""
    return Request(b"$\r", _moving, framing=_up_to_the_status)


def halt() -> Request[bool]:
    """Brake to rest and drop all moves that wait."""
    return Request(b"I\r$\r", _moving, framing=_up_to_the_status)


def speed() -> Request[float]:
    """Ask for the speed in percent of the fastest."""
    return Request(b"SMZ\r", _number, framing=line)


def set_speed(percent: float) -> Request[None]:
    """Set the speed in percent of the fastest, 1 to 100."""
    return Request(f"SMZ,{percent:.0f}\r".encode("ascii"), _acknowledged, framing=line)


def line(received: bytes) -> bytes | None:
    """Frame a reply of one line, whatever moves were reported as finished before it."""
    whole = received.split(TERMINATOR)[:-1]
    return next((reply for reply in whole if reply != _DONE), None)


def _two_lines(received: bytes) -> bytes | None:
    whole = [reply for reply in received.split(TERMINATOR)[:-1] if reply != _DONE]
    return b"\r".join(whole[:2]) if len(whole) >= 2 or (whole and whole[0].startswith(b"E,")) else None


def _up_to_the_status(received: bytes) -> bytes | None:
    """Frame what ends with a status: perhaps a refusal, perhaps some ``R``, then the number."""
    whole = received.split(TERMINATOR)[:-1]
    told = next((index for index, reply in enumerate(whole) if _STATUS.fullmatch(reply)), None)
    return None if told is None else b"\r".join(whole[: told + 1])


def _text(reply: bytes) -> str:
    """Return the reply's words, or raise for a refusal and for bytes that are no words."""
    try:
        text = reply.decode("ascii").strip()
    except UnicodeDecodeError:
        raise _malformed(reply) from None
    if not all(character.isprintable() or character == "\r" for character in text):
        raise _malformed(reply)
    _check_refusal(text)
    return text


def _check_refusal(text: str) -> None:
    refused = _REFUSAL.fullmatch(text)
    if refused:
        reason = refused.group(1)
        raise Refused(f"the controller refused: {_REFUSALS.get(reason, 'error')} (E,{reason}).", reason=reason)


def _malformed(reply: bytes) -> MalformedReply:
    return MalformedReply(f"no valid reply: {reply[:40]!r}.", reply=reply)


def _acknowledged(reply: bytes) -> None:
    if _text(reply) != "0":
        raise _malformed(reply)


def _steps(reply: bytes) -> int:
    return int(_matched(_STEPS, reply))


def _number(reply: bytes) -> float:
    return float(_matched(_NUMBER, reply))


def _resolution(reply: bytes) -> float:
    step_um = _number(reply)
    if step_um == 0:
        raise _malformed(reply)
    return step_um


def _moving(reply: bytes) -> bool:
    *before, status = reply.split(TERMINATOR)
    for said in before:
        if said != _DONE:
            _text(said)
            raise _malformed(reply)
    if _STATUS.fullmatch(status) is None:
        raise _malformed(reply)
    return bool(int(status) & Z_MOVING)


def _matched(pattern: re.Pattern[str], reply: bytes) -> str:
    text = _text(reply)
    if pattern.fullmatch(text) is None:
        raise _malformed(reply)
    return text
