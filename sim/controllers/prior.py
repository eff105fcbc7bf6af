"""A Prior ProScan III with a focus drive as its clients know it: bytes in, bytes out.

Written from Prior's manual and from what clients of these controllers were seen to send and to accept, and from nothing
the drivers are made of. Lengths are in steps.
"""

from __future__ import annotations

import re
from collections import deque
from threading import RLock
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.motion import Axis

BAD_STRING, UNKNOWN_COMMAND, OUT_OF_RANGE, BAD_ARGUMENT, QUEUE_FULL, NOT_FITTED = 4, 5, 8, 10, 18, 20
QUEUE = 100
Z_MOVING = 4
DATE = ("PRIOR SCIENTIFIC INSTRUMENTS LTD. PROSCAN III", "VERSION 1.12 JAN 15 2024")
HELP = ("PROSCAN INFORMATION", "STAGE = NONE", "FOCUS = NORMAL", "MICRONS/REV = 100", "END")
PERCENT = {"SMZ": 100.0, "SAZ": 100.0, "SCZ": 100.0}
_SEPARATORS = re.compile(r"[, \t;:=]+")


class Refusal(Exception):
    """The controller says ``E,code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"E,{code}")


class ProScan:
    """The twin: one state, whoever talks to it.

    Firmware differs in what ``R`` means. Said when a move is accepted, a later move replaces it. Said when it is
    finished, later moves queue up; the ``R`` is then due without a question, see `unasked`.

    Parameters
    ----------
    axis : Axis
        The focus drive.
    step_um : float
        Of one step; negative for a drive that counts downwards.
    says_r : {"accepted", "finished"}
        When the reply to a move comes.
    """

    def __init__(
        self, axis: Axis, *, step_um: float = 0.1, says_r: Literal["accepted", "finished"] = "accepted"
    ) -> None:
        self._axis = axis
        self._factory_step_um = step_um
        self._says_when_finished = says_r == "finished"
        self._origin_um = 0.0
        self._one_at_a_time = RLock()
        self._handlers: dict[str, Callable[[list[str]], str]] = {
            "$": lambda _: str(Z_MOVING * self._busy()),
            "?": lambda _: "\r".join(HELP),
            "COMP": self._compatibility,
            "D": lambda words: self._go_by(-_number(words, 0)),
            "DATE": lambda _: "\r".join(DATE),
            "I": self._stop,
            "K": self._stop,
            "PIEZORANGE": _not_fitted,
            "PZ": self._position,
            "RES": self._resolution,
            "U": lambda words: self._go_by(_number(words, 0)),
            "V": lambda words: self._go_to(_number(words, 0)),
        }
        self._wake()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come and return what the controller says: an ``R`` that is due first."""
        with self._one_at_a_time:
            replies = self.unasked()
            for byte in data:
                replies += self._take(byte)
        return replies

    def unasked(self) -> list[bytes]:
        """Return an ``R`` for each move that was finished since; a line asks every few milliseconds."""
        with self._one_at_a_time:
            return [b"R\r"] * self._finish()

    def power_cycle(self) -> None:
        """Be switched off and on: here is 0, all settings are those of the factory."""
        with self._one_at_a_time:
            self._axis.halt()
            self._axis.set_speed(self._axis.top_speed_um_s)
            self._origin_um = self._axis.encoder_um()
            self._wake()

    def _wake(self) -> None:
        self._step_um = self._factory_step_um
        self._settings = dict(PERCENT)
        self._compatible = 0
        self._waiting: deque[float] = deque()
        self._owed = 0
        self._input = bytearray()

    # -- the line ----------------------------------------------------------------------------------------------------

    def _take(self, byte: int) -> list[bytes]:
        if byte != ord("\r"):
            self._input.append(byte)
            return []
        line, self._input = self._input.decode("latin-1").strip(), bytearray()
        answer = self._reply(line.upper()) if line else ""
        return [f"{answer}\r".encode("latin-1")] if answer else []

    def _reply(self, line: str) -> str:
        name, *words = [word for word in _SEPARATORS.split(line) if word] or [""]
        try:
            return self._execute(name, words)
        except Refusal as refusal:
            return str(refusal)

    def _execute(self, name: str, words: list[str]) -> str:
        if name in self._settings:
            return self._percent(name, words)
        if name not in self._handlers:
            raise Refusal(UNKNOWN_COMMAND)
        return self._handlers[name](words)

    # -- moves -------------------------------------------------------------------------------------------------------

    def _go_by(self, steps: float) -> str:
        heading_um = self._waiting[-1] if self._waiting else self._axis.commanded.path.target_um
        return self._queue(heading_um + steps * self._step_um)

    def _go_to(self, steps: float) -> str:
        return self._queue(self._origin_um + steps * self._step_um)

    def _queue(self, target_um: float) -> str:
        if not self._says_when_finished:
            self._axis.move_to(target_um)
            return "R"
        if len(self._waiting) >= QUEUE:
            raise Refusal(QUEUE_FULL)
        if self._owed:
            self._waiting.append(target_um)
        else:
            self._axis.move_to(target_um)
        self._owed += 1
        return ""

    def _finish(self) -> int:
        """Return how many moves have ended since it was last asked, and start the next."""
        if not self._owed or self._axis.moving():
            return 0
        self._owed -= 1
        if self._waiting:
            self._axis.move_to(self._waiting.popleft())
        return 1

    def _busy(self) -> bool:
        return self._axis.moving() or bool(self._waiting)

    def _stop(self, _words: list[str]) -> str:
        self._axis.halt()
        self._waiting.clear()
        self._owed = 0
        return "R"

    # -- state -------------------------------------------------------------------------------------------------------

    def _position(self, words: list[str]) -> str:
        here_um = self._axis.encoder_um()
        if words:
            self._origin_um = here_um - _number(words, 0) * self._step_um
            return "0"
        return str(round((here_um - self._origin_um) / self._step_um))

    def _compatibility(self, words: list[str]) -> str:
        if not words:
            return str(self._compatible)
        if _number(words, 0) not in (0, 1):
            raise Refusal(OUT_OF_RANGE)
        self._compatible = int(words[0])
        return "0"

    def _resolution(self, words: list[str]) -> str:
        if words[:1] != ["Z"]:
            raise Refusal(BAD_ARGUMENT)
        if len(words) == 1:
            return f"{self._step_um:g}"
        step_um = _number(words, 1)
        if step_um == 0:
            raise Refusal(BAD_ARGUMENT + 1)
        self._step_um = step_um
        return "0"

    def _percent(self, name: str, words: list[str]) -> str:
        if not words:
            return f"{self._settings[name]:g}"
        value = _number(words, 0)
        if not 1 <= value <= 100:
            raise Refusal(OUT_OF_RANGE)
        self._settings[name] = value
        if name == "SMZ":
            self._axis.set_speed(value / 100 * self._axis.top_speed_um_s)
        return "0"


def _number(words: list[str], index: int) -> float:
    if len(words) <= index:
        raise Refusal(BAD_ARGUMENT + index)
    try:
        return float(words[index])
    except ValueError:
        raise Refusal(BAD_STRING) from None


def _not_fitted(_words: list[str]) -> str:
    raise Refusal(NOT_FITTED)
