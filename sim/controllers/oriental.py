"""An Oriental Motor AZ driver: direct data operation in 32-bit pairs, inputs and outputs as bits of a word."""

from __future__ import annotations

from typing import ClassVar

from sim.controllers.registers import RegisterTwin

DIRECT, MODE, POSITION, SPEED, CURRENT, TRIGGER = 0x58, 0x5A, 0x5C, 0x5E, 0x64, 0x66
INPUT, OUTPUT, ALARM, COMMAND, FEEDBACK, ALARM_RESET = 0x7D, 0x7F, 0x80, 0xC6, 0xCC, 0x180
IN_HOME, IN_STOP, IN_JOG_PLUS, IN_JOG_MINUS = 0x0010, 0x0020, 0x1000, 0x2000
OUT_HOME_END, OUT_READY, OUT_ALARM, OUT_MOVE, OUT_IN_POSITION = 0x0010, 0x0020, 0x0080, 0x2000, 0x4000
JOG_UM_S = 20.0


class OrientalAz(RegisterTwin):
    """The driver; its registers are those of HM-60262."""

    PRESENT: ClassVar = frozenset(
        [*range(0x58, 0x68), 0x7C, INPUT, 0x7E, OUTPUT, 0x80, 0x81, *range(0xC6, 0xD2), 0x180, 0x181, 0x18A, 0x18B]
    )
    FOLLOWING, LIMIT, DRIVE = 0x10, 0x66, 0x20
    inputs = 0

    def is_move(self, address: int, values: list[int]) -> bool:
        """Tell whether this writes the trigger of a direct data operation."""
        return address <= TRIGGER + 1 < address + len(values) and values[TRIGGER + 1 - address] == 1

    def show(self) -> None:
        """Show outputs, alarm and positions."""
        machine = self.machine
        moving = machine.moving and not self.alarm
        self.words[OUTPUT] = (
            OUT_HOME_END * machine.homed
            | OUT_READY * (not moving and not self.alarm)
            | OUT_ALARM * bool(self.alarm)
            | OUT_MOVE * moving
            | OUT_IN_POSITION * (not moving)
        )
        self.put(ALARM, self.alarm)
        self.put(COMMAND, machine.counts)
        self.put(FEEDBACK, machine.counts)

    def obey(self, touched: range) -> None:
        """Move on the trigger; act on inputs that rise."""
        if TRIGGER + 1 in touched and self.number(TRIGGER) == 1:
            self.put(TRIGGER, 0)
            self._move()
        if ALARM_RESET + 1 in touched and self.number(ALARM_RESET) == 1:
            self.alarm = 0
        if INPUT in touched:
            risen, fallen = self.words[INPUT] & ~self.inputs, self.inputs & ~self.words[INPUT]
            self.inputs = self.words[INPUT]
            self._act(risen, fallen)

    def _move(self) -> None:
        if not self.alarm and self.number(MODE) == 1:
            self.machine.move_to(self.number(POSITION), self.number(SPEED) / self.machine.counts_per_um)

    def _act(self, risen: int, fallen: int) -> None:
        if risen & IN_STOP or fallen & (IN_JOG_PLUS | IN_JOG_MINUS):
            self.machine.stop()
        elif self.alarm:
            return
        elif risen & IN_HOME:
            self.machine.home()
        elif risen & (IN_JOG_PLUS | IN_JOG_MINUS):
            self.machine.jog(JOG_UM_S if risen & IN_JOG_PLUS else -JOG_UM_S)
