"""How an axis moves: a trapezoid of speed, lost motion in the screw, a little ringing at the end.

Everything is a closed function of time. Nothing is stepped, so nothing depends on how often it is asked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from devices.values import Limits

if TYPE_CHECKING:
    from devices.protocols import Clock

ENDLESS = Limits(-math.inf, math.inf)
REMEMBERED_MOVES = 256
PATH_SAMPLES = 17


@dataclass(frozen=True)
class Ringing:
    """Vibration left by the end of a move: amplitude deceleration/ω², decaying exponentially.

    Attributes
    ----------
    decay_s : float
        Time in which the amplitude falls to 1/e; 0 for mechanics that do not ring.
    frequency_hz : float
        Of the mechanics.
    """

    decay_s: float = 0.0
    frequency_hz: float = 100.0

    @property
    def lasts_s(self) -> float:
        """Return when it counts as over: after five times its decay, with 0.7 % of its amplitude left."""
        return 5 * self.decay_s

    def offset_um(self, acceleration_um_s2: float, since_s: float) -> float:
        """Return the displacement ``since_s`` after the end of a motion with this signed acceleration."""
        if not 0 < since_s < self.lasts_s:
            return 0.0
        omega = 2 * math.pi * self.frequency_hz
        return acceleration_um_s2 / omega**2 * math.exp(-since_s / self.decay_s) * math.sin(omega * since_s)


@dataclass(frozen=True)
class Trapezoid:
    """Motion from a position and velocity to rest at a target: get to the peak speed, cruise, brake.

    A first velocity away from the target, or too high to stop before it, is taken up by the same three phases: they
    head for the target as seen from where the axis would come to rest if it were braked at once.
    """

    start_um: float
    start_um_s: float
    target_um: float
    speed_um_s: float
    acceleration_um_s2: float
    heading: float = field(init=False)
    peak_um_s: float = field(init=False)
    phases_s: tuple[float, float, float] = field(init=False)

    def __post_init__(self) -> None:
        rate = self.acceleration_um_s2
        heading = math.copysign(1.0, self.target_um - self.braked_um)
        first = heading * self.start_um_s
        way_um = heading * (self.target_um - self.start_um)
        peak = min(self.speed_um_s, math.sqrt(max(rate * way_um + first**2 / 2, 0.0)))
        run_up_s, brake_s = abs(peak - first) / rate, peak / rate
        cruise_um = max(way_um - (first + peak) / 2 * run_up_s - peak / 2 * brake_s, 0.0)
        object.__setattr__(self, "heading", heading)
        object.__setattr__(self, "peak_um_s", peak)
        object.__setattr__(self, "phases_s", (run_up_s, cruise_um / peak if peak else 0.0, brake_s))

    @property
    def braked_um(self) -> float:
        """Return where the axis comes to rest when braked from the start."""
        return self.start_um + self.start_um_s * abs(self.start_um_s) / (2 * self.acceleration_um_s2)

    @property
    def duration_s(self) -> float:
        """Return the time from the start to rest."""
        return sum(self.phases_s)

    @property
    def turns_s(self) -> float:
        """Return when the axis turns round, 0 when it never goes the wrong way."""
        return max(-self.heading * self.start_um_s, 0.0) / self.acceleration_um_s2

    def state(self, elapsed_s: float) -> tuple[float, float]:
        """Return position in µm and velocity in µm/s at a time after the start."""
        run_up_s, cruise_s, brake_s = self.phases_s
        first, peak = self.heading * self.start_um_s, self.peak_um_s
        rate = math.copysign(self.acceleration_um_s2, peak - first)
        if elapsed_s >= self.duration_s:
            return self.target_um, 0.0
        t1 = min(max(elapsed_s, 0.0), run_up_s)
        t2 = min(max(elapsed_s - run_up_s, 0.0), cruise_s)
        t3 = min(max(elapsed_s - run_up_s - cruise_s, 0.0), brake_s)
        gone = (first + rate * t1 / 2) * t1 + peak * t2 + (peak - self.acceleration_um_s2 * t3 / 2) * t3
        return self.start_um + self.heading * gone, self.heading * (first + rate * t1 - self.acceleration_um_s2 * t3)


def play(carried_um: float, motor_um: float, backlash_um: float) -> float:
    """Return where a load with lost motion lies after its motor went straight to ``motor_um``.

    Pushed upwards the load stands at the motor; pulled downwards it trails ``backlash_um`` above it.
    """
    return min(max(carried_um, motor_um), motor_um + backlash_um)


@dataclass(frozen=True)
class Move:
    """One commanded motion of an axis, from its start until the next one begins.

    Attributes
    ----------
    start_s : float
        Time of the clock at which it begins.
    path : Trapezoid
        What the motor would do, were nothing in its way.
    load_um : float
        Where the load was at the start.
    backlash_um : float
        Lost motion between motor and load.
    travel : Limits
        Hard stops: motor and load get stuck there, and the controller drives on.
    """

    start_s: float
    path: Trapezoid
    load_um: float
    backlash_um: float
    ringing: Ringing
    travel: Limits = ENDLESS

    @property
    def blocked(self) -> bool:
        """Tell whether the target lies beyond a hard stop."""
        return not self.travel.min_um <= self.path.target_um <= self.travel.max_um

    def under_way(self, now_s: float) -> bool:
        """Tell whether the controller still drives; a stuck axis is driven for ever."""
        return self.blocked or now_s < self.start_s + self.path.duration_s

    def at_rest(self, now_s: float) -> bool:
        """Tell whether the load neither moves nor rings any more."""
        return now_s >= self.start_s + self.path.duration_s + self.ringing.lasts_s

    def motor(self, now_s: float) -> tuple[float, float]:
        """Return position in µm and velocity in µm/s of the motor."""
        position_um, velocity_um_s = self.path.state(now_s - self.start_s)
        possible_um = min(max(position_um, self.travel.min_um), self.travel.max_um)
        return (position_um, velocity_um_s) if possible_um == position_um else (possible_um, 0.0)

    def load(self, now_s: float) -> float:
        """Return the true position in µm of what the motor carries."""
        turn_s = self.start_s + self.path.turns_s
        turned_um = play(self.load_um, self.motor(min(now_s, turn_s))[0], self.backlash_um)
        carried_um = play(turned_um, self.motor(now_s)[0], self.backlash_um)
        return carried_um + self._ringing_um(now_s)

    def _ringing_um(self, now_s: float) -> float:
        moved = self.path.duration_s > 0 and not self.blocked
        deceleration = -self.path.heading * self.path.acceleration_um_s2
        return self.ringing.offset_um(deceleration, now_s - self.start_s - self.path.duration_s) if moved else 0.0


class Axis:
    """The one axis behind everything: the wire-level twin moves it, the camera looks through it.

    Moves may be commanded by one thread while others look: a look sees the moves up to now, each complete.

    Parameters
    ----------
    clock : Clock
        Time.
    limits : Limits
        Soft limits in µm: targets beyond are cut to them.
    position_um : float
        Where it stands.
    speed_um_s : float
        Top speed, also the first speed.
    ramp_s : float
        Time to reach the speed from rest.
    backlash_um : float
        Lost motion between the motor, whose encoder is read, and the load, which is seen.
    """

    def __init__(
        self,
        clock: Clock,
        limits: Limits,
        *,
        position_um: float = 0.0,
        speed_um_s: float = 2000.0,
        ramp_s: float = 0.07,
        backlash_um: float = 0.0,
        ringing: Ringing | None = None,
    ) -> None:
        self.clock = clock
        self.limits = limits
        self.top_speed_um_s = speed_um_s
        self.speed_um_s = speed_um_s
        self.ramp_s = ramp_s
        self.backlash_um = backlash_um
        self.travel = ENDLESS
        self._ringing = ringing or Ringing()
        at_rest = Trapezoid(position_um, 0.0, position_um, speed_um_s, speed_um_s / ramp_s)
        self._moves: tuple[Move, ...] = (Move(-math.inf, at_rest, position_um, 0.0, self._ringing),)

    def move_to(self, target_um: float) -> None:
        """Head for a target, from whatever the axis is doing."""
        motor_um, velocity_um_s = self._motor()
        inside_um = min(max(target_um, self.limits.min_um), self.limits.max_um)
        self._set_off(Trapezoid(motor_um, velocity_um_s, inside_um, self.speed_um_s, self._acceleration))

    def halt(self) -> None:
        """Brake to rest."""
        motor_um, velocity_um_s = self._motor()
        brake = Trapezoid(motor_um, velocity_um_s, motor_um, self.speed_um_s, self._acceleration)
        self._set_off(Trapezoid(motor_um, velocity_um_s, brake.braked_um, self.speed_um_s, self._acceleration))

    def obstruct(self, z_um: float) -> None:
        """Put something in the way at ``z_um``, on the side it lies from here."""
        here_um = self.encoder_um()
        self.travel = Limits(-math.inf, z_um) if z_um > here_um else Limits(z_um, math.inf)

    def set_speed(self, speed_um_s: float) -> None:
        """Set the speed of later moves; a value out of range is clipped, and nothing said."""
        self.speed_um_s = min(max(speed_um_s, 1.0), self.top_speed_um_s)

    def encoder_um(self) -> float:
        """Return the motor's position now: what a controller can read."""
        return self._motor()[0]

    def moving(self) -> bool:
        """Tell whether the controller is driving now."""
        return self._moves[-1].under_way(self.clock.now())

    def ramp(self) -> int:
        """Return 1 while the controller speeds the axis up, -1 while it brakes, else 0."""
        move = self._moves[-1]
        run_up_s, cruise_s, brake_s = move.path.phases_s
        elapsed_s = self.clock.now() - move.start_s
        return int(elapsed_s < run_up_s) - int(0 < elapsed_s - run_up_s - cruise_s < brake_s)

    @property
    def rests_at_s(self) -> float:
        """Return when the newest move has ended and rung out."""
        move = self._moves[-1]
        return move.start_s + move.path.duration_s + self._ringing.lasts_s

    def load_um(self, at_s: float) -> float:
        """Return the true position at a time of the clock, past or, if nothing else is commanded, to come."""
        return self._move_at(at_s).load(at_s)

    @property
    def commanded(self) -> Move:
        """The newest move: as long as it stays the same, what `path_um` told of times to come holds."""
        return self._moves[-1]

    def path_um(self, start_s: float, end_s: float) -> np.ndarray:
        """Return the true positions between two times, equal steps of time, float64.

        One position for an axis at rest.
        """
        move = self._move_at(end_s)
        if move.start_s <= start_s and move.at_rest(start_s):
            return np.array([move.load(start_s)])
        middles_s = start_s + (np.arange(PATH_SAMPLES) + 0.5) * (end_s - start_s) / PATH_SAMPLES
        return np.array([self.load_um(at_s) for at_s in middles_s])

    def _motor(self) -> tuple[float, float]:
        return self._moves[-1].motor(self.clock.now())

    @property
    def _acceleration(self) -> float:
        return self.speed_um_s / self.ramp_s

    def _move_at(self, at_s: float) -> Move:
        return next((move for move in reversed(self._moves) if move.start_s <= at_s), self._moves[0])

    def _set_off(self, path: Trapezoid) -> None:
        now_s = self.clock.now()
        load_um = play(self.load_um(now_s), path.start_um, self.backlash_um)
        move = Move(now_s, path, load_um, self.backlash_um, self._ringing, self.travel)
        self._moves = (*self._moves[1 - REMEMBERED_MOVES :], move)
