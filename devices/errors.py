"""Errors, sorted by what the caller does next.

Every error carries a stable ``code``, what happened, why, and what to do about it, so that the program can print one
clear message and leave with the exit code documented in ``docs/errors.md``.
"""

from __future__ import annotations

import difflib
from typing import ClassVar


def did_you_mean(word: str, known: list[str]) -> str:
    """Return ``"; did you mean 'port'?"`` when a known word is near, else the list of what is known."""
    near = difflib.get_close_matches(word, known, n=1)
    if near:
        return f"; did you mean '{near[0]}'?"
    return f"; known here: {', '.join(sorted(known))}" if known else ""


class StereotomeError(Exception):
    """Base of all errors this program raises on purpose.

    Parameters
    ----------
    what : str
        What happened, with value, unit and limit; stands alone.
    why : str
        The cause, as far as it is known.
    fix : str or tuple of str
        What the user can do, best first.
    code : str, optional
        Stable name of the error; the class default when left out.
    """

    code: str = "error"
    exit_code: ClassVar[int] = 1

    def __init__(self, what: str, *, why: str = "", fix: str | tuple[str, ...] = (), code: str | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.why = why
        self.fix = (fix,) if isinstance(fix, str) else fix
        if code is not None:
            self.code = code

    def message(self) -> str:
        """Return the text a person reads: ``error[code]: what``, then why and fix on lines of their own."""
        lines = [f"error[{self.code}]: {self.what}"]
        if self.why:
            lines.append(f"  why: {self.why}")
        lines += [
            f"  {label:>3}: {fix}" for label, fix in zip(("fix", *["or"] * len(self.fix)), self.fix, strict=False)
        ]
        return "\n".join(lines)


class DeviceError(StereotomeError):
    """A device failed; stop this run safely."""

    code = "device-failed"
    exit_code = 4


class LinkError(DeviceError):
    """The wire failed; a repeatable request may be asked again."""

    code = "device-link"


class NoReply(LinkError):
    """Silence: the deadline passed with nothing, or only part of a reply, received.

    Attributes
    ----------
    received : bytes
        The part that came, if any.
    """

    code = "device-silent"

    def __init__(self, what: str, *, received: bytes = b"", why: str = "", fix: str | tuple[str, ...] = ()) -> None:
        super().__init__(what, why=why, fix=fix)
        self.received = received


class MalformedReply(LinkError):
    """Noise: bytes came back that are no reply.

    Attributes
    ----------
    reply : bytes
        What was received.
    """

    code = "device-garbled"

    def __init__(self, what: str, *, reply: bytes, why: str = "", fix: str | tuple[str, ...] = ()) -> None:
        super().__init__(what, why=why, fix=fix)
        self.reply = reply


class LinkLost(LinkError):
    """The port itself went away: unplugged, or the peer died. Nothing is known about the device any more."""

    code = "device-lost"


class Refused(DeviceError):
    """The controller said no; never repeated.

    Attributes
    ----------
    reason : str
        The controller's own error number or word.
    """

    code = "device-refused"

    def __init__(self, what: str, *, reason: str, why: str = "", fix: str | tuple[str, ...] = ()) -> None:
        super().__init__(what, why=why, fix=fix)
        self.reason = reason


class Halted(DeviceError):
    """A halt came before the move; it was not sent."""

    code = "device-halted"


class StageStalled(DeviceError):
    """The stage stopped making progress before it arrived."""

    code = "stage-stalled"


class StageTimeout(DeviceError):
    """The stage kept moving past every sensible deadline."""

    code = "stage-timeout"


class SequenceBroken(DeviceError):
    """A hardware-triggered stack lost its step, and it cannot be told which planes are right."""

    code = "stage-sequence"


class CameraTimeout(DeviceError):
    """No frame came within its deadline."""

    code = "camera-timeout"


class CameraGone(DeviceError):
    """The camera's connection is lost, and it cannot be opened anew."""

    code = "camera-gone"


class IncompleteFrame(CameraTimeout):
    """A frame came with holes: as good as none, and as safe to take again."""

    code = "camera-incomplete"


class DeviceBusy(DeviceError):
    """Another program holds the port or the bench."""

    code = "device-busy"
    exit_code = 8


class LimitError(DeviceError):
    """A value is outside a limit; nothing was sent, nothing moved."""

    code = "limit"
    exit_code = 5


class Unsafe(DeviceError):
    """An interlock said no; nothing was sent."""

    code = "interlock"
    exit_code = 5


class PlanError(StereotomeError):
    """The recipe or plan makes no sense as written."""

    code = "config"
    exit_code = 3


class RigError(StereotomeError):
    """The instrument file is wrong."""

    code = "config"
    exit_code = 3


class StoreError(StereotomeError):
    """The disk or the data on it failed."""

    code = "store"
    exit_code = 6


class InputError(StereotomeError):
    """A file given as input cannot be used."""

    code = "input"
    exit_code = 2


class DisplayError(StereotomeError):
    """No picture can be shown."""

    code = "display"
    exit_code = 10
