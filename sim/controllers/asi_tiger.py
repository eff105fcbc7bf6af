"""An ASI Tiger as its clients know it: a communication card, a card for X and Y, a card for Z.

A command that names an axis finds its card by itself; commands to a card begin with its address, one character or two
hexadecimal digits of it: ``2TTL X=1`` and ``32TTL X=1`` are the same.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from sim.controllers.asi import Ms2000
from sim.controllers.asi_grammar import BAD_CARD, UNKNOWN_COMMAND, Command, Nack, parse
from sim.controllers.asi_triggered import ACK, UNITS_PER_UM, Triggered

if TYPE_CHECKING:
    from sim.motion import Axis

RING_SLOTS = 250
COMM, Z_CARD = "0", "2"
CARDS = {"X": "1", "Y": "1", "Z": Z_CARD}
TYPES = {"X": "x", "Y": "x", "Z": "z"}
HAS_RING = 2
PROPERTIES = {"X": 8 + HAS_RING, "Y": 8 + HAS_RING, "Z": HAS_RING}
BUILDS = {COMM: "TIGER_COMM", "1": "STD_XY", Z_CARD: "STD_Z"}
OF_A_CARD = frozenset(["TTL", "ZS"])
MOST_DECIMALS = 6
EITHER_BIT = 0b101  # clients count the axes of the card, or of the whole controller when they address no card
_ADDRESSED = re.compile(r"\s*(?:3(?=\d))?(\d)?\s*(.*)", re.DOTALL)


class Tiger(Ms2000):
    """The twin. Cards' settings beyond those of `Ms2000` are not made; see there for parameters."""

    def __init__(self, axes: dict[str, Axis]) -> None:
        super().__init__(axes, Triggered(axes["Z"], slots=RING_SLOTS, mask=EITHER_BIT, z_bit=EITHER_BIT))
        self._decimals = 1
        self._card: str | None = None
        self._handlers.update({"V": lambda _: ":A v3.50", "VB": self._verbosity, "BU": self._build})

    def _answer(self, line: str) -> str:
        found = _ADDRESSED.fullmatch(line)
        assert found is not None
        self._card, words = found.groups()
        if self._card not in (None, *BUILDS):
            raise Nack(BAD_CARD)
        command = parse(words)
        if (command.name == "\\" and self._card and "\\" in words) or self._is_not_for(self._card, command):
            raise Nack(UNKNOWN_COMMAND)
        reply = self._execute(command)
        return ":A" if reply == ACK else reply

    def _is_not_for(self, card: str | None, command: Command) -> bool:
        return command.name in OF_A_CARD and card != Z_CARD

    def _where(self, command: Command) -> str:
        asked = {word.letter for word in self._addressed(command)}
        told = [self._coordinate_um(letter) * UNITS_PER_UM for letter in self._axes if letter in asked]
        return f":A {' '.join(f'{number:.{self._decimals}f}' for number in told)} "

    def _verbosity(self, command: Command) -> str:
        decimals = command.value("Z")
        if decimals is not None:
            self._decimals = min(max(int(decimals), 0), MOST_DECIMALS)
        return ACK

    def _build(self, command: Command) -> str:
        card = self._card or COMM
        if not command.words:
            return BUILDS[card]
        letters = [letter for letter in self._axes if card in (COMM, CARDS[letter])]
        lines = [
            BUILDS[card],
            f"Motor Axes: {' '.join(letters)}",
            f"Axis Types: {' '.join(TYPES[letter] for letter in letters)}",
            f"Axis Addr: {' '.join(CARDS[letter] for letter in letters)}",
            f"Hex Addr: {' '.join(f'{ord(CARDS[letter]):x}' for letter in letters)}",
            f"Axis Props: {' '.join(str(PROPERTIES[letter]) for letter in letters)}",
        ]
        return "\r".join(lines if card == COMM else [*lines, f"RING BUFFER {RING_SLOTS}"]) + "\r"
