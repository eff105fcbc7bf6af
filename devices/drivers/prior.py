"""The focus drive of a Prior ProScan controller as a `devices.protocols.Stage`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from devices.drivers.polled import PolledStage, open_polled
from devices.errors import DeviceError, Refused, RigError
from devices.wire import prior

if TYPE_CHECKING:
    from devices.link import Link
    from devices.protocols import Clock
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec
    from devices.wire.exchange import Request

UNIT_TOLERANCE = 0.001
STEPS_OF_TOLERANCE = 1.0


class PriorStage(PolledStage):
    """Drives the focus in whole steps; the controller tells how long one is.

    Before each move the position is read. A controller that says 0 where it was left elsewhere was switched off and on,
    or zeroed at its own panel: its numbers mean other places now, and nothing moves before a `reconnect`.

    ``speed_um_s`` is not used: the controller knows its speed in percent of a fastest that it does not tell.
    """

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock) -> None:
        step_um = 1 / spec.units_per_um
        super().__init__(link, spec, clock, tolerance_um=STEPS_OF_TOLERANCE * step_um)
        self._step_um = -step_um if spec.invert else step_um
        self._left_at: int | None = None
        self._absolute = True

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._steps() * self._step_um

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis rests at its target, as `PolledStage.settle` does."""
        z_um = super().settle(timeout_s)
        self._left_at = round(z_um / self._step_um)
        return z_um

    def identity(self) -> str:
        """Return what the controller says it is."""
        return self._link.ask(prior.identity())

    def zero_here(self) -> None:
        """Call the present place 0 µm. The soft limits move with it: they are distances from zero."""
        self._target_um = self._left_at = None
        self._link.ask(prior.set_position(0))

    def set_speed_percent(self, percent: float) -> float:
        """Set the speed in percent of the fastest, 1 to 100, and return it as the controller tells it."""
        self._link.ask(prior.set_speed(percent))
        return self._link.ask(prior.speed())

    def _prepare(self) -> None:
        self._left_at = None
        self._link.ask(prior.standard_mode())
        told_um = self._link.ask(prior.resolution())
        if abs(abs(told_um) - abs(self._step_um)) > UNIT_TOLERANCE * abs(told_um):
            raise RigError(
                f"z stage: a step is {abs(told_um):g} µm, as the controller tells, and not {abs(self._step_um):g} µm.",
                fix=f"write units_per_um = {1 / abs(told_um):g}",
            )
        upwards = (told_um > 0) != self._spec.invert
        self._step_um = abs(told_um) if upwards else -abs(told_um)

    def _start(self, z_um: float) -> None:
        here, target = self._steps(), round(z_um / self._step_um)
        self._check_still_the_same(here)
        self._left_at = None
        if not self._absolute or not self._went(target):
            self._link.ask(prior.move_by(target - here))

    def _went(self, target: int) -> bool:
        """Start an absolute move; remember and tell when the firmware has none."""
        try:
            self._link.ask(prior.move(target))
        except Refused as refusal:
            if refusal.reason != prior.UNKNOWN_COMMAND:
                raise
            self._absolute = False
        return self._absolute

    def _check_still_the_same(self, here: int) -> None:
        if here == 0 and self._left_at is not None and abs(self._left_at) > STEPS_OF_TOLERANCE:
            raise DeviceError(
                f"z stage: position unknown: it was left at {self._left_at * self._step_um:+.2f} µm and says 0 now. "
                "Nothing moved.",
                why="The controller was switched off and on, or zeroed at its panel.",
                fix="find the specimen again, reconnect, and check the limits: they are distances from zero.",
                code="position-unknown",
            )

    def _steps(self) -> int:
        return self._link.ask(prior.position())

    def _moving(self) -> bool:
        return self._link.ask(prior.is_moving())

    def _halting(self) -> Request[Any]:
        return prior.halt()


def open_stage(table: AxisSpec, context: DeviceContext) -> PriorStage:
    """Open the port, identify the controller, and compare the length of its steps with the file.

    Raises
    ------
    RigError
        The steps have another length than ``units_per_um`` says.
    DeviceError
        As of `open_polled`.
    """
    fix = "set baud as on the controller: a ProScan is delivered with 9600."
    return open_polled(
        table, context, lambda link: PriorStage(link, table, context.clock), terminator=prior.TERMINATOR, fix=fix
    )
