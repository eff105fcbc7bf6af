"""The only interpreter of plans: moves, settles, exposes, and accepts a frame only for the plane it belongs to."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol

from acquire.frame import FrameHeader, Missed
from acquire.sequence import TriggeredStack
from acquire.store import RunEnd
from devices.errors import CameraTimeout, DeviceError, Halted, LinkLost, StageStalled, StereotomeError
from devices.protocols import HandControls
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    import numpy as np

    from acquire.plan import Plane, StackPlan
    from acquire.sequence import TakenPlane
    from devices.protocols import Camera, Clock, Stage
    from devices.values import CameraCaps, FrameStamp

STAGE_TRIES = 2
CAMERA_TRIES = 3
CAMERA_STOP_S = 2.0
FIRST_FRAME_S = 5.0
POLL_S = 0.0005


class RunState(StrEnum):
    """Where a run stands; `Run` draws the machine."""

    IDLE = "IDLE"
    ARMING = "ARMING"
    RUNNING = "RUNNING"
    PAUSED = "PAUSED"
    CANCELLING = "CANCELLING"
    FINALISING = "FINALISING"
    COMPLETED = "COMPLETED"
    COMPLETED_WITH_GAPS = "COMPLETED_WITH_GAPS"
    CANCELLED = "CANCELLED"
    FAILED = "FAILED"


FINAL = {RunState.COMPLETED, RunState.COMPLETED_WITH_GAPS, RunState.CANCELLED, RunState.FAILED}


class Phase(StrEnum):
    """What a running run does at the moment."""

    WAITING = "waiting"
    MOVING = "moving"
    EXPOSING = "exposing"
    RETURNING = "returning"
    PERSISTING = "persisting"


@dataclass(frozen=True)
class RunStatus:
    """A snapshot of a run.

    Attributes
    ----------
    plane : int
        Plane in work, or the last one.
    taken, durable : int
        Planes exposed, and planes that are verified on disk.
    """

    state: RunState
    phase: Phase
    plane: int
    planned: int
    taken: int
    durable: int
    missed: tuple[Missed, ...]


@dataclass(frozen=True)
class Policy:
    """What the engine may decide by itself.

    Attributes
    ----------
    gap_on_error : bool
        Record a plane that cannot be taken as missing and go on, instead of ending the run.
    triggered : bool
        Let stage and camera trigger each other; planes that this does not bring are taken one by one.
    """

    gap_on_error: bool = False
    triggered: bool = False


class TakesFrames(Protocol):
    """Whatever a frame can be handed to."""

    def put(self, pixels: np.ndarray, header: FrameHeader) -> None:
        """Take over one frame; the pixels are copied."""
        ...


class FrameOut(TakesFrames, Protocol):
    """Where the frames of a run go; `acquire.recorder.Recorder` at the bench."""

    @property
    def durable(self) -> int:
        """Planes that are verified on disk."""
        ...

    def check(self) -> None:
        """Raise if no further plane can be kept."""
        ...

    def missed(self, missed: Missed) -> None:
        """Record a plane that stays empty."""
        ...

    def finish(self, end: RunEnd, reason: str = "") -> RunEnd:
        """Make everything durable and return how the run really ended."""
        ...


class _Cancelled(Exception):
    """The operator ended the run; raised between steps, caught by `Run.execute`."""


class FrameGate:
    """Lets through the one frame that belongs to the plane being exposed.

    A frame belongs to a plane if its exposure began after the stage had settled there. Where the camera cannot say
    when that was, the latest possible beginning is not enough: the earliest is taken, arrival less exposure less
    readout. Everything else a free-running camera delivers is counted and let go.
    """

    def __init__(self, out: TakesFrames, caps: CameraCaps, exposure_ms: float) -> None:
        self._out = out
        self._caps = caps
        self._before_arrival_ns = round((exposure_ms + caps.readout_ms) * 1e6)
        self._header: FrameHeader | None = None
        self._settled_ns = 0
        self._error: StereotomeError | None = None
        self.discarded = 0

    def expect(self, header: FrameHeader, settled_ns: int) -> None:
        """Open for the frame of one plane."""
        self._error = None
        self._settled_ns = settled_ns
        self._header = header

    def forget(self) -> None:
        """Close: what comes now belongs to no plane."""
        self._header = None

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        """Take a frame from the camera, in whatever thread it comes."""
        start_ns = stamp.exposure_start_ns
        if start_ns is None:
            start_ns = stamp.arrival_ns - self._before_arrival_ns
        header = self._header
        if header is None or start_ns < self._settled_ns:
            self.discarded += 1
            return
        try:
            self._check_shape(pixels)
            self._out.put(pixels, _stamped(header, stamp))
        except StereotomeError as error:
            self._error = error
        self._header = None

    def _check_shape(self, pixels: np.ndarray) -> None:
        if pixels.shape != self._caps.shape or pixels.dtype.name != self._caps.dtype:
            raise DeviceError(
                f"camera: a frame of {pixels.shape} {pixels.dtype} came, "
                f"{self._caps.shape} {self._caps.dtype} was expected.",
                why="The camera's settings were changed while it was armed.",
            )

    def passed(self) -> bool:
        """Tell whether the expected frame was taken; raises what went wrong with it."""
        if self._error is not None:
            raise self._error
        return self._header is None


def _stamped(header: FrameHeader, stamp: FrameStamp) -> FrameHeader:
    return replace(
        header,
        exposure_start_ns=stamp.exposure_start_ns or 0,
        exposure_end_ns=stamp.exposure_end_ns or 0,
        arrival_ns=stamp.arrival_ns,
        hw_id=-1 if stamp.hw_id is None else stamp.hw_id,
    )


class Run:
    """One run of one plan.

    ::

        IDLE → ARMING → RUNNING ⇄ PAUSED
        RUNNING | PAUSED → CANCELLING → FINALISING → CANCELLED
        RUNNING → FINALISING → COMPLETED | COMPLETED_WITH_GAPS
        ARMING | RUNNING → FINALISING → FAILED

    Planes in ``done`` were taken by an earlier part of the run and are passed over.
    `execute` does all of it in the calling thread; `pause`, `resume`, `cancel` and `stop` may be called from any other.
    Whatever happens, the stage is told to halt and, unless `stop` was called or the stage failed, goes to the
    position the plan states.
    """

    def __init__(
        self,
        plan: StackPlan,
        stage: Stage,
        camera: Camera,
        out: FrameOut,
        clock: Clock,
        *,
        policy: Policy = Policy(),
        done: Collection[int] = (),
        utc_ns: Callable[[], int] = lambda: 0,
        tell: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        self._plan = plan
        self._stage = stage
        self._camera = camera
        self._out = out
        self._clock = clock
        self._policy = policy
        self._before: Plane | None = None
        self._utc_ns = utc_ns
        self._tell = tell
        self._gate = FrameGate(out, camera.caps(), plan.exposure_ms)
        self._state = RunState.IDLE
        self._phase = Phase.WAITING
        self._plane = 0
        self._taken = 0
        self._missed: list[Missed] = []
        self._recorded = set(done)
        self._triggered = policy.triggered and not self._recorded  # the rest of a run is taken plane by plane
        self._cancelled = threading.Event()
        self._stopped = threading.Event()
        self._paused = threading.Event()
        self.error: StereotomeError | None = None

    @property
    def status(self) -> RunStatus:
        """Where the run stands now."""
        return RunStatus(
            self._state, self._phase, self._plane, len(self._plan), self._taken, self._out.durable, tuple(self._missed)
        )

    def pause(self) -> None:
        """Wait before the next plane until `resume` or `cancel`."""
        self._paused.set()

    def resume(self) -> None:
        """Go on after `pause`."""
        self._paused.clear()

    def cancel(self) -> None:
        """End after the exposure in progress; what was taken is kept. A move under way is halted."""
        self._cancelled.set()
        if self._phase is Phase.MOVING:
            self._stage.halt()

    def stop(self) -> None:
        """End and stop all motion at once; the stage stays where it is."""
        self._stopped.set()
        self._cancelled.set()
        self._stage.halt()

    def execute(self) -> RunState:
        """Carry out the plan and return how it ended; `error` says why if it FAILED."""
        end = RunEnd.FAILED
        try:
            self._enter(RunState.ARMING)
            self._arm()
            self._enter(RunState.RUNNING)
            if self._triggered:
                self._take_triggered()
            for plane in self._plan:
                if plane.index not in self._recorded:
                    self._take_or_miss(plane)
            end = RunEnd.COMPLETED
        except _Cancelled:
            end = RunEnd.CANCELLED
        except StereotomeError as error:
            self._fail(error)
        finally:
            self._leave(end)
        return self._state

    def _enter(self, state: RunState) -> None:
        self._state = state
        self._tell({"event": "state", "state": str(state)})

    def _fail(self, error: StereotomeError) -> None:
        self.error = self.error or error
        self._tell({"event": "error", "code": error.code, "message": str(error)})

    def _arm(self) -> None:
        self._plan.check(self._stage.limits)
        self._camera.configure(exposure_ms=self._plan.exposure_ms)
        self._hand_controls(enabled=False)
        if not self._triggered:
            self._camera.arm(None, self._gate)

    def _hand_controls(self, *, enabled: bool) -> None:
        if isinstance(self._stage, HandControls):
            self._stage.hand_controls(enabled=enabled)

    def _take_triggered(self) -> None:
        """Take what stage and camera bring about by themselves; a pause is heeded before and after only."""
        self._wait_while_paused()
        self._checkpoint()
        self._phase = Phase.EXPOSING
        stack = TriggeredStack(
            self._plan,
            self._stage,
            self._camera,
            self._out,
            self._clock,
            utc_ns=self._utc_ns,
            ended=self._cancelled.is_set,
            took=self._took,
        )
        try:
            complaint = stack.take(self._move_timeout_s(self._plan.start_nm))
        finally:
            self._checkpoint()  # a halt ends it as a stall: that was the operator, not a fault
        left = [plane.index for plane in self._plan if plane.index not in self._recorded]
        if complaint or left:
            words = f"triggered stack: {complaint or 'frames were lost'}; taken one by one: {left or 'none'}"
            self._tell({"event": "warn", "plane": self._plane, "code": "stage-sequence", "message": words})
        self._camera.arm(None, self._gate)

    def _took(self, place: TakenPlane) -> None:
        self._plane = place.plane
        self._record(place.plane, place.z_um)

    def _record(self, plane: int, z_um: float) -> None:
        self._recorded.add(plane)
        self._taken += 1
        setpoint_um = to_um(self._plan.start_nm + plane * self._plan.step_nm)
        self._tell({"event": "plane", "plane": plane, "z_um": z_um, "setpoint_um": setpoint_um})

    def _checkpoint(self) -> None:
        if self._cancelled.is_set():
            raise _Cancelled

    def _wait_while_paused(self) -> None:
        if not self._paused.is_set():
            return
        self._enter(RunState.PAUSED)
        while self._paused.is_set() and not self._cancelled.is_set():
            self._clock.sleep(0.01)
        self._enter(RunState.RUNNING)

    def _take_or_miss(self, plane: Plane) -> None:
        self._wait_while_paused()
        self._plane = plane.index
        try:
            self._take(plane)
        except (CameraTimeout, Halted, StageStalled) as error:
            self._checkpoint()  # a halted move ends as a stall, or is not sent: that was the operator, not a fault
            if not self._policy.gap_on_error:
                raise
            missed = Missed(plane.index, error.code)
            self._missed.append(missed)
            self._out.missed(missed)
            self._tell({"event": "warn", "plane": plane.index, "code": error.code, "message": str(error)})

    def _take(self, plane: Plane) -> None:
        for attempt in range(CAMERA_TRIES):
            self._out.check()
            z_um = self._go_to(plane)
            if self._expose(plane, z_um, attempt):
                self._record(plane.index, z_um)
                return
            self._checkpoint()
            self._rearm()
        raise CameraTimeout(
            f"camera: no frame for plane {plane.index} after {CAMERA_TRIES} tries of {self._frame_timeout_s():.1f} s.",
            fix="check the camera's cable, then: stereotome doctor",
        )

    def _go_to(self, plane: Plane) -> float:
        """Bring the stage to a plane from its approach side and return where it came to rest, in µm."""
        self._phase = Phase.MOVING
        z_um = float("nan")
        for _ in range(STAGE_TRIES):
            for target_nm in self._plan.moves_nm(plane, self._before):
                z_um = self._move(target_nm)
            self._before = plane
            if abs(to_nm(z_um) - plane.z_nm) <= self._plan.tolerance_nm:
                return z_um
            self._stage.halt()
            self._before = None
        raise StageStalled(
            f"z stage: sent to {plane.z_um:+.3f} µm, it rests at {z_um:+.3f} µm, more than "
            f"{to_um(self._plan.tolerance_nm):g} µm away.",
            why="It meets an obstacle, or its motor loses steps.",
            fix=("look whether something touches the specimen", "set stack.tolerance_um to what the stage can do"),
        )

    def _move(self, target_nm: int) -> float:
        self._checkpoint()
        self._stage.move_to(to_um(target_nm))
        if self._cancelled.is_set():  # it was set between the check and the move: `cancel` halted too early
            self._stage.halt()
        z_um = self._stage.settle(self._move_timeout_s(target_nm))
        self._checkpoint()
        return z_um

    def _move_timeout_s(self, target_nm: int) -> float:
        """Return a cap no honest move reaches; a stage that stands still is noticed much earlier by its driver."""
        limits = self._stage.limits
        return 30.0 + (limits.max_um - limits.min_um) / 10.0 + abs(to_um(target_nm)) / 10.0

    def _expose(self, plane: Plane, z_um: float, attempt: int) -> bool:
        self._phase = Phase.EXPOSING
        header = FrameHeader(
            plane=plane.index,
            setpoint_um=plane.z_um,
            z_um=z_um,
            exposure_ms=self._plan.exposure_ms,
            utc_ns=self._utc_ns(),
            attempt=attempt,
        )
        self._gate.expect(header, round(self._clock.now() * 1e9))
        try:
            self._camera.trigger()
            return self._wait_for_frame()
        except CameraTimeout:
            return False
        finally:
            self._gate.forget()

    def _frame_timeout_s(self) -> float:
        base_s = 1.0 if self._taken else FIRST_FRAME_S
        return max(base_s, 5 * self._plan.exposure_ms / 1000)

    def _wait_for_frame(self) -> bool:
        deadline = self._clock.now() + self._frame_timeout_s()
        while not self._gate.passed():
            if self._clock.now() > deadline or self._stopped.is_set():
                return False
            self._clock.sleep(POLL_S)
        return True

    def _rearm(self) -> None:
        self._camera.stop(CAMERA_STOP_S)
        self._camera.arm(None, self._gate)

    def _leave(self, end: RunEnd) -> None:
        """Halt, go back, close the camera's delivery, put the last record: each step even if one before failed."""
        self._state = RunState.CANCELLING if end is RunEnd.CANCELLED else RunState.FINALISING
        self._try(self._stage.halt)
        self._try(lambda: self._camera.stop(CAMERA_STOP_S))
        self._try(self._return)
        self._try(lambda: self._hand_controls(enabled=True))
        self._enter(RunState.FINALISING)
        self._phase = Phase.PERSISTING
        if self.error is not None:
            end = RunEnd.FAILED
        reason = "" if self.error is None else f"{self.error.code}: {self.error}"
        try:
            self._state = RunState(self._out.finish(end, reason))
        except StereotomeError as error:
            self._fail(error)
            self._state = RunState.FAILED
        self._phase = Phase.WAITING
        self._tell({"event": "state", "state": str(self._state)})

    def _try(self, step: Callable[[], None]) -> None:
        try:
            step()
        except StereotomeError as error:
            self._fail(error)

    def _return(self) -> None:
        """Go to the stated position, also after an abort; not after `stop`, and not with a stage that failed."""
        stage_failed = isinstance(self.error, (LinkLost, StageStalled))
        if self._plan.return_nm is None or self._stopped.is_set() or stage_failed:
            return
        self._phase = Phase.RETURNING
        self._stage.move_to(to_um(self._plan.return_nm))
        self._stage.settle(self._move_timeout_s(self._plan.return_nm))
