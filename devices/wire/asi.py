"""Commands of the ASI MS-2000 and Tiger controllers for their Z axis.

Lengths are in controller units, tenths of a µm as delivered, except where a name says otherwise: speed is in mm/s, the
controller's own limits and backlash in mm. Source: ASI, programming manual of the MS-2000/RM-2000 and Tiger.
"""

from __future__ import annotations

import re
from typing import Final

from devices.errors import MalformedReply, Refused
from devices.wire.exchange import Request

TERMINATOR: Final = b"\r\n"
RDSTAT_BUSY, RDSTAT_UPPER_LIMIT, RDSTAT_LOWER_LIMIT = 0x01, 0x40, 0x80

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_POSITION = re.compile(rf":A\s+{_NUMBER}")
_VALUE = re.compile(rf":(?:A )?([A-Z])={_NUMBER}(?: A)?")  # both ":A Z=1.5" and ":Z=70 A" are in the field
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


def command(words: str, *, repeatable: bool = True, moves: bool = False) -> Request[None]:
    """Say something to which ``:A`` is the answer."""
    return Request(_command(words), _accepted, repeatable, moves)


def setting(words: str, letter: str = "Z") -> Request[float]:
    """Ask for the number the controller keeps under a letter."""
    return Request(_command(words), lambda reply: _value(reply, letter))


def move(target: float) -> Request[None]:
    """Start an absolute move; the reply comes at once, the axis moves on."""
    return command(f"M Z={target:.3f}", moves=True)


def move_by(distance: float) -> Request[None]:
    """Start a relative move; never repeated, for it would go twice as far."""
    return command(f"R Z={distance:.3f}", repeatable=False, moves=True)


def where() -> Request[float]:
    """Ask for the position."""
    return Request(_command("W Z"), _position)


def is_moving() -> Request[bool]:
    """Ask whether any axis is moving."""
    return Request(_command("/"), _busy)


def status_byte() -> Request[int]:
    """Ask for the axis' status byte; `RDSTAT_BUSY` is set while a command is not completed."""
    return Request(_command("RS Z"), lambda reply: int(_position(reply)))


def halt(word: str = "\\") -> Request[None]:
    """Stop all axes. ``:N-21`` answers a halt that interrupted a move: it is a success."""
    return Request(_command(word), _halted)


def here(position: float) -> Request[None]:
    """Call the present place ``position``."""
    return command(f"H Z={position:.3f}", repeatable=False)


def set_speed(mm_s: float) -> Request[None]:
    """Set the top speed; a value out of range is clipped without a word, so ask `speed` afterwards."""
    return command(f"S Z={mm_s:.6f}")


def speed() -> Request[float]:
    """Ask for the top speed in mm/s."""
    return setting("S Z?")


def set_limits(lower_mm: float, upper_mm: float) -> tuple[Request[None], Request[None]]:
    """Set the controller's own soft limits."""
    return command(f"SL Z={lower_mm:.6f}"), command(f"SU Z={upper_mm:.6f}")


def limits() -> tuple[Request[float], Request[float]]:
    """Ask for the controller's own soft limits, lower and upper, in mm."""
    return setting("SL Z?"), setting("SU Z?")


def units_per_mm() -> Request[float]:
    """Ask how many controller units make a mm: 10000 as delivered."""
    return setting("UM Z?")


def backlash() -> Request[float]:
    """Ask how far in mm the controller itself goes beyond a target before it comes back; 0 if it does not."""
    return setting("B Z?")


def set_wait(milliseconds: float) -> Request[None]:
    """Set how long the controller rests after a move before it calls the move completed."""
    return command(f"WT Z={milliseconds:.0f}")


def wait() -> Request[float]:
    """Ask for the rest after a move in ms."""
    return setting("WT Z?")


def joystick(*, enabled: bool) -> Request[None]:
    """Let the joystick or the wheel move the axis, or not; some firmware refuses."""
    return command(f"J Z{'+' if enabled else '-'}")


def set_decimals(count: int, card: str) -> Request[None]:
    """Set how many decimals positions are told with; Tiger only."""
    return command(f"{card}VB Z={count}")


def version() -> Request[str]:
    """Ask for the firmware's name."""
    return Request(_command("V"), lambda reply: _text(reply).removeprefix(":A").strip())


def build(card: str = "") -> Request[tuple[str, ...]]:
    """Ask what the firmware was built with: one line each, the build's name first."""
    return Request(_command(f"{card}BU X"), lambda reply: tuple(line.strip() for line in _text(reply).split("\r")))


def limits_met(status: int) -> str:
    """Return in words which of the controller's limits a status byte reports, empty for none."""
    met = [name for name, bit in (("upper", RDSTAT_UPPER_LIMIT), ("lower", RDSTAT_LOWER_LIMIT)) if status & bit]
    return f"It is at the controller's {' and '.join(met)} limit." if met else ""


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
    found = _POSITION.fullmatch(_text(reply))
    if found is None:
        raise _malformed(reply)
    return float(found.group(1))


def _value(reply: bytes, letter: str) -> float:
    found = _VALUE.fullmatch(_text(reply))
    if found is None or found.group(1) != letter:
        raise _malformed(reply)
    return float(found.group(2))
