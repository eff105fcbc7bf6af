"""The twin of the Open3DOLED emitter, firmware 22: its line, its settings, and when it tells the glasses to open.

In a free run and while it averages, the emitter counts its own microseconds, which are longer or shorter than ours by
``drift_ppm``. What it does to the glasses is worked out when somebody looks, never by a thread.
"""

from __future__ import annotations

import re
from collections import deque
from threading import RLock
from typing import TYPE_CHECKING

from devices.glasses_timing import Edge

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.glasses_timing import Eye
    from devices.protocols import Clock

VERSION = 22
FACTORY = (2, 500, 7000, 30, 6500, 10, 128, 0, 0, 0, 0, 0, 0, 32, 0, 8333, 0)
WIDE = {2, 3, 5, 16}  # fields of 16 bits, counted from 1; the others have 8
PROTOCOLS = 8
DELAY, DURATION, FLIP, FRAMETIME, MODE = 2, 3, 13, 16, 17
FIELDS, MOST_WORDS = 17, 21
BY_HOST, FREE = 1, 6
US = 1e-6
BANNER = b"+startup\r\neeprom read_settings\r\ninit complete\r\n"
KEPT_EDGES = 1 << 17
_INTEGER = re.compile(r"\s*([-+]?\d+)")


class Emitter:
    """The emitter; `edges` is what the glasses get.

    Parameters
    ----------
    clock : Clock
        Our time.
    drift_ppm : float
        By how much its second is longer than ours.
    """

    def __init__(self, clock: Clock, *, drift_ppm: float = 0.0) -> None:
        self._clock = clock
        self._drift_ppm = drift_ppm
        self._saved = list(FACTORY)
        self._fields = list(FACTORY)
        self._input = ""
        self._unread = b""
        self._edges: deque[Edge] = deque(maxlen=KEPT_EDGES)
        self._next_s: float | None = None
        self._next_eye: Eye = "left"
        self._one_at_a_time = RLock()
        self.view = 0
        self.saves = 0
        self._handlers: dict[int, Callable[[list[str]], bytes]] = {
            0: self._set,
            7: self._view,
            8: self._save,
            9: self._turn,
            10: self._stream,
        }

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come and return the replies to the lines that became complete."""
        with self._one_at_a_time:
            *lines, self._input = (self._input + data.decode("latin-1")).split("\n")
            replies = [self._unread, *(self._reply(line) for line in lines)]
            self._unread = b""
        return [reply for reply in replies if reply]

    def edges(self) -> list[Edge]:
        """Return when each eye was told to open, up to now."""
        with self._one_at_a_time:
            self._catch_up()
            return list(self._edges)

    def power_cycle(self) -> None:
        """Take the power away and give it back. What the emitter says then is read with its next reply."""
        with self._one_at_a_time:
            self._catch_up()
            self._fields, self._input, self.view = list(self._saved), "", 0
            self._unread = BANNER
            self._restart()

    def set_drift(self, drift_ppm: float) -> None:
        """Let its clock run differently from now on."""
        with self._one_at_a_time:
            self._catch_up()
            self._drift_ppm = drift_ppm

    @property
    def open_s(self) -> float:
        """How long a shutter stays open."""
        return self._field(DURATION) * self._us

    @property
    def flipped(self) -> bool:
        """Whether the eyes are exchanged."""
        return bool(self._field(FLIP))

    @property
    def _us(self) -> float:
        return US * (1 + self._drift_ppm / 1e6)

    def _field(self, number: int) -> int:
        return self._fields[number - 1]

    # -- the line ----------------------------------------------------------------------------------------------------

    def _reply(self, line: str) -> bytes:
        words = line.split(",")[:MOST_WORDS]
        if not words[0].strip("\r"):
            words[0] = "0"  # the firmware takes what is no number for 0, and 0 asks for the settings
        handler = self._handlers.get(_to_int(words[0]))
        return handler(words[1:]) if handler else b""

    def _set(self, words: list[str]) -> bytes:
        """Take settings up to the first that is empty; each counts from the moment in which it is read."""
        for number, word in enumerate(words[:FIELDS], start=1):
            if not word.strip("\r"):
                break
            self._set_field(number, _to_int(word))
        told = ",".join(map(str, (VERSION, *self._fields)))
        return f"parameters {told}\r\nOK\r\n".encode()

    def _set_field(self, number: int, value: int) -> None:
        if value < 0 or (number == 1 and value >= PROTOCOLS):
            return
        value %= 1 << (16 if number in WIDE else 8)
        before = self._field(number)
        self._catch_up()
        self._fields[number - 1] = value
        if value != before and number in (FRAMETIME, MODE):
            self._restart()

    def _view(self, words: list[str]) -> bytes:
        if not words or not 0 <= _to_int(words[0]) <= 2:
            return b""
        self.view = _to_int(words[0])
        return b"OK\r\n"

    def _save(self, _words: list[str]) -> bytes:
        self._saved = list(self._fields)
        self.saves += 1
        return b"OK\r\n"

    def _turn(self, words: list[str]) -> bytes:
        if words and self._field(MODE) == BY_HOST and _to_int(words[0]) in (0, 1):
            self._open("left" if _to_int(words[0]) == 0 else "right", self._clock.now())
        return b""

    def _stream(self, words: list[str]) -> bytes:
        return b"OK\r\n" if words and _to_int(words[0]) in (0, 1) else b""

    # -- the glasses -------------------------------------------------------------------------------------------------

    def _restart(self) -> None:
        """Begin a free run now, if there is to be one, with the left eye."""
        self._next_eye = "left"
        self._next_s = self._clock.now() if self._field(MODE) == FREE and self._field(FRAMETIME) else None

    def _catch_up(self) -> None:
        now_s = self._clock.now()
        while self._next_s is not None and self._next_s <= now_s:
            self._open(self._next_eye, self._next_s)
            self._next_eye = "right" if self._next_eye == "left" else "left"
            self._next_s += self._field(FRAMETIME) * self._us

    def _open(self, eye: Eye, turn_s: float) -> None:
        other: dict[Eye, Eye] = {"left": "right", "right": "left"}
        opens_s = turn_s + self._field(DELAY) * self._us
        self._edges.append(Edge(round(opens_s * 1e9), other[eye] if self.flipped else eye))


def _to_int(word: str) -> int:
    """Read a number as the emitter does: what is none is 0."""
    found = _INTEGER.match(word)
    return int(found.group(1)) if found else 0
