"""The Z axis of an ASI MS-2000 or Tiger controller as a `devices.protocols.Stage`."""

from __future__ import annotations

import logging
from threading import Event
from typing import TYPE_CHECKING

from devices.drivers.arrival import Arrival
from devices.errors import LinkError, Refused, StageStalled, StageTimeout
from devices.values import Limits
from devices.wire import asi
from devices.wire.asi_identity import MS2000

if TYPE_CHECKING:
    from devices.link import Link
    from devices.protocols import Clock
    from devices.rig import AxisSpec
    from devices.wire.asi_identity import Card

log = logging.getLogger(__name__)

UM_PER_MM = 1000.0
FAST_BAUD = 57600
FAST_POLL_S = 0.004
SLOW_POLL_S = 0.02  # at 9600 baud one question and answer take 15 ms of wire, and an FTDI adapter adds as much
TOLD_LIMITS_UM = 1.0  # the controller tells its limits in whole µm
TOLD_SPEED = 0.01


class AsiStage:
    """Drives one axis; every method may be called from any thread, one conversation at a time.

    Parameters
    ----------
    link : Link
        To the controller.
    spec : AxisSpec
        ``[stage.z]`` of the instrument file.
    clock : Clock
        Time.
    card : Card
        Where Z is driven; an MS-2000 has but one.
    """

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock, card: Card = MS2000) -> None:
        self._link = link
        self._card = card
        self._clock = clock
        self._spec = spec
        self._units_per_um = self._side * spec.units_per_um
        self._limits = spec.soft_limits
        self._target_um: float | None = None
        self._halted = Event()

    @property
    def limits(self) -> Limits:
        """Soft limits in µm: the instrument file's, and the controller's own where these are narrower."""
        return self._limits

    def move_to(self, z_um: float) -> None:
        """Start an absolute move; raises `LimitError` with nothing sent."""
        self.limits.check(z_um)
        self._set_off(z_um)
        self._link.ask(asi.move(z_um * self._units_per_um))

    def move_by(self, distance_um: float) -> None:
        """Start a relative move from where the axis is; it is sent once only."""
        target_um = self.position_um() + distance_um
        self.limits.check(target_um)
        self._set_off(target_um)
        self._link.ask(asi.move_by(distance_um * self._units_per_um))

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis rests at its target, then for ``settle_ms``, and return the position read last.

        Rest is the arrival rule of `Arrival`; without a move before, any place will do. A halted move never arrives.

        Raises
        ------
        StageStalled
            No progress for 1 s, or halted.
        StageTimeout
            Still moving after ``timeout_s``.
        """
        arrival = Arrival(self._target_um, tolerance_um=self._resolution_um, now=self._clock.now())
        deadline = self._clock.now() + timeout_s
        while True:
            moving, z_um = self._link.ask(asi.is_moving()), self.position_um()
            now = self._clock.now()
            if arrival.reached(z_um, now, moving=moving):
                return self._rested(z_um)
            self._check_under_way(arrival, z_um, now, deadline, timeout_s)
            self._clock.sleep(arrival.wait_s(now, self._poll_s))

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._link.ask(asi.where()) / self._units_per_um

    def halt(self) -> None:
        """Stop all axes of the controller; goes out at once, whatever another thread is waiting for."""
        self._halted.set()
        self._link.interrupt(asi.halt(self._card.halt))

    def close(self) -> None:
        """Release the port; the axis stays where it is."""
        self._link.close()

    def zero_here(self) -> None:
        """Call the present place 0 µm. The soft limits move with it: they are distances from zero."""
        self._target_um = None
        self._link.ask(asi.here(0.0))
        self.heed_controller_limits()

    def set_speed_um_s(self, speed_um_s: float) -> float:
        """Set the top speed and return what the controller made of it: it clips without a word."""
        self._link.ask(asi.set_speed(speed_um_s / UM_PER_MM))
        made_um_s = self._link.ask(asi.speed()) * UM_PER_MM
        if abs(made_um_s - speed_um_s) > TOLD_SPEED * speed_um_s:
            log.warning("z stage: asked for %g µm/s, the controller takes %g µm/s.", speed_um_s, made_um_s)
        return made_um_s

    def hand_controls(self, *, enabled: bool) -> None:
        """Let the joystick move the axis, or not; firmware that cannot is left alone."""
        try:
            self._link.ask(asi.joystick(enabled=enabled))
        except Refused as refusal:
            log.info("z stage: the joystick stays as it is. %s", refusal.what)

    def heed_controller_limits(self) -> Limits:
        """Read the controller's own limits and keep inside them too; return the limits that hold now.

        They are told from the controller's zero, in mm; firmware that cannot tell them is left to its own.
        """
        rig = self._spec.soft_limits
        try:
            edges_um = sorted(self._side * self._link.ask(edge) * UM_PER_MM for edge in asi.limits())
        except Refused:
            return rig
        lower_um, upper_um = edges_um[0] - TOLD_LIMITS_UM, edges_um[1] + TOLD_LIMITS_UM
        self._limits = Limits(max(rig.min_um, lower_um), min(rig.max_um, upper_um))
        if self._limits != rig:
            log.warning("z stage: the controller's own limits, %g … %g µm, are narrower than the file's.", *edges_um)
        return self._limits

    def controller_backlash_um(self) -> float:
        """Return how far the controller itself goes beyond a target to take up backlash."""
        return self._link.ask(asi.backlash()) * UM_PER_MM

    def firmware(self) -> str:
        """Return the firmware's name."""
        return self._link.ask(asi.version())

    @property
    def _side(self) -> int:
        return -1 if self._spec.invert else 1

    @property
    def _resolution_um(self) -> float:
        return 1.0 / self._spec.units_per_um

    @property
    def _poll_s(self) -> float:
        return FAST_POLL_S if self._spec.baud >= FAST_BAUD else SLOW_POLL_S

    def _set_off(self, target_um: float) -> None:
        self._halted.clear()
        self._target_um = target_um

    def _rested(self, z_um: float) -> float:
        if not self._spec.settle_ms:
            return z_um
        self._clock.sleep(self._spec.settle_ms / 1000)
        return self.position_um()

    def _check_under_way(self, arrival: Arrival, z_um: float, now: float, deadline: float, timeout_s: float) -> None:
        where = f"it is at {z_um:+.2f} µm" + (f" of {self._target_um:+.2f} µm" if self._target_um is not None else "")
        if self._halted.is_set():
            raise StageStalled(f"z stage: the move was halted; {where}.")
        if arrival.stalled(now):
            raise StageStalled(
                f"z stage: no progress for {arrival.STALL_S:g} s; {where}.",
                why=self._limit_met() or "The axis is blocked, or was moved by hand.",
                fix="free the axis, check the controller's limits (SL, SU), then start again.",
            )
        if now > deadline:
            raise StageTimeout(f"z stage: still moving after {timeout_s:g} s; {where}.")

    def _limit_met(self) -> str:
        try:
            return asi.limits_met(self._link.ask(asi.status_byte()))
        except (LinkError, Refused):
            return ""
