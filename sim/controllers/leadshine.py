"""A Leadshine RS stepper drive (CS2RS): one frame moves it, and its "path done" stays set until the next start."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from sim.controllers.registers import RegisterTwin

if TYPE_CHECKING:
    from sim.controllers.registers import WordOrder
    from sim.feed import FeedMachine

PULSES, FORCE_ENABLE, STATUS, FEEDBACK, CONTROL, ALARM = 0x0000, 0x000F, 0x1003, 0x1014, 0x1801, 0x2203
PATH_CONTROL, TRIGGER, LIMIT_PLUS, LIMIT_MINUS, PROFILE_POSITION, PATH0 = (
    *(0x6000, 0x6002, 0x6006, 0x6008, 0x602C, 0x6200),
)
MODE, SPEED, GO = PATH0, PATH0 + 3, PATH0 + 7
RUN, HOME, ZERO, STOP = 0x10, 0x20, 0x21, 0x40
RESET, JOG_PLUS, JOG_MINUS = 0x1111, 0x4001, 0x4002
SOFT_LIMITS = 0x02
JOG_KEEPS_S = 0.05
JOG_UM_S = 20.0
SECONDS_PER_MINUTE = 60
FAULT, ENABLED, RUNNING, COMMAND_DONE, PATH_DONE, HOMED = 0x01, 0x02, 0x04, 0x10, 0x20, 0x40


class LeadshineRs(RegisterTwin):
    """The drive; its registers are those of the CS2RS manual."""

    PRESENT: ClassVar = frozenset(
        [
            *(0x0000, 0x0001, 0x0003, 0x0007, 0x000B, FORCE_ENABLE, 0x0191, STATUS, FEEDBACK, FEEDBACK + 1),
            *(0x1046, 0x1047, CONTROL, 0x1901, ALARM, PATH_CONTROL, TRIGGER, *range(0x6006, 0x6014)),
            *(PROFILE_POSITION, PROFILE_POSITION + 1, *range(PATH0, PATH0 + 0x40)),
        ]
    )
    POWER_ON: ClassVar = {0x0003: 2, FORCE_ENABLE: 1}
    FOLLOWING, LIMIT, DRIVE = 0x180, 0x210, 0xE0

    def __init__(self, machine: FeedMachine, word_order: WordOrder = "big") -> None:
        super().__init__(machine, word_order)
        self._jogged_s: float | None = None
        self.put(PULSES, 10_000)

    def power_cycle(self) -> None:
        """Forget everything; the pulses of a turn are kept in the drive."""
        super().power_cycle()
        self.put(PULSES, 10_000)

    def is_move(self, address: int, values: list[int]) -> bool:
        """Tell whether this is a path with its trigger, or the trigger alone."""
        return (address == PATH0 and len(values) == 8 and values[7] == RUN) or (address, values) == (TRIGGER, [RUN])

    def show(self) -> None:
        """Show status, positions and alarm."""
        self._let_go_of_jog()
        machine = self.machine
        running = machine.moving and not self.alarm
        self.words[STATUS] = (
            FAULT * bool(self.alarm)
            | ENABLED * (self.words[FORCE_ENABLE] & 1)
            | RUNNING * running
            | (COMMAND_DONE | PATH_DONE) * (not running)
            | HOMED * machine.homed
        )
        self.words[ALARM] = self.alarm
        self.put(FEEDBACK, machine.counts)
        self.put(PROFILE_POSITION, machine.counts)

    def obey(self, touched: range) -> None:
        """Start paths, home, stop, jog, reset."""
        if GO in touched and self.words[GO] == RUN:
            self._run_path()
        if TRIGGER in touched:
            self._trigger(self.words[TRIGGER])
        if CONTROL in touched:
            self._control(self.words[CONTROL])

    def _trigger(self, code: int) -> None:
        if code == STOP:
            self.machine.stop()
        elif code == HOME and not self.alarm:
            self.machine.home()
        elif code == ZERO:
            self.machine.zero_here()
        elif code == RUN:
            self._run_path()

    def _control(self, code: int) -> None:
        if code == RESET:
            self.alarm = 0
        elif code in (JOG_PLUS, JOG_MINUS) and not self.alarm:
            if self._jogged_s is None:
                self.machine.jog(JOG_UM_S if code == JOG_PLUS else -JOG_UM_S)
            self._jogged_s = self.machine.clock.now()

    def _run_path(self) -> None:
        self.words[GO] = 0
        if self.alarm or not self.words[FORCE_ENABLE] or self.words[MODE] != 1:
            return
        counts_per_s = self.words[SPEED] / SECONDS_PER_MINUTE * self._pulses_per_turn
        high, low = self.words[PATH0 + 1], self.words[PATH0 + 2]
        if self.word_order == "little":
            high, low = low, high
        target = (high << 16 | low) - (high >> 15 << 32)
        if self.words[PATH_CONTROL] & SOFT_LIMITS:
            target = min(max(target, self.number(LIMIT_MINUS)), self.number(LIMIT_PLUS))
        self.machine.move_to(target, counts_per_s / self.machine.counts_per_um)

    @property
    def _pulses_per_turn(self) -> int:
        return self.number(PULSES)

    def _let_go_of_jog(self) -> None:
        """Stop a jog that was not called for again for 50 ms."""
        if self._jogged_s is not None and self.machine.clock.now() - self._jogged_s > JOG_KEEPS_S:
            self._jogged_s = None
            self.machine.stop()
