"""The physical truth of a microtome: a feed that carries the specimen, a knife that takes some of it away.

Nothing is stepped: everything follows from the clock when it is looked at, so a look may come as late as it likes.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from devices.values import Limits
from sim.block import Block
from sim.motion import ENDLESS, Axis

if TYPE_CHECKING:
    from devices.protocols import Clock
    from sim.block import Face

RAMP_S = 0.02
AT_PLACE_UM = 1e-3
FOLLOWING_ERROR_S = 0.1
TOP_SPEED_UM_S = 5000.0
APPROACH_S = PARK_S = 0.05


class FeedMachine:
    """A feed axis with hard stops, which counts what it was really told to do.

    Parameters
    ----------
    clock : Clock
        Time.
    counts_per_um : float
        What its encoder counts.
    travel : Limits
        Where the limit switches are, from the home switch at 0 µm.
    position_um : float
        Where it stands when power comes on.
    block : Block, optional
        What it carries towards the knife.

    Attributes
    ----------
    feeds_executed : int
        Motions towards the knife that were begun; a repeated command counts again.
    moves_executed : int
        All motions to a target.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        counts_per_um: float = 500.0,
        travel: Limits = Limits(-50.0, 20_500.0),  # noqa: B008  frozen
        position_um: float = 137.0,
        block: Block | None = None,
    ) -> None:
        self.block = Block() if block is None else block
        self.clock = clock
        self.counts_per_um = counts_per_um
        self.travel = travel
        self.axis = Axis(clock, ENDLESS, position_um=position_um, speed_um_s=TOP_SPEED_UM_S, ramp_s=RAMP_S)
        self.feeds_executed = self.moves_executed = 0
        self.trip_at_um: float | None = None
        self._zero_um = position_um
        self._homing = False
        self._homed = False
        self._target_um = position_um

    @property
    def position_um(self) -> float:
        """Where it really is, from the home switch."""
        return self.axis.encoder_um()

    @property
    def removed_um(self) -> list[float]:
        """Thickness of what each stroke of the knife took away."""
        return self.block.removed_um

    @property
    def counts(self) -> int:
        """What its encoder says; counted from power-on until it was homed."""
        return round((self.axis.encoder_um() - self._zero_um) * self.counts_per_um)

    @property
    def homed(self) -> bool:
        """Whether it found its home switch since power-on."""
        if self._homing and not self.axis.moving():
            self._homing, self._homed, self._zero_um = False, True, 0.0
        return self._homed

    @property
    def moving(self) -> bool:
        """Whether the drive drives now."""
        return self.axis.moving()

    @property
    def following_error(self) -> bool:
        """Whether something holds it although it ought to have arrived."""
        move = self.axis.commanded
        late_s = self.clock.now() - move.start_s - move.path.duration_s
        return move.blocked and late_s > FOLLOWING_ERROR_S

    @property
    def at_switch(self) -> bool:
        """Whether it stands at a limit switch with more to go."""
        return not self.travel.min_um <= self._target_um <= self.travel.max_um and not self.moving

    @property
    def tripped(self) -> bool:
        """Whether it has passed the place at which its drive was made to fail; it brakes there."""
        if self.trip_at_um is None or self.axis.encoder_um() < self.trip_at_um - AT_PLACE_UM:
            return False
        self.trip_at_um = None
        self.axis.halt()
        return True

    def move_to(self, counts: int, speed_um_s: float) -> None:
        """Head for a place; it gets no further than the limit switches."""
        self.moves_executed += 1
        self.feeds_executed += counts > self.counts
        self._go(self._zero_um + counts / self.counts_per_um, speed_um_s)

    def home(self) -> None:
        """Search the home switch."""
        self._homing = True
        self._go(0.0, TOP_SPEED_UM_S)

    def zero_here(self) -> None:
        """Call this place 0."""
        self._zero_um, self._homed = self.axis.encoder_um(), True

    def jog(self, speed_um_s: float) -> None:
        """Run on towards a limit switch."""
        self._go(self.travel.max_um if speed_um_s > 0 else self.travel.min_um, abs(speed_um_s))

    def stop(self) -> None:
        """Brake to rest."""
        self._homing = False
        self.axis.halt()
        self._target_um = self.axis.encoder_um()

    def power_cycle(self) -> None:
        """Forget position and reference; the feed stays where it is."""
        self.stop()
        self._zero_um, self._homed = self.axis.encoder_um(), False

    def take_off(self, at_s: float) -> None:
        """Let the knife pass at a time of the clock: what stands above its plane is gone."""
        self.block.stroke(self.axis.load_um(at_s))

    def _go(self, target_um: float, speed_um_s: float) -> None:
        self._target_um = target_um
        self.axis.set_speed(speed_um_s)
        goal_um = min(max(target_um, self.travel.min_um), self.travel.max_um)
        if self.trip_at_um is not None and self.axis.encoder_um() < self.trip_at_um < goal_um:
            goal_um = self.trip_at_um  # it gets no further, even if nobody looks while it passes there
        self.axis.move_to(goal_um)


class Stroke(StrEnum):
    """Where the knife is."""

    CLEAR = "clear"
    CUTTING = "cutting"
    IN_WINDOW = "in window"
    PARKING = "parking"
    JAMMED = "jammed"


@dataclass
class Knife:
    """A knife that makes one stroke through its window and waits there to be parked.

    Attributes
    ----------
    strokes_begun, cuts_executed : int
        The truth about strokes.
    counter : int
        What its counting sensor says; stands still while ``counter_dead``.
    jam : bool
        The next stroke gets stuck half way.
    jam_holds : bool
        A stuck knife cannot be parked either.
    """

    clock: Clock
    machine: FeedMachine
    window_um: tuple[float, float] = (0.0, 0.0)
    speed_um_s: float = 0.0
    strokes_begun: int = 0
    cuts_executed: int = 0
    counter: int = 0
    counter_dead: bool = False
    jam: bool = False
    jam_holds: bool = False
    _state: Stroke = Stroke.CLEAR
    _ends_s: float = field(default=0.0)
    _looking: threading.Lock = field(default_factory=threading.Lock)

    @property
    def state(self) -> Stroke:
        """Where it is now; the controller and the camera look from threads of their own."""
        with self._looking:
            if self._state in (Stroke.CUTTING, Stroke.PARKING) and self.clock.now() >= self._ends_s:
                self._arrive()
            return self._state

    def cut(self) -> None:
        """Make one stroke; a knife that is not clear, or has no speed, does nothing."""
        if self.state is not Stroke.CLEAR or self.speed_um_s <= 0:
            return
        self.strokes_begun += 1
        stroke_s = abs(self.window_um[0] - self.window_um[1]) / self.speed_um_s
        self._begin(Stroke.CUTTING, APPROACH_S + stroke_s * (0.5 if self.jam else 1.0))

    def park(self) -> None:
        """Go out of the window."""
        if self.state is Stroke.JAMMED and self.jam_holds:
            return
        if self._state is not Stroke.CLEAR:
            self._begin(Stroke.PARKING, PARK_S)

    def stop(self) -> None:
        """Stand still where it is."""
        if self.state in (Stroke.CUTTING, Stroke.PARKING):
            self._state = Stroke.IN_WINDOW

    def _begin(self, state: Stroke, seconds: float) -> None:
        self._state, self._ends_s = state, self.clock.now() + seconds

    def _arrive(self) -> None:
        if self._state is Stroke.PARKING:
            self._state = Stroke.CLEAR
        elif self.jam:
            self._state = Stroke.JAMMED
        else:
            self._state = Stroke.IN_WINDOW
            self.cuts_executed += 1
            self.counter += not self.counter_dead
            self.machine.take_off(self._ends_s)


@dataclass(frozen=True)
class Microtome:
    """A feed with its block, and the knife: together they are the truth about what lies open."""

    machine: FeedMachine
    knife: Knife

    @property
    def face(self) -> Face:
        """What lies open now."""
        return self.machine.block.face

    @property
    def height_um(self) -> float:
        """How far the face stands above the plane in which the knife leaves faces; 0 as long as there was no cut."""
        surface_um = self.machine.block.surface_um
        return 0.0 if surface_um is None else self.machine.position_um - surface_um
