"""One axis of a PI controller that speaks GCS 2.0 as a `devices.protocols.Stage`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from devices.drivers.polled import PolledStage, open_polled
from devices.errors import DeviceError, NoReply, RigError, StageStalled
from devices.wire import pi_gcs

if TYPE_CHECKING:
    from devices.link import Link
    from devices.protocols import Clock
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec
    from devices.wire.exchange import Request

TOLERANCE_UM = 0.1  # the controller itself decides, by its window, whether the axis is on target
ROUNDING_UM = 0.001
REFERENCE_S = 120.0  # slow motors search the length of their travel


class PiStage(PolledStage):
    """Drives one axis in closed loop. ``units_per_um`` is 1 for controllers that count µm, 0.001 for mm.

    Arrived is what the controller calls on target, which it says once the axis has settled, and not before.

    Parameters
    ----------
    may_reference : bool
        An axis without reference searches it upon the first `greet`, and never again: not in the middle of a run.
    """

    counts_from_power_on = False  # it counts from its reference or sensor, and tells when it has none

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock, *, may_reference: bool = False) -> None:
        super().__init__(link, spec, clock, tolerance_um=TOLERANCE_UM)
        self._may_reference = may_reference
        self._axis = spec.axis or "1"
        self._units_per_um = -spec.units_per_um if spec.invert else spec.units_per_um

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._link.ask(pi_gcs.position(self._axis)) / self._units_per_um

    def identity(self) -> str:
        """Return what the controller says it is."""
        return self._link.ask(pi_gcs.identity())

    def set_speed_um_s(self, speed_um_s: float) -> float:
        """Set the speed of later moves and return it as the controller tells it; out of range is refused."""
        self._link.ask(pi_gcs.set_speed(self._axis, speed_um_s * self._spec.units_per_um))
        return self._link.ask(pi_gcs.speed(self._axis)) / self._spec.units_per_um

    def _prepare(self) -> None:
        self._axis = self._only_axis()
        self._link.ask(pi_gcs.error())  # what others left behind
        may_reference, self._may_reference = self._may_reference, False
        referenced = self._is_referenced()
        if not (referenced or may_reference):
            raise _not_referenced()
        self._check_travel()
        self._link.ask(pi_gcs.set_servo(self._axis, on=True))
        if not referenced:
            self._reference()
        if self._spec.speed_um_s is not None:
            self.set_speed_um_s(self._spec.speed_um_s)

    def _start(self, z_um: float) -> None:
        self._link.ask(pi_gcs.move(self._axis, z_um * self._units_per_um))

    def _moving(self) -> bool:
        return not self._link.ask(pi_gcs.on_target(self._axis))

    def _halting(self) -> Request[Any]:
        return pi_gcs.halt()

    def _why_stalled(self) -> str:
        """Return the error the controller keeps, which tells more than that nothing moves."""
        code = self._link.ask(pi_gcs.error())
        return f"The controller says: {pi_gcs.ERRORS.get(code, 'error')} ({code})." if code else super()._why_stalled()

    def _only_axis(self) -> str:
        there = self._link.ask(pi_gcs.axes())
        if self._spec.axis in there or (self._spec.axis is None and len(there) == 1):
            return self._spec.axis or there[0]
        asked = "which is meant is not said" if self._spec.axis is None else f"'{self._spec.axis}' is none of them"
        raise RigError(f"z stage: the controller's axes are {', '.join(there)}; {asked}.", fix=f'axis = "{there[0]}"')

    def _is_referenced(self) -> bool:
        try:
            return self._link.ask(pi_gcs.referenced(self._axis))
        except NoReply:  # the silence of an unknown question leaves error 2 behind
            self._link.ask(pi_gcs.error())
            return True

    def _reference(self) -> None:
        """Search the reference and wait until the axis rests there; whatever ends this early halts it."""
        deadline = self._clock.now() + REFERENCE_S
        try:
            self._link.ask(pi_gcs.reference(self._axis, self._spec.reference_by))
            while self._moving() or not self._is_referenced():
                self._check_search(late=self._clock.now() > deadline)
                self._clock.sleep(self._poll_s)
        except BaseException:
            self.halt()
            raise

    def _check_search(self, *, late: bool) -> None:
        code = self._link.ask(pi_gcs.error())
        if late or code or self._halted.is_set():
            raise StageStalled(
                f"z stage: no reference was found by its {self._spec.reference_by}; it was halted.",
                why=f"The controller says: {pi_gcs.ERRORS.get(code, 'error')} ({code})." if code else "",
                fix="free the axis; see in its manual whether reference_by is what it has.",
            )

    def _check_travel(self) -> None:
        ends_um = sorted(self._link.ask(end) / self._units_per_um for end in pi_gcs.travel(self._axis))
        inside = ends_um[0] - ROUNDING_UM <= self.limits.min_um and self.limits.max_um <= ends_um[1] + ROUNDING_UM
        if not inside:
            raise RigError(
                f"z stage: limits {self.limits.min_um:g} … {self.limits.max_um:g} µm reach beyond the travel "
                f"{ends_um[0]:g} … {ends_um[1]:g} µm that the controller tells.",
                why=f"The controller's unit is taken to be {1 / self._spec.units_per_um:g} µm.",
                fix="correct limits; units_per_um is 1 for controllers that count µm (piezo), 0.001 for mm (motors).",
            )


def _not_referenced() -> DeviceError:
    return DeviceError(
        "z stage: position unknown: the axis is not referenced.",
        why="It has not been sent to its reference since it was switched on.",
        fix=(
            "clear its whole travel, then let it search: stereotome stage home --may-move",
            "let it search whenever it is opened: may_move_on_enable = true in [stage.z]",
        ),
        code="position-unknown",
    )


def open_stage(table: AxisSpec, context: DeviceContext) -> PiStage:
    """Open the port, identify the controller, compare its travel with the limits, and switch the servo on.

    Raises
    ------
    RigError
        ``units_per_um`` is not given, the limits reach beyond the travel, or the axis is not there.
    DeviceError
        As of `open_polled`; position-unknown for an axis without reference, unless ``may_move_on_enable`` lets it
        search for it; stage-stalled when it finds none.
    """
    if "units_per_um" not in table.model_fields_set:
        raise RigError(
            "z stage: units_per_um is missing.",
            why="PI controllers count in µm or in mm, and nothing but their manual says which.",
            fix="write units_per_um = 1 for controllers that count µm (piezo), 0.001 for mm (motors).",
        )
    fix = "set baud as on the controller: an E-709 is delivered with 115200."
    return open_polled(
        table,
        context,
        lambda link: PiStage(link, table, context.clock, may_reference=table.may_move_on_enable),
        terminator=pi_gcs.TERMINATOR,
        fix=fix,
    )
