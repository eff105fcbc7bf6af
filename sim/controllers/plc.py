"""A PLC behind the mailbox of docs/microtome.md: executes a command once, when its number is new; drives the knife."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from sim.controllers.registers import RegisterTwin
from sim.feed import Knife, Stroke

if TYPE_CHECKING:
    from sim.controllers.registers import WordOrder
    from sim.feed import FeedMachine

SEQ, OPCODE, TARGET, SPEED, BEAT, WINDOW_START, WINDOW_END, CUT_SPEED = 0, 1, 2, 4, 6, 8, 10, 12
ACK, STATUS, ALARM, POSITION, PLC_BEAT, INTERLOCKS, KNIFE, CUT_COUNT, MARK = 16, 17, 18, 19, 21, 22, 23, 24, 26
ENABLE, HOME, MOVE, STOP, RESET, CUT, PARK = 1, 2, 3, 4, 5, 6, 7
KNIFE_BITS = {Stroke.CLEAR: 0x01, Stroke.CUTTING: 0x02, Stroke.JAMMED: 0x04}
DOOR_CLOSED, ESTOP_RELEASED = 0x01, 0x02
NM_PER_UM = 1000


class PlcMailbox(RegisterTwin):
    """The PLC.

    Attributes
    ----------
    knife : Knife
        What it cuts with.
    door_closed, estop_released : bool
        Its safety inputs; without them it moves nothing.

    Parameters
    ----------
    cuts_only : bool
        Another drive moves the feed: its alarms are none of the PLC's.
    """

    PRESENT: ClassVar = frozenset(range(28))
    FOLLOWING, LIMIT, DRIVE = 1, 2, 5
    JAM = 4

    def __init__(self, machine: FeedMachine, word_order: WordOrder = "big", *, cuts_only: bool = False) -> None:
        super().__init__(machine, word_order)
        self._cuts_only = cuts_only
        self.knife = Knife(machine.clock, machine)
        self.door_closed = self.estop_released = True
        self.put(MARK, 0x0001_0203)

    def power_cycle(self) -> None:
        """Start anew; the count of cuts is kept."""
        super().power_cycle()
        self.put(MARK, 0x0001_0203)

    def is_move(self, address: int, values: list[int]) -> bool:
        """Tell whether this gives a new number to the command that moves."""
        return (address, values != [self.words[ACK]], self.words[OPCODE]) == (SEQ, True, MOVE)

    def is_cut(self, address: int, values: list[int]) -> bool:
        """Tell whether this gives a new number to the command that cuts."""
        return (address, values != [self.words[ACK]], self.words[OPCODE]) == (SEQ, True, CUT)

    def notice(self) -> None:
        """Look after the feed, if it is ours."""
        if not self._cuts_only:
            super().notice()

    def show(self) -> None:
        """Show status, position, interlocks and knife."""
        machine, stroke = self.machine, self.knife.state
        if not self.estop_released:
            machine.stop()
            self.knife.stop()
        moving = machine.moving and not self.alarm
        self.words[STATUS] = (
            0x01 * bool(self.alarm)
            | 0x02
            | 0x04 * moving
            | 0x08 * (not moving)
            | 0x10 * machine.homed
            | 0x20 * (not self.estop_released)
        )
        self.words[ALARM] = self.alarm
        self.put(POSITION, machine.counts)
        self.words[PLC_BEAT] = int(machine.clock.now() * 10) % 0x10000
        self.words[INTERLOCKS] = DOOR_CLOSED * self.door_closed | ESTOP_RELEASED * self.estop_released
        self.words[KNIFE] = KNIFE_BITS.get(stroke, 0)
        self.put(CUT_COUNT, self.knife.counter)

    def obey(self, touched: range) -> None:
        """Execute the command in the mailbox if its number is new, then acknowledge it."""
        if SEQ in touched and self.words[SEQ] != self.words[ACK]:
            self._execute(self.words[OPCODE])
            self.words[ACK] = self.words[SEQ]

    def _execute(self, opcode: int) -> None:
        if opcode == STOP:
            self.knife.stop()
            if not self._cuts_only:
                self.machine.stop()
        elif opcode == RESET:
            self.alarm = 0
        elif opcode == PARK and self.estop_released:
            self.knife.park()
        elif not self.alarm and self.door_closed and self.estop_released:
            self._drive(opcode)

    def _drive(self, opcode: int) -> None:
        if opcode == HOME:
            self.machine.home()
        elif opcode == MOVE:
            self.machine.move_to(self.number(TARGET), self.number(SPEED) / NM_PER_UM)
        elif opcode == CUT:
            self.knife.window_um = (self.number(WINDOW_START) / NM_PER_UM, self.number(WINDOW_END) / NM_PER_UM)
            self.knife.speed_um_s = self.number(CUT_SPEED) / NM_PER_UM
            self.knife.cut()
