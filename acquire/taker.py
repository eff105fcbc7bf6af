"""Takes single planes: goes there from the approach side, waits for rest, exposes, and takes no frame but its own."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.frame import FrameHeader
from acquire.gate import FrameGate
from acquire.state import Phase
from devices.errors import CameraGone, CameraTimeout, LinkLost, StageStalled
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.control import Control
    from acquire.gate import TakesFrames
    from acquire.plan import Plane, StackPlan
    from acquire.state import Board
    from devices.protocols import Camera, Clock, Stage

STAGE_TRIES = 2
CAMERA_TRIES = 3
CAMERA_STOP_S = 2.0
FIRST_FRAME_S = 5.0
POLL_S = 0.0005


@dataclass(frozen=True)
class Place:
    """Which plane is to be taken: section, band, exposure."""

    section: int
    band: int
    plane: Plane
    exposure_ms: float


@contextmanager
def camera_there() -> Iterator[None]:
    """Turn a lost connection to the camera into `CameraGone`: to take a picture again harms nothing."""
    try:
        yield
    except LinkLost as lost:
        raise CameraGone(lost.what, why=lost.why, fix=lost.fix) from lost


class Mover:
    """Sends the stage somewhere and waits until it rests there; a cancelled run halts it."""

    def __init__(self, stage: Stage, control: Control, board: Board) -> None:
        self._stage = stage
        self._control = control
        self._board = board

    def move(self, target_nm: int, phase: Phase = Phase.MOVING) -> float:
        """Return where the stage came to rest, in µm."""
        self._control.checkpoint()
        self._board.phase = phase
        self._stage.move_to(to_um(target_nm))
        if self._control.cancelled:  # it was set between the check and the move: `cancel` halted too early
            self._stage.halt()
        self._board.phase = Phase.SETTLING if phase is Phase.MOVING else phase
        z_um = self._stage.settle(self.timeout_s(target_nm))
        self._control.checkpoint()
        return z_um

    def timeout_s(self, target_nm: int) -> float:
        """Return a cap no honest move reaches; a stage that stands still is noticed much earlier by its driver."""
        limits = self._stage.limits
        return 30.0 + (limits.max_um - limits.min_um) / 10.0 + abs(to_um(target_nm)) / 10.0


class PlaneTaker:
    """Takes planes with a triggered or free-running camera.

    Parameters
    ----------
    stack : StackPlan
        Approach and tolerance.
    out : TakesFrames
        Where frames go.
    check : callable
        Raises if no further frame can be kept; asked before each exposure.
    """

    def __init__(
        self,
        stack: StackPlan,
        stage: Stage,
        camera: Camera,
        out: TakesFrames,
        clock: Clock,
        control: Control,
        board: Board,
        *,
        check: Callable[[], None],
        utc_ns: Callable[[], int],
    ) -> None:
        self.stack = stack
        self._stage = stage
        self._camera = camera
        self._out = out
        self._clock = clock
        self._control = control
        self._board = board
        self._check = check
        self._utc_ns = utc_ns
        self._mover = Mover(stage, control, board)
        self._gate = FrameGate(out, camera.caps(), stack.exposure_ms)
        self._before: Plane | None = None

    def arm(self) -> None:
        """Let the camera deliver to us from now on."""
        self._gate = FrameGate(self._out, self._camera.caps(), self.stack.exposure_ms)
        self._camera.arm(None, self._gate)

    def rearm(self) -> None:
        """End the camera's delivery and begin it anew."""
        self._camera.stop(CAMERA_STOP_S)
        self.arm()

    def use(self, camera: Camera) -> None:
        """Take planes with this camera from now on; to be armed next."""
        self._camera = camera

    def forget_approach(self) -> None:
        """Take the next plane with its whole approach: the stage was elsewhere meanwhile."""
        self._before = None

    def take(self, place: Place) -> float:
        """Take one plane and return where the stage was, in µm.

        Raises
        ------
        CameraTimeout
            No frame after all tries.
        CameraGone
            Its connection is lost.
        StageStalled
            The stage does not get there.
        """
        for attempt in range(CAMERA_TRIES):
            self._check()
            z_um = self.go_to(place.plane)
            if self._expose(place, z_um, attempt):
                return z_um
            self._control.checkpoint()
            with camera_there():
                self.rearm()
        wait_s = self._frame_timeout_s(place.exposure_ms)
        raise CameraTimeout(
            f"camera: no frame for plane {place.plane.index} after {CAMERA_TRIES} tries of {wait_s:.1f} s.",
            fix="check the camera's cable, then: stereotome doctor",
        )

    def go_to(self, plane: Plane) -> float:
        """Bring the stage to a plane from its approach side and return where it came to rest, in µm."""
        for _ in range(STAGE_TRIES):
            z_um = self._approach(plane)
            self._before = plane
            if abs(to_nm(z_um) - plane.z_nm) <= self.stack.tolerance_nm:
                return z_um
            self._stage.halt()
            self._before = None
        raise StageStalled(
            f"z stage: sent to {plane.z_um:+.3f} µm, it rests at {z_um:+.3f} µm, more than "
            f"{to_um(self.stack.tolerance_nm):g} µm away.",
            why="It meets an obstacle, or its motor loses steps.",
            fix=("look whether something touches the specimen", "set stack.tolerance_um to what the stage can do"),
        )

    def _approach(self, plane: Plane) -> float:
        if self._before == plane:  # another band or try of the same plane
            return self._stage.position_um()
        z_um = float("nan")
        for target_nm in self.stack.moves_nm(plane, self._before):
            z_um = self._mover.move(target_nm)
        return z_um

    def _expose(self, place: Place, z_um: float, attempt: int) -> bool:
        self._board.phase = Phase.EXPOSING
        header = FrameHeader(
            plane=place.plane.index,
            setpoint_um=place.plane.z_um,
            z_um=z_um,
            exposure_ms=place.exposure_ms,
            utc_ns=self._utc_ns(),
            section=place.section,
            attempt=attempt,
            band=place.band,
        )
        self._gate.expect(header, round(self._clock.now() * 1e9))
        try:
            with camera_there():
                self._camera.trigger()
            return self._wait_for_frame(place.exposure_ms)
        except CameraTimeout:
            return False
        finally:
            self._gate.forget()

    def _frame_timeout_s(self, exposure_ms: float) -> float:
        base_s = 1.0 if self._board.taken else FIRST_FRAME_S
        return max(base_s, 5 * exposure_ms / 1000)

    def _wait_for_frame(self, exposure_ms: float) -> bool:
        deadline = self._clock.now() + self._frame_timeout_s(exposure_ms)
        while not self._gate.passed():
            if self._clock.now() > deadline or self._control.stopped:
                return False
            self._clock.sleep(POLL_S)
        return True
