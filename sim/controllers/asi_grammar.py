r"""How a line to an ASI controller reads: ``M Z=1234 X``, ``S Z?``, ``\\``, ``WHERE Z``."""

from __future__ import annotations

import re
from dataclasses import dataclass

LONG_NAMES = {
    "ACCEL": "AC",
    "BACKLASH": "B",
    "BUILD": "BU",
    "CDATE": "CD",
    "ERROR": "E",
    "HALT": "\\",
    "HERE": "H",
    "HOME": "!",
    "INFO": "I",
    "JOYSTICK": "J",
    "JSSPD": "JS",
    "LOAD": "LD",
    "MOTCTRL": "MC",
    "MOVE": "M",
    "MOVREL": "R",
    "OVERSHOOT": "OS",
    "PCROS": "PC",
    "RBMODE": "RM",
    "RDSTAT": "RS",
    "SAVESET": "SS",
    "SETHOME": "HM",
    "SETLOW": "SL",
    "SETUP": "SU",
    "SPEED": "S",
    "STATUS": "/",
    "UNITS": "UM",
    "VECTOR": "VE",
    "VERBOSE": "VB",
    "VERSION": "V",
    "WAIT": "WT",
    "WHERE": "W",
    "ZERO": "Z",
}
LARGEST_NUMBER = 1e9
_LINE = re.compile(r"\s*([\\/!]|[A-Z][A-Z0-9]*)\s*(.*?)\s*")
_WORD = re.compile(r"([A-Z])\s*(?:=\s*([-+]?(?:\d+\.?\d*|\.\d+))|([?+-]))?(?=\s|$)\s*")

UNKNOWN_COMMAND, BAD_AXIS, MISSING_PARAMETER, OUT_OF_RANGE, FAILED, BAD_CARD, HALTED = 1, 2, 3, 4, 5, 7, 21


class Nack(Exception):
    """The controller says ``:N-code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f":N-{code}")


@dataclass(frozen=True)
class Word:
    """One parameter: a letter, then perhaps ``=value`` or one of the marks ``?``, ``+``, ``-``."""

    letter: str
    value: float | None = None
    mark: str = ""

    @property
    def number(self) -> float:
        """The value; a number left out is 0, as the controllers have it."""
        return self.value or 0.0


@dataclass(frozen=True)
class Command:
    """One line: the short name of the command and its parameters in their order."""

    name: str
    words: tuple[Word, ...]

    @property
    def is_query(self) -> bool:
        """Tell whether values are asked for."""
        return any(word.mark == "?" for word in self.words)

    def value(self, letter: str) -> float | None:
        """Return what is set for a letter: None when it is not mentioned, 0 when it has no number."""
        return next((word.number for word in self.words if word.letter == letter), None)


def parse(line: str) -> Command:
    """Read a line, in capitals or not.

    Raises
    ------
    Nack
        Unknown command for what is no word at all, out of range for parameters that cannot be read.
    """
    found = _LINE.fullmatch(line.upper())
    if found is None:
        raise Nack(UNKNOWN_COMMAND)
    name, rest = found.groups()
    return Command(LONG_NAMES.get(name, name), tuple(_words(rest)))


def _words(rest: str) -> list[Word]:
    words, at = [], 0
    while at < len(rest):
        found = _WORD.match(rest, at)
        if found is None:
            raise Nack(OUT_OF_RANGE)
        letter, value, mark = found.groups()
        words.append(Word(letter, None if value is None else _number(value), mark or ""))
        at = found.end()
    return words


def _number(text: str) -> float:
    number = float(text)
    if abs(number) > LARGEST_NUMBER:
        raise Nack(OUT_OF_RANGE)
    return number
