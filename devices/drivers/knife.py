"""A knife behind registers: settings read back before each stroke, a stroke that is never repeated, a way out."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from devices.errors import DeviceError, LinkError, LinkLost, Refused, Unsafe
from devices.feed_errors import FeedHalted, KnifeFailed, not_executed, undecided
from devices.feed_values import KnifeState

if TYPE_CHECKING:
    from threading import Event

    from devices.drivers.registers import Registers
    from devices.feed_spec import KnifeSpec
    from devices.profile import KnifeTable
    from devices.protocols import Clock
    from devices.transport.modbus import Addressed

NM_PER_UM = 1000


class Knife:
    """The stroke and its sensors.

    Parameters
    ----------
    registers : Registers
        Of the controller that drives the knife.
    table : KnifeTable
        Its part of the profile.
    spec : KnifeSpec
        Window, speed, and how long a stroke may take.
    halted : Event
        Set when everything is to stop.
    """

    POLL_S: ClassVar = 0.02
    PARK_S: ClassVar = 10.0
    START_S: ClassVar = 0.5

    def __init__(self, registers: Registers, table: KnifeTable, spec: KnifeSpec, clock: Clock, halted: Event) -> None:
        self._registers = registers
        self._table = table
        self._spec = spec
        self._clock = clock
        self._halted = halted

    def state(self) -> KnifeState:
        """Read the sensors."""
        seen: dict[str, int] = {}
        for bit, state in (
            (self._table.jammed, KnifeState.JAMMED),
            (self._table.cutting, KnifeState.CUTTING),
            (self._table.clear, KnifeState.CLEAR),
        ):
            if self._registers.test(bit, seen):
                return state
        return KnifeState.IN_WINDOW

    def count(self) -> int:
        """Read the counter of strokes."""
        return self._registers.number(self._table.count)

    def check_clear(self) -> None:
        """Raise `Unsafe` unless the knife is clear."""
        state = self.state()
        if state is not KnifeState.CLEAR:
            raise Unsafe(
                f"knife: it is {state}, not clear. Nothing was sent.",
                fix="bring it out first: stereotome section retract --knife",
                code="knife-not-clear",
            )

    def set_stroke(self) -> None:
        """Write window and speed and read them back; raises `KnifeFailed` when the controller kept others."""
        start_um, end_um = self._spec.window_um
        wanted = {"window_start": start_um, "window_end": end_um, "cut_speed": self._spec.speed_um_s}
        for name, value_um in wanted.items():
            register, value = getattr(self._table, name), round(value_um * NM_PER_UM)
            self._registers.put(register, value)
            kept = self._registers.number(register)
            if kept != value:
                raise KnifeFailed(
                    f"knife: {name} is {kept} after {value} was written. Nothing was cut.",
                    why="The controller limits it, or another program writes it.",
                    fix="choose a value the controller takes, and end other programs.",
                )

    def cut(self) -> None:
        """Make one stroke and wait for its end; it is sent once, and counter and sensors say what became of it.

        Raises
        ------
        DeviceError
            feed-not-executed: the knife never left its place.
        FeedUndecided
            The stroke may or may not have cut.
        KnifeFailed
            It is stuck, or not back from its stroke in time.
        FeedHalted
            A halt came: before the stroke, and nothing was cut, or on its way.
        """
        self._halted.clear()  # of an earlier motion: what is halted from now on is this stroke
        before = self.count()
        if self._halted.is_set():
            raise FeedHalted("knife: a halt came before the stroke. Nothing was cut.", fix="give the command again.")
        doubt = self._begin()
        try:
            left = self._watch()
            counted = self.count() - before
        except LinkLost:
            raise
        except LinkError as error:
            raise undecided("a cut was sent", error) from error
        if counted == 1:
            return
        if not left and counted == 0:
            raise not_executed("the cut", doubt or DeviceError("The knife did not leave its place."))
        raise undecided(
            "a cut was sent", DeviceError(f"The knife moved, but its counter went from {before} to {before + counted}.")
        )

    def park(self) -> None:
        """Bring the knife out of the window; raises `KnifeFailed` when it does not get there."""
        if self.state() is KnifeState.CLEAR:
            return
        try:
            self._registers.do(self._table.park)
        except LinkLost:
            raise
        except LinkError:
            pass  # parking twice is parking; the sensor says whether it came
        deadline = self._clock.now() + self.PARK_S
        while self.state() is not KnifeState.CLEAR:
            if self._clock.now() > deadline:
                raise KnifeFailed(
                    f"knife: not clear {self.PARK_S:g} s after it was told to; it is {self.state()}.",
                    fix="switch the knife off and free it by hand. The feed stays locked until it is clear.",
                )
            self._clock.sleep(self.POLL_S)

    def stop_writes(self) -> list[Addressed]:
        """Return what stops it."""
        return self._registers.urgently(self._table.stop)

    def _begin(self) -> DeviceError | None:
        try:
            self._registers.do(self._table.cut)
        except LinkLost:
            raise
        except (LinkError, Refused) as error:
            return error
        return None

    def _watch(self) -> bool:
        """Wait for the end of a stroke and tell whether the knife left its place at all."""
        start_um, end_um = self._spec.window_um
        began = self._clock.now()
        deadline = began + abs(start_um - end_um) / self._spec.speed_um_s + self._spec.grace_s
        while True:
            state, now = self.state(), self._clock.now()
            self._check_stroke(state, late=now > deadline)
            if state is KnifeState.IN_WINDOW:
                return True
            if state is KnifeState.CLEAR and now - began > self.START_S:
                return False
            self._clock.sleep(self.POLL_S)

    def _check_stroke(self, state: KnifeState, *, late: bool) -> None:
        if self._halted.is_set():
            raise FeedHalted(f"knife: halted; it is {state}.", fix="bring it out: stereotome section retract --knife")
        if state is KnifeState.JAMMED or late:
            raise KnifeFailed(
                f"knife: {'it is stuck in the specimen' if state is KnifeState.JAMMED else 'its stroke does not end'}.",
                fix="look at the knife; the feed stays where it is.",
            )
