"""The Z axis of an ASI MS-2000 or Tiger controller as a `devices.protocols.Stage`."""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import TYPE_CHECKING

from devices.drivers.polled import PolledStage
from devices.errors import LinkError, Refused
from devices.values import Limits
from devices.wire import asi
from devices.wire.asi_identity import MS2000

if TYPE_CHECKING:
    from devices.link import Link
    from devices.protocols import Clock
    from devices.rig import AxisSpec
    from devices.wire.asi_identity import Card
    from devices.wire.exchange import Request

log = logging.getLogger(__name__)

UM_PER_MM = 1000.0
TOLD_LIMITS_UM = 1.0  # the controller tells its limits in whole µm
TOLD_SPEED = 0.01


class AsiStage(PolledStage):
    """Drives one axis; see `PolledStage`.

    Parameters
    ----------
    link, spec, clock
        As of `PolledStage`.
    card : Card
        Where Z is driven; an MS-2000 has but one.
    """

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock, card: Card = MS2000) -> None:
        super().__init__(link, spec, clock, tolerance_um=1.0 / spec.units_per_um)
        self._card = card
        self._units_per_um = self._side * spec.units_per_um
        self._limits = spec.soft_limits

    @property
    def limits(self) -> Limits:
        """Soft limits in µm: the instrument file's, and the controller's own where these are narrower."""
        return self._limits

    def move_by(self, distance_um: float) -> None:
        """Start a relative move from where the axis is; it is sent once only."""
        target_um = self.position_um() + distance_um
        self.limits.check(target_um)
        self._halted.clear()
        self._target_um = target_um
        self._link.ask(asi.move_by(distance_um * self._units_per_um))

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._link.ask(asi.where()) / self._units_per_um

    def identity(self) -> str:
        """Return the firmware's name."""
        return self._link.ask(asi.version())

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

    @property
    def _side(self) -> int:
        return -1 if self._spec.invert else 1

    def _prepare(self) -> None:
        self.heed_controller_limits()
        if self._spec.speed_um_s is not None:
            self.set_speed_um_s(self._spec.speed_um_s)
        with suppress(Refused):
            log.info("z stage: the controller itself takes up %g µm of backlash.", self.controller_backlash_um())

    def _start(self, z_um: float) -> None:
        self._link.ask(asi.move(z_um * self._units_per_um))

    def _moving(self) -> bool:
        return self._link.ask(asi.is_moving())

    def _halting(self) -> Request[None]:
        return asi.halt(self._card.halt)

    def _why_stalled(self) -> str:
        return self._limit_met() or super()._why_stalled()

    def _limit_met(self) -> str:
        try:
            return asi.limits_met(self._link.ask(asi.status_byte()))
        except (LinkError, Refused):
            return ""
