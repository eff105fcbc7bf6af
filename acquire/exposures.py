"""Takes the planes of a run, each in its band and where the focus has it, and knows what to do when one cannot be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.frame import Missed
from acquire.plan import Plane
from acquire.revival import revived
from acquire.run_plan import Kind, RunPlan, Step
from acquire.snap import snap
from acquire.standing import AGAIN, END, ENDS
from acquire.state import Board, Phase, Question, Scope
from acquire.taker import CAMERA_STOP_S, Mover, Place, PlaneTaker
from devices.errors import CameraGone, CameraTimeout, DeviceError, Halted, StageStalled
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    import numpy as np

    from acquire.control import Control
    from acquire.ports import FrameOut, Policy
    from devices.protocols import Camera, Clock

LEAVE_OUT = "leave-out"


class Exposures:
    """The planes of a run: which are recorded, and how the next is taken.

    Parameters
    ----------
    plan : RunPlan
        What is taken.
    camera : Camera
        With which `taker` takes planes; another one after it went away and was opened anew.
    policy : Policy
        What is done about a plane that cannot be taken.
    done : collection of int
        Slots that an earlier part of the run recorded.
    offset_nm : callable
        How far the focus has moved from the plan.
    switch_band : callable
        Brings a band about, by its number.
    reopen_camera : callable or None
        Opens a camera anew that went away.

    Attributes
    ----------
    recorded : set of int
        Slots that are recorded.
    camera : Camera
        The one there is now.
    """

    def __init__(
        self,
        plan: RunPlan,
        mover: Mover,
        taker: PlaneTaker,
        camera: Camera,
        out: FrameOut,
        clock: Clock,
        control: Control,
        board: Board,
        policy: Policy,
        *,
        done: Collection[int],
        offset_nm: Callable[[], int],
        switch_band: Callable[[int], None],
        reopen_camera: Callable[[], Camera] | None,
        tell: Callable[[dict[str, Any]], None],
    ) -> None:
        self._plan = plan
        self._mover = mover
        self._taker = taker
        self.camera = camera
        self._out = out
        self._clock = clock
        self._control = control
        self._board = board
        self._policy = policy
        self.recorded = set(done)
        self._offset_nm = offset_nm
        self._switch_band = switch_band
        self._reopen_camera = reopen_camera
        self._tell = tell
        self._band: int | None = None

    def begun(self, section: int) -> bool:
        """Tell whether a plane of a section is recorded."""
        return not self.recorded.isdisjoint(self._plan.slots_of(section))

    def missing(self, section: int) -> list[int]:
        """Return the slots of a section that are not recorded."""
        return [slot for slot in self._plan.slots_of(section) if slot not in self.recorded]

    def first_missing(self) -> int:
        """Return the first section or point in time of which a plane is missing."""
        slots = range(len(self._plan))
        return next((slot for slot in slots if slot not in self.recorded), 0) // self._plan.slots_each

    def take(self, step: Step) -> None:
        """Take a plane that is not recorded yet."""
        slot = self._plan.slot(step.section, step.band, step.plane)
        if slot in self.recorded:
            return
        if step.plane == 0 and not self._plan.plane_by_plane:
            self._taker.forget_approach()
            self._control.heed(Scope.STACK)
        self._control.heed(Scope.PLANE)
        self._choose_band(step.band)
        self._take_or_miss(step)

    def take_again(self, slots: Collection[int], section: int) -> None:
        """Take planes of a section again."""
        self.recorded -= set(slots)
        self._taker.forget_approach()
        for step in self._plan.steps(section):
            if step.kind is Kind.EXPOSE:
                self.take(step)

    def picture(self, z_nm: int) -> np.ndarray:
        """Take a picture for the autofocus: nothing of it is kept."""
        self._choose_band(0)
        self.camera.stop(CAMERA_STOP_S)
        z_um = to_um(z_nm)
        for target_nm in self._plan.stack.moves_nm(Plane(0, z_nm), None):
            z_um = self._mover.move(target_nm, Phase.FOCUSING)
        pixels, _ = snap(self.camera, self._clock, self._plan.exposure_ms(0), z_um)
        self._taker.arm()
        return pixels

    def record(self, section: int, band: int, plane: int, z_um: float) -> None:
        """Note that a plane is recorded, and where it was taken."""
        self.recorded.add(self._plan.slot(section, band, plane))
        self._board.taken += 1
        setpoint_um = self._plane(plane).z_um
        told = {"event": "plane", "plane": plane, "z_um": z_um, "setpoint_um": setpoint_um}
        if self._plan.times > 1 or self._plan.bands:
            told |= {"section": section, "band": band}
        self._tell(told)

    def miss(self, step: Step, error: DeviceError) -> None:
        """Leave a plane out: it is missing, and says why."""
        missed = Missed(step.plane, error.code, step.section, step.band)
        self._board.missed.append(missed)
        self._out.missed(missed)
        self._tell({"event": "warn", "plane": step.plane, "code": error.code, "message": str(error)})

    def _plane(self, number: int) -> Plane:
        """Return a plane of the plan where the focus has it now."""
        return Plane(number, self._plan.stack.plane(number).z_nm + self._offset_nm())

    def _choose_band(self, band: int) -> None:
        if self._plan.bands and band != self._band:
            self.camera.stop(CAMERA_STOP_S)
            self._switch_band(band)
            self._taker.arm()
            self._band = band

    def _take_or_miss(self, step: Step) -> None:
        """Take a plane; one that cannot be taken is asked about, or left out, or ends the run, as the policy says."""
        self._board.plane = step.plane
        while True:
            try:
                self._take(step)
            except (CameraGone, CameraTimeout, Halted, StageStalled) as error:
                self._control.checkpoint()  # a halted move ends as a stall: that was the operator, not a fault
                if self._policy.gap_on_error and not isinstance(error, CameraGone):
                    self.miss(step, error)
                elif not self._policy.asks:
                    raise
                elif self._ask_about(step, error) == AGAIN:
                    continue
            return

    def _ask_about(self, step: Step, error: DeviceError) -> str:
        answers = {AGAIN: "take it again", LEAVE_OUT: "leave it out", END: ENDS}
        choice = self._control.ask(Question(error.code, f"Plane {step.plane} cannot be taken. {error}", answers))
        self._taker.forget_approach()
        if choice == LEAVE_OUT:
            self.miss(step, error)
        return choice

    def _take(self, step: Step) -> None:
        place = Place(step.section, step.band, self._plane(step.plane), self._plan.exposure_ms(step.band))
        try:
            z_um = self._taker.take(place)
        except CameraGone as gone:
            self._revive_camera(gone)
            z_um = self._taker.take(place)
        self.record(step.section, step.band, step.plane, z_um)

    def _revive_camera(self, gone: CameraGone) -> None:
        if self._reopen_camera is None:
            raise gone
        self.camera = revived(self._reopen_camera, gone, self._clock, self._control, self._tell)
        self.camera.configure(exposure_ms=self._plan.exposure_ms(self._band or 0))
        if self._band is not None:
            self._switch_band(self._band)
        self._taker.use(self.camera)
        self._taker.arm()
