"""An ASI MS-2000 as its clients know it: bytes in, bytes out.

Written from ASI's programming manual and from what clients of these controllers were seen to send and to accept, and
from nothing the drivers are made of. Lengths of commands are tenths of a µm, of settings mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from threading import RLock
from typing import TYPE_CHECKING

from devices.values import Limits
from sim.controllers.asi_grammar import (
    BAD_AXIS,
    FAILED,
    HALTED,
    MISSING_PARAMETER,
    UNKNOWN_COMMAND,
    Command,
    Nack,
    Word,
    parse,
)
from sim.controllers.asi_triggered import ACK, UNITS_PER_UM, Triggered

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.motion import Axis

UM_PER_MM = 1000.0
AT_LIMIT_UM = 0.05
SHORTEST_RAMP_MS, LONGEST_RAMP_MS = 1.0, 32767.0
FLUSHES = frozenset(b"\x08\x7f")
CONTROL = 0xFF
SWITCHES = ("+", "-")
BUILD = "STD_XYZ"
CAPABILITIES = (BUILD, "Motor Axes: X Y Z ", "CMDS: XYZFTR", "RING BUFFER 50", "SEARCH INDEX", "IN0_INT", "DAC OUT")
FIXED = {"V": ":A Version: USB-9.54 ", "CD": "Jan 15 2024:12:00:00", "SS": ACK, "VB": ACK}
IDENTITIES = {"Z2B": {"X": 0, "Y": 1, "Z": 2}, "UL": {"F": 2}}


@dataclass(frozen=True)
class Setting:
    """A number kept for every axis: its value at power-up, and how an answer looks.

    Some are answered ``:A Z=1.5``, others ``:Z=70 A``.
    """

    value: float
    digits: int
    value_first: bool = False

    def answer(self, pairs: list[tuple[str, float]]) -> str:
        """Return the reply that tells the values of some axes."""
        told = " ".join(f"{letter}={value:.{self.digits}f}" for letter, value in pairs)
        return f":{told} A" if self.value_first else f":A {told}"


SETTINGS = {
    "AC": Setting(70, 0, value_first=True),
    "B": Setting(0.04, 6, value_first=True),
    "CNTS": Setting(45397.6, 6, value_first=True),
    "E": Setting(0.0004, 6, value_first=True),
    "HM": Setting(0, 3),
    "J": Setting(4, 0),
    "JS": Setting(50, 0),
    "OS": Setting(0, 6, value_first=True),
    "PC": Setting(0.000024, 6),
    "S": Setting(1.5, 6),
    "SL": Setting(-110, 3),
    "SU": Setting(110, 3),
    "UM": Setting(10000, 0, value_first=True),
    "VE": Setting(0, 6),
    "WT": Setting(0, 0, value_first=True),
}


class Ms2000:
    """The twin: one state, whoever talks to it.

    Backlash ``B`` is kept and told, but the controller's own way of taking it up, beyond the target and back, is not
    made: whoever drives this axis meets its lost motion.

    Parameters
    ----------
    axes : dict of str to Axis
        Axes by letter, in the order in which the hardware has them; one of them is Z.
    triggered : Triggered, optional
        What Z does on pulses; that of an MS-2000 when left out.
    """

    def __init__(self, axes: dict[str, Axis], triggered: Triggered | None = None) -> None:
        self._axes = axes
        self._origin_um = dict.fromkeys(axes, 0.0)
        self._motor_off: set[str] = set()
        self._joystick_off: set[str] = set()
        self._stored = {(name, letter): setting.value for name, setting in SETTINGS.items() for letter in axes}
        self._triggered = triggered or Triggered(axes["Z"])
        self._input = bytearray()
        self._one_at_a_time = RLock()
        self._handlers: dict[str, Callable[[Command], str]] = {
            "/": lambda _: "B" if self._any_moving() else "N",
            "\\": self._halt,
            "!": self._home,
            "BU": self._build,
            "H": self._here,
            "I": self._info,
            "LD": self._triggered.load,
            "M": self._move,
            "MC": self._motor,
            "R": self._move_by,
            "RM": self._triggered.ring,
            "RS": self._status,
            "TTL": self._triggered.line,
            "W": self._where,
            "Z": self._zero,
            "ZS": self._triggered.stack,
        }

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come and return the replies to the commands that became complete."""
        with self._one_at_a_time:
            replies = [self._take(byte) for byte in data]
        return [reply for reply in replies if reply]

    def ttl_in(self) -> None:
        """Take a pulse at the TTL input."""
        with self._one_at_a_time:
            self._triggered.check_timeout()
            self._triggered.pulse()

    def ttl_out_s(self) -> float | None:
        """Return when the TTL output rose last or, while a move is under way, will rise; None if never."""
        with self._one_at_a_time:
            self._triggered.check_timeout()
            return self._triggered.out_s()

    def _take(self, byte: int) -> bytes:
        if byte in FLUSHES:
            self._input.clear()
        elif byte == ord("\r"):
            line, self._input = self._input.decode("latin-1"), bytearray()
            return f"{self._reply(line)}\r\n".encode("latin-1") if line.strip() else b""
        elif byte != ord("\n"):
            self._input.append(byte)
            if len(self._input) == 2 and self._input[0] == CONTROL:  # two-byte mode switches are taken, not answered
                self._input.clear()
        return b""

    def _reply(self, line: str) -> str:
        self._triggered.check_timeout()
        try:
            return self._answer(line)
        except Nack as refusal:
            return str(refusal)

    def _answer(self, line: str) -> str:
        return self._execute(parse(line))

    def _execute(self, command: Command) -> str:
        if command.name in self._handlers:
            return self._handlers[command.name](command)
        if command.name in SETTINGS:
            return self._tell(command) if command.is_query else self._set(command)
        if command.name in IDENTITIES:
            return self._identity(command)
        if command.name in FIXED:
            return FIXED[command.name]
        raise Nack(UNKNOWN_COMMAND)

    # -- moving and looking ------------------------------------------------------------------------------------------

    def _move(self, command: Command) -> str:
        for word in self._addressed(command):
            self._drive(word.letter, word.number / UNITS_PER_UM + self._origin_um[word.letter])
        return ACK

    def _move_by(self, command: Command) -> str:
        for word in self._addressed(command):
            distance_um = word.number / UNITS_PER_UM
            if word.letter == "Z":
                self._triggered.last_relative_um = distance_um
            self._drive(word.letter, self._axes[word.letter].encoder_um() + distance_um)
        return ACK

    def _home(self, command: Command) -> str:
        for letter in self._letters(command):
            self._drive(letter, self._stored["HM", letter] * UM_PER_MM + self._origin_um[letter])
        return ACK

    def _drive(self, letter: str, target_um: float) -> None:
        if letter in self._motor_off:
            raise Nack(FAILED)
        (self._triggered if letter == "Z" else self._axes[letter]).move_to(target_um)

    def _halt(self, _command: Command) -> str:
        was_moving = self._any_moving()
        self._triggered.abort()
        for axis in self._axes.values():
            axis.halt()
        if was_moving:
            raise Nack(HALTED)
        return ACK

    def _where(self, command: Command) -> str:
        asked = {word.letter for word in self._addressed(command)}
        told = [round(self._coordinate_um(letter) * UNITS_PER_UM) for letter in self._axes if letter in asked]
        return f":A {' '.join(map(str, told))} "

    def _here(self, command: Command) -> str:
        for word in self._addressed(command):
            self._set_coordinate(word.letter, word.number / UNITS_PER_UM)
        return ACK

    def _zero(self, _command: Command) -> str:
        for letter in self._axes:
            self._set_coordinate(letter, 0.0)
        return ACK

    def _coordinate_um(self, letter: str) -> float:
        return self._axes[letter].encoder_um() - self._origin_um[letter]

    def _set_coordinate(self, letter: str, value_um: float) -> None:
        self._origin_um[letter] = self._axes[letter].encoder_um() - value_um
        self._triggered.origin_um = self._origin_um["Z"]

    # -- state -------------------------------------------------------------------------------------------------------

    def _any_moving(self) -> bool:
        return any(self._under_way(letter) for letter in self._axes)

    def _under_way(self, letter: str) -> bool:
        """Tell whether an axis moves, or rests after a move as long as ``WT`` says."""
        wait_s = self._triggered.wait_s if letter == "Z" else 0.0
        axis = self._axes[letter]
        return axis.commanded.under_way(axis.clock.now() - wait_s)

    def _status(self, command: Command) -> str:
        words = self._addressed(command)
        if command.is_query:
            return ":A " + "".join("B" if self._under_way(word.letter) else "N" for word in words)
        return ":A " + " ".join(str(self._status_byte(word.letter)) for word in words)

    def _status_byte(self, letter: str) -> int:
        """Bits: 0 not completed, 1 enabled, 2 motor, 3 joystick, 4 ramping, 5 down, 6 upper limit, 7 lower limit."""
        axis = self._axes[letter]
        ramp = axis.ramp()
        bits = (
            self._under_way(letter),
            letter not in self._motor_off,
            axis.moving(),
            letter not in self._joystick_off,
            ramp != 0,
            ramp < 0,
            axis.encoder_um() >= axis.limits.max_um - AT_LIMIT_UM,
            axis.encoder_um() <= axis.limits.min_um + AT_LIMIT_UM,
        )
        return sum(1 << bit for bit, is_set in enumerate(bits) if is_set)

    def _motor(self, command: Command) -> str:
        words = self._addressed(command)
        if command.is_query:
            return ":A " + " ".join("0" if word.letter in self._motor_off else "1" for word in words)
        for word in words:
            self._switch(self._motor_off, word)
        return ACK

    def _switch(self, off: set[str], word: Word) -> None:
        if word.mark == "-":
            off.add(word.letter)
        elif word.mark == "+":
            off.discard(word.letter)

    def _build(self, command: Command) -> str:
        return "\r".join(CAPABILITIES) if command.words else BUILD

    def _identity(self, command: Command) -> str:
        known = IDENTITIES[command.name]
        if not all(word.letter in known for word in command.words):
            raise Nack(BAD_AXIS)
        return ":A " + " ".join(f"{word.letter}={known[word.letter]}" for word in command.words)

    def _info(self, command: Command) -> str:
        """Return the page for people: two columns of 33 characters."""
        letter = self._letters(command)[-1]
        cells = [f"Axis Name: {letter}", f"Motor Position: {self._coordinate_um(letter) / UM_PER_MM:.6f} mm"]
        cells += [f"{name}: {self._value(name, letter):.{setting.digits}f}" for name, setting in SETTINGS.items()]
        rows = zip(cells[::2], [*cells[1::2], ""], strict=False)
        return "\r".join(f"{left:<33}{right:<33}" for left, right in rows)

    # -- settings ----------------------------------------------------------------------------------------------------

    def _tell(self, command: Command) -> str:
        words = self._addressed(command)
        return SETTINGS[command.name].answer([(w.letter, self._value(command.name, w.letter)) for w in words])

    def _set(self, command: Command) -> str:
        for word in self._addressed(command):
            if command.name == "J" and word.mark in SWITCHES:
                self._switch(self._joystick_off, word)
            else:
                self._stored[command.name, word.letter] = word.number
                self._apply(command.name, word)
        return ACK

    def _apply(self, name: str, word: Word) -> None:
        """Let the axis know what concerns it."""
        axis, here_um = self._axes[word.letter], word.number * UM_PER_MM + self._origin_um[word.letter]
        if name == "WT" and word.letter == "Z":
            self._triggered.wait_s = max(word.number, 0.0) / 1000
        elif name == "S":
            axis.set_speed(word.number * UM_PER_MM)
        elif name == "AC":
            axis.ramp_s = min(max(word.number, SHORTEST_RAMP_MS), LONGEST_RAMP_MS) / 1000
        elif name == "SL":
            axis.limits = Limits(here_um, axis.limits.max_um)
        elif name == "SU":
            axis.limits = Limits(axis.limits.min_um, here_um)

    def _value(self, name: str, letter: str) -> float:
        """Return a setting; what the axis made of it, where it concerns the axis."""
        axis, origin_um = self._axes[letter], self._origin_um[letter]
        live = {
            "S": axis.speed_um_s / UM_PER_MM,
            "AC": axis.ramp_s * 1000,
            "SL": (axis.limits.min_um - origin_um) / UM_PER_MM,
            "SU": (axis.limits.max_um - origin_um) / UM_PER_MM,
        }
        return live.get(name, self._stored[name, letter])

    def _addressed(self, command: Command) -> tuple[Word, ...]:
        if not command.words:
            raise Nack(MISSING_PARAMETER)
        if not all(word.letter in self._axes for word in command.words):
            raise Nack(BAD_AXIS)
        return command.words

    def _letters(self, command: Command) -> list[str]:
        return [word.letter for word in self._addressed(command)] if command.words else list(self._axes)
