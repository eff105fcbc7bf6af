"""The registers of one unit, by the names of its profile."""

from __future__ import annotations

import logging
from itertools import pairwise
from typing import TYPE_CHECKING

from devices.errors import LinkError, LinkLost, Unsafe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from devices.profile import Action, Bit, Profile
    from devices.transport.modbus import Addressed, RegisterBus

log = logging.getLogger(__name__)

SEQ = "seq"
SEQ_RANGE = 0x10000
SMOOTHER = 4  # a path read with swapped words is thousands of times as long


class Registers:
    """Reads, bit tests and actions of one unit.

    Parameters
    ----------
    bus : RegisterBus
        The line.
    profile : Profile
        Its register map; the unit's number is that of its link.
    """

    def __init__(self, bus: RegisterBus, profile: Profile) -> None:
        self.bus = bus
        self.profile = profile
        self.unit = profile.link.unit
        self._seq = 0

    def number(self, name: str) -> int:
        """Read one register or pair."""
        return self.profile.number_in(name, self.words(name))

    def words(self, name: str) -> list[int]:
        """Read one register, pair or block as words."""
        return self.bus.read(self.unit, self.profile.read_of(name))

    def test(self, bit: Bit, seen: dict[str, int]) -> bool:
        """Test a bit; ``seen`` keeps what was read, so that one look at a register serves all its bits."""
        if bit.reg not in seen:
            seen[bit.reg] = self.number(bit.reg)
        return bool(seen[bit.reg] & bit.mask)

    def do(self, action: Action, **supplied: int) -> None:
        """Carry out an action: each of its writes once."""
        numbered = any(SEQ in step.terms for step in action)
        for request in self.profile.writes(action, supplied | (self._next_seq() if numbered else {})):
            self.bus.write(self.unit, request)

    def put(self, name: str, value: int) -> None:
        """Write a setting. A lost reply is no matter: the caller reads it back."""
        try:
            self.bus.write(self.unit, self.profile.write_of(name, value))
        except LinkLost:
            raise
        except LinkError as error:
            log.warning("%s the read-back will tell", error.what)

    def urgently(self, action: Action) -> list[Addressed]:
        """Return the writes of a stop that waits for nothing, not even for a mailbox to be read.

        Of two numbers in a row one is certainly not the one the mailbox acknowledged last.
        """
        writes: list[Addressed] = []
        for _ in range(2 if self.profile.seq else 1):
            self._seq = (self._seq + 2) % SEQ_RANGE
            writes += [(self.unit, write) for write in self.profile.writes(action, {"seq": self._seq})]
        return writes

    def check_identity(self) -> None:
        """Compare registers that have known values; raises `Unsafe` for another drive or a swapped word order."""
        for identity in self.profile.identify:
            words = self.words(identity.reg)
            if self.profile.number_in(identity.reg, words) != identity.v:
                raise self._other_drive(identity.reg, words, identity.v)

    def check_word_order(self, name: str, low: float, high: float) -> None:
        """Raise `Unsafe` when a number makes sense only with its words swapped."""
        words = self.words(name)
        number, swapped = (self.profile.number_in(name, order) for order in (words, words[::-1]))
        if not low <= number <= high and low <= swapped <= high:
            raise swapped_words(name, f"reads {number}; with its two words swapped it would be {swapped}")

    def check_path(self, name: str, path: Sequence[list[int]]) -> None:
        """Raise `Unsafe` when readings during a motion make a smooth path only with their words swapped.

        The low word of a pair changes with every count, the high one with every 65536th.
        """
        length, swapped = (
            sum(abs(after - before) for before, after in pairwise(numbers))
            for numbers in ([self.profile.number_in(name, words[::way]) for words in path] for way in (1, -1))
        )
        if swapped * SMOOTHER < length:
            raise swapped_words(name, f"went {length} counts in a short motion; with its words swapped, {swapped}")

    def _next_seq(self) -> dict[str, int]:
        if self.profile.seq is None:
            return {}
        self._seq = (self.number(self.profile.seq.ack) + 1) % SEQ_RANGE
        return {"seq": self._seq}

    def _other_drive(self, name: str, words: list[int], expected: int) -> Unsafe:
        number = self.profile.number_in(name, words)
        if len(words) > 1 and self.profile.number_in(name, words[::-1]) == expected:
            return swapped_words(name, f"reads {number}; with its two words swapped it would be {expected}")
        return Unsafe(
            f"feed: unit {self.unit} has {number} in '{name}', not {expected}. Nothing was moved.",
            why="It is another drive than the profile describes, or it is set up differently.",
            fix="check unit and profile; set the drive up as the profile says, or copy the profile and change it.",
            code="feed-identity",
        )


def swapped_words(name: str, seen: str) -> Unsafe:
    """Return the error for a drive that orders the words of a pair the other way, as was seen."""
    return Unsafe(
        f"feed: '{name}' {seen}. No feed was made.",
        why="The drive orders the words of a 32-bit number the other way.",
        fix='set word_order = "little" (or "big") in [microtome], as in the drive.',
        code="feed-word-order",
    )
