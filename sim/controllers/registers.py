"""What all register twins share: words by address, 32-bit numbers over two of them, a drive's alarm."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from sim.controllers.modbus_frame import ILLEGAL_ADDRESS, RegisterFault

if TYPE_CHECKING:
    from sim.feed import FeedMachine

WordOrder = Literal["big", "little"]
WORD, SIGN, WHOLE = 0x10000, 0x8000_0000, 0x1_0000_0000


class RegisterTwin:
    """A drive behind registers: subclasses say which there are, what they show, and what writing them does.

    Parameters
    ----------
    machine : FeedMachine
        What it moves.
    word_order : str
        How it puts a 32-bit number into two registers.

    Attributes
    ----------
    alarm : int
        The drive's alarm; while there is one, nothing moves.
    """

    PRESENT: ClassVar[frozenset[int]]
    POWER_ON: ClassVar[dict[int, int]] = {}
    FOLLOWING, LIMIT, DRIVE = 1, 2, 3

    def __init__(self, machine: FeedMachine, word_order: WordOrder = "big") -> None:
        self.machine = machine
        self.word_order: WordOrder = word_order
        self.alarm = 0
        self.words = dict.fromkeys(self.PRESENT, 0) | self.POWER_ON

    def read(self, address: int, count: int) -> list[int]:
        """Return words as they are now."""
        self._check(address, count)
        self.notice()
        self.show()
        return [self.words[at] for at in range(address, address + count)]

    def write(self, address: int, values: list[int]) -> None:
        """Take words, then do what they ask for."""
        self._check(address, len(values))
        self.notice()
        self.words |= {address + index: value for index, value in enumerate(values)}
        self.obey(range(address, address + len(values)))

    def power_cycle(self) -> None:
        """Forget everything that is not in the manual as kept."""
        self.alarm = 0
        self.words = dict.fromkeys(self.PRESENT, 0) | self.POWER_ON
        self.machine.power_cycle()

    def is_move(self, address: int, values: list[int]) -> bool:
        """Tell whether this write begins a motion to a target."""
        raise NotImplementedError

    def show(self) -> None:
        """Put what can be seen of the machine into the words."""
        raise NotImplementedError

    def obey(self, touched: range) -> None:
        """Do what was written."""
        raise NotImplementedError

    def number(self, address: int) -> int:
        """Return the signed 32-bit number at an address."""
        high, low = (0, 1) if self.word_order == "big" else (1, 0)
        value = self.words[address + high] * WORD + self.words[address + low]
        return value - WHOLE if value >= SIGN else value

    def put(self, address: int, value: int) -> None:
        """Put a 32-bit number at an address."""
        high, low = divmod(value % WHOLE, WORD)
        first, second = (high, low) if self.word_order == "big" else (low, high)
        self.words[address], self.words[address + 1] = first, second

    def raise_alarm(self, code: int) -> None:
        """Stop with an alarm."""
        self.alarm = code
        self.machine.stop()

    def notice(self) -> None:
        """Stop with an alarm when the machine gives cause."""
        if self.machine.tripped:
            self.raise_alarm(self.DRIVE)
        elif self.machine.following_error:
            self.raise_alarm(self.FOLLOWING)
        elif self.machine.at_switch:
            self.raise_alarm(self.LIMIT)

    def _check(self, address: int, count: int) -> None:
        if any(at not in self.PRESENT for at in range(address, address + count)):
            raise RegisterFault(ILLEGAL_ADDRESS)
