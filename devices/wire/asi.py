"""Commands of the ASI MS-2000 and Tiger controllers for their Z axis.

Lengths are in controller units, tenths of a µm as delivered, except where a name says otherwise: speed is in mm/s and
the controller's own limits in mm. Source: ASI, programming manual of the MS-2000/RM-2000 and Tiger.
"""

from __future__ import annotations

import re
from typing import Final

from devices.errors import MalformedReply, Refused
from devices.wire.exchange import Request

TERMINATOR: Final = b"\r\n"
RDSTAT_BUSY: Final = 0x01

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_POSITION = re.compile(rf":A\s+{_NUMBER}")
_VALUE = re.compile(rf":(?:A )?Z={_NUMBER}(?: A)?")  # both ":A Z=1.5" and ":Z=70 A" are in the field
_HALTED = "-21"
_REFUSALS = {
    "-1": "unknown command",
    "-2": "no such axis",
    "-3": "a parameter is missing",
    "-4": "a parameter is out of range",
    "-5": "the operation failed",
    "-6": "undefined error",
    "-7": "no card at that address",
    _HALTED: "halted",
}


def move(target: float) -> Request[None]:
    """Start an absolute move; the reply comes at once, the axis moves on."""
    return Request(_command(f"M Z={target:.3f}"), _accepted)


def move_by(distance: float) -> Request[None]:
    """Start a relative move; never repeated, for it would go twice as far."""
    return Request(_command(f"R Z={distance:.3f}"), _accepted, repeatable=False)


def where() -> Request[float]:
    """Ask for the position."""
    return Request(_command("W Z"), _position)


def is_moving() -> Request[bool]:
    """Ask whether any axis is moving."""
    return Request(_command("/"), _busy)


def status_byte() -> Request[int]:
    """Ask for the axis' status byte; `RDSTAT_BUSY` is set while a command is not completed."""
    return Request(_command("RS Z"), lambda reply: int(_position(reply)))


def halt() -> Request[None]:
    r"""Stop all axes. ``:N-21`` answers a halt that interrupted a move: it is a success."""
    return Request(_command("\\"), _halted)


def here(position: float) -> Request[None]:
    """Call the present place ``position``."""
    return Request(_command(f"H Z={position:.3f}"), _accepted, repeatable=False)


def set_speed(mm_s: float) -> Request[None]:
    """Set the top speed; a value out of range is clipped without a word, so ask `speed` afterwards."""
    return Request(_command(f"S Z={mm_s:.6f}"), _accepted)


def speed() -> Request[float]:
    """Ask for the top speed in mm/s."""
    return Request(_command("S Z?"), _value)


def set_limits(lower_mm: float, upper_mm: float) -> tuple[Request[None], Request[None]]:
    """Set the controller's own soft limits."""
    lower, upper = _command(f"SL Z={lower_mm:.6f}"), _command(f"SU Z={upper_mm:.6f}")
    return Request(lower, _accepted), Request(upper, _accepted)


def limits() -> tuple[Request[float], Request[float]]:
    """Ask for the controller's own soft limits, lower and upper, in mm."""
    return Request(_command("SL Z?"), _value), Request(_command("SU Z?"), _value)


def units_per_mm() -> Request[float]:
    """Ask how many controller units make a mm: 10000 as delivered."""
    return Request(_command("UM Z?"), _value)


def version() -> Request[str]:
    """Ask for the firmware's name."""
    return Request(_command("V"), lambda reply: _text(reply).removeprefix(":A").strip())


def _command(words: str) -> bytes:
    return f"{words}\r".encode("ascii")


def _text(reply: bytes) -> str:
    """Return the reply's words, or raise for a refusal and for bytes that are no words."""
    try:
        text = reply.decode("ascii").rstrip()
    except UnicodeDecodeError:
        raise _malformed(reply) from None
    if text.startswith(":N"):
        reason = text.removeprefix(":N")
        raise Refused(f"the controller refused: {_REFUSALS.get(reason, 'error')} ({text}).", reason=reason)
    return text


def _malformed(reply: bytes) -> MalformedReply:
    return MalformedReply(f"no valid reply: {reply[:40]!r}.", reply=reply)


def _accepted(reply: bytes) -> None:
    if _text(reply) != ":A":
        raise _malformed(reply)


def _halted(reply: bytes) -> None:
    try:
        _accepted(reply)
    except Refused as refusal:
        if refusal.reason != _HALTED:
            raise


def _busy(reply: bytes) -> bool:
    answer = _text(reply)
    if answer not in ("N", "B"):
        raise _malformed(reply)
    return answer == "B"


def _position(reply: bytes) -> float:
    return _number(_POSITION, reply)


def _value(reply: bytes) -> float:
    return _number(_VALUE, reply)


def _number(pattern: re.Pattern[str], reply: bytes) -> float:
    found = pattern.fullmatch(_text(reply))
    if found is None:
        raise _malformed(reply)
    return float(found.group(1))
