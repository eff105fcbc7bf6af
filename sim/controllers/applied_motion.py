"""An Applied Motion drive with SCL opcodes in a mailbox register; it forgets its position at power-off."""

from __future__ import annotations

from typing import ClassVar

from sim.controllers.registers import RegisterTwin

ALARM, STATUS, ENCODER, POSITION, ACC, DEC, SPEED, TARGET, OPCODE = 0, 1, 4, 6, 27, 28, 29, 30, 124
ENABLE, DISABLE, FEED_TO_POSITION, FEED_TO_LENGTH, SEEK_HOME, STOP_HARD, STOP_SOFT, RESET = (
    *(0x9F, 0x9E, 0x67, 0x66, 0x6E, 0xE1, 0xE2, 0xBA),
)
SC_ENABLED, SC_FAULT, SC_IN_POSITION, SC_MOVING, SC_ALARM, SC_HOMING = 0x0001, 0x0004, 0x0008, 0x0010, 0x0200, 0x0400
SPEED_UNIT_REV_S = 1 / 240
COUNTS_PER_REV = 20_000


class AppliedMotionScl(RegisterTwin):
    """The drive; addresses are the manual's less 40001."""

    PRESENT: ClassVar = frozenset([*range(12), *range(27, 32), *range(46, 52), *range(124, 130)])
    POWER_ON: ClassVar = {ACC: 600, DEC: 600, SPEED: 240}
    FOLLOWING, LIMIT, DRIVE = 0x1000, 0x0004, 0x0080
    enabled = True
    homing = False

    def is_move(self, address: int, values: list[int]) -> bool:
        """Tell whether this is an opcode that feeds."""
        return address == OPCODE and values[:1] in ([FEED_TO_POSITION], [FEED_TO_LENGTH])

    def show(self) -> None:
        """Show alarm, status and positions."""
        machine = self.machine
        self.homing = self.homing and not machine.homed
        moving = machine.moving and not self.alarm
        self.words[ALARM] = self.alarm
        self.words[STATUS] = (
            SC_ENABLED * self.enabled
            | SC_FAULT * bool(self.alarm)
            | SC_ALARM * bool(self.alarm)
            | SC_IN_POSITION * (not moving)
            | SC_MOVING * moving
            | SC_HOMING * (self.homing and moving)
        )
        self.put(ENCODER, machine.counts)
        self.put(POSITION, machine.counts)

    def obey(self, touched: range) -> None:
        """Carry out the opcode, once."""
        if OPCODE not in touched:
            return
        opcode = self.words[OPCODE]
        if opcode == ENABLE:
            self.enabled = True
        elif opcode == DISABLE:
            self.enabled = False
        elif opcode in (STOP_HARD, STOP_SOFT):
            self.homing = False
            self.machine.stop()
        elif opcode == RESET:
            self.alarm = 0
        elif self.enabled and not self.alarm:
            self._drive(opcode)

    def _drive(self, opcode: int) -> None:
        speed_um_s = self.words[SPEED] * SPEED_UNIT_REV_S * COUNTS_PER_REV / self.machine.counts_per_um
        if opcode == FEED_TO_POSITION:
            self.machine.move_to(self.number(TARGET), speed_um_s)
        elif opcode == FEED_TO_LENGTH:
            self.machine.move_to(self.machine.counts + self.number(TARGET), speed_um_s)
        elif opcode == SEEK_HOME:
            self.homing = True
            self.machine.home()
