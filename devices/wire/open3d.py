r"""Commands of the Open3DOLED emitter for shutter glasses, firmware 22.

Lines end in ``\n``, replies in ``\r\n``. A reply ends with a line ``OK``; a line beginning with ``+`` is an event and
belongs to no reply. Source: open3doled/open-3d-oled, firmware and player.
"""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from devices.errors import MalformedReply
from devices.wire.exchange import Request

if TYPE_CHECKING:
    from devices.glasses_timing import Eye

BAUD: Final = 115200  # USB-CDC ignores it, but 1200 reboots the emitter into its boot loader
TERMINATOR: Final = b"OK\r\n"
SUPPORTED_VERSION: Final = 22
MOST_U16: Final = 65535
BANNER = ("eeprom read_settings", "init complete")
_PARAMETERS = re.compile(r"parameters (\d{1,3}(?:,\d{1,5}){17})")


class IrProtocol(IntEnum):
    """Whose glasses are spoken to."""

    SAMSUNG07 = 0
    XPAND = 1
    NVIDIA_3D_VISION = 2
    SHARP = 3
    SONY = 4
    PANASONIC = 5
    PANASONIC_CUSTOM = 6
    DLP_LINK = 7


class DriveMode(IntEnum):
    """What gives the glasses their turns."""

    OPTICAL = 0
    PC_SERIAL = 1
    MINIDIN3 = 2
    RF = 3
    DLP_SENSOR = 4
    DLP_TRIGGER = 5
    FREE_RUN = 6


class Glasses(IntEnum):
    """Which picture the glasses let through: the eyes' own, or one of them to both eyes."""

    STEREO = 0
    RIGHT_TO_BOTH = 1
    LEFT_TO_BOTH = 2


@dataclass(frozen=True)
class Settings:
    """The emitter's settings in the order in which it sends them; lost at power-off unless saved.

    Attributes
    ----------
    frame_delay_us : int
        From the start of a turn to the opening of the shutter.
    frame_duration_us : int
        For how long a shutter stays open.
    signal_spacing_us : int
        Pause between two infrared signals.
    block_us : int
        Optical drive: for how long after a flash no other is looked for.
    flip_eyes : int
        1 exchanges the eyes.
    frametime_us : int
        From turn to turn.
    """

    ir_protocol: int
    frame_delay_us: int
    frame_duration_us: int
    signal_spacing_us: int
    block_us: int
    min_threshold: int
    high_threshold: int
    ignore_during_ir: int
    report_duplicates: int
    output_stats: int
    ignore_duplicates: int
    filter_mode: int
    flip_eyes: int
    low_threshold: int
    averaging: int
    frametime_us: int
    drive_mode: int


def query() -> Request[Settings]:
    """Ask for all settings."""
    return Request(b"0\n", _settings)


def store(settings: Settings) -> Request[Settings]:
    """Set all settings until power-off; the reply tells what the emitter made of them.

    A changed ``frametime_us`` or ``drive_mode`` starts a free run anew, at the moment at which it arrives: a second
    sending would not, so it is never repeated.
    """
    return Request(f"0,{','.join(map(str, astuple(settings)))}\n".encode(), _settings, repeatable=False)


def view(glasses: Glasses) -> Request[None]:
    """Let the glasses show stereo, or one eye's picture to both."""
    return Request(f"7,{glasses:d}\n".encode(), _accepted)


def save() -> Request[None]:
    """Write the settings into the EEPROM, which bears 100 000 writes: only when a person asks for it."""
    return Request(b"8\n", _accepted, repeatable=False)


def stream(*, on: bool) -> Request[None]:
    """Let the emitter send what its light sensor reads, as events, or stop it."""
    return Request(f"10,{on:d}\n".encode(), _accepted)


def turn(eye: Eye) -> bytes:
    """Return the line that gives one eye its turn; it has no reply and works in `DriveMode.PC_SERIAL` only."""
    return b"9,0\n" if eye == "left" else b"9,1\n"


def _lines(reply: bytes) -> list[str]:
    """Return the reply's lines without events, and without what the emitter says when it starts."""
    try:
        text = reply.decode("ascii")
    except UnicodeDecodeError:
        raise _malformed(reply) from None
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("+") and line not in BANNER]


def _settings(reply: bytes) -> Settings:
    lines = _lines(reply)
    found = _PARAMETERS.fullmatch(lines[0]) if len(lines) == 1 else None
    if found is None:
        raise _malformed(reply)
    version, *values = map(int, found.group(1).split(","))
    if version != SUPPORTED_VERSION:
        raise MalformedReply(
            f"the emitter's firmware is version {version}; this program speaks version {SUPPORTED_VERSION}.",
            reply=reply,
            fix="bring the emitter's firmware to version 22 with its own tool.",
        )
    if max(values) > MOST_U16 or len(values) != len(fields(Settings)):
        raise _malformed(reply)
    return Settings(*values)


def _accepted(reply: bytes) -> None:
    if _lines(reply):
        raise _malformed(reply)


def _malformed(reply: bytes) -> MalformedReply:
    return MalformedReply(f"no valid reply: {reply[:40]!r}.", reply=reply)
