"""The only interpreter of plans: goes through the steps of each section and knows what to do when one fails."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from acquire.autofocus import Focus
from acquire.between import Between
from acquire.control import Cancelled, Control, Held
from acquire.exposures import Exposures
from acquire.focusing import Focusing
from acquire.halting import Halting
from acquire.inspection import Hands, Inspection
from acquire.ports import CAREFUL, FrameOut, Policy, SectionOut
from acquire.recorder import DiskLow
from acquire.removal import Removal
from acquire.run_plan import Kind, RunPlan, Step, run_plan
from acquire.sequence import TriggeredStack
from acquire.series import Series
from acquire.standing import AGAIN, END, ENDS, NOTHING_REMOVED, Standing
from acquire.state import FINAL, Board, Phase, Question, RunState, RunStatus, Scope
from acquire.store import RunEnd
from acquire.taker import CAMERA_STOP_S, Mover, PlaneTaker
from acquire.verdict import Finding, no_inspection
from devices.errors import CameraTimeout, Halted, LinkLost, PlanError, StageStalled, StereotomeError
from devices.protocols import HandControls
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from acquire.plan import StackPlan
    from acquire.sequence import TakenPlane
    from acquire.verdict import Inspect, SectionPlanes
    from devices.protocols import Camera, Clock, Feed, Stage

__all__ = ["FINAL", "Phase", "Policy", "Run", "RunState", "RunStatus"]

UNFOCUSED = Focus()
MOVING = {Phase.MOVING, Phase.SETTLING, Phase.PARKING, Phase.FOCUSING}


class Run:
    """One run of one plan.

    ::

        IDLE → ARMING → RUNNING ⇄ PAUSED
        RUNNING → HOLD → RUNNING | CANCELLING              a question to the operator
        RUNNING | PAUSED | HOLD → CANCELLING → FINALISING → CANCELLED
        RUNNING → FINALISING → HELD                        a question, and nobody to answer it
        ARMING | RUNNING → FAULTED → FINALISING → FAILED   halted and parked in between
        RUNNING → FINALISING → COMPLETED | COMPLETED_WITH_GAPS

    Planes in ``done`` were taken by an earlier part of the run and are passed over.
    `execute` does all of it in the calling thread; `pause`, `resume`, `cancel`, `stop` and `answer` may be called from
    any other. Whatever happens, the stage is told to halt and, unless `stop` was called or the stage failed, goes to
    the position the plan states.

    Parameters
    ----------
    feed : Feed, optional
        Needed by a plan with sections, whose ``out`` has to be a `SectionOut`.
    inspect : callable
        Looks at each section before the next is cut.
    known : Standing
        What an earlier part of the run did with the feed.
    committed : int
        Sections an earlier part of the run completed.
    focus : Focus
        Where an earlier part of the run left the focus.
    reopen_camera : callable, optional
        Opens a camera anew that went away.
    """

    def __init__(
        self,
        plan: StackPlan | RunPlan,
        stage: Stage,
        camera: Camera,
        out: FrameOut,
        clock: Clock,
        *,
        feed: Feed | None = None,
        policy: Policy = CAREFUL,
        done: Collection[int] = (),
        committed: int = 0,
        known: Standing = NOTHING_REMOVED,
        inspect: Inspect = no_inspection,
        focus: Focus = UNFOCUSED,
        switch_band: Callable[[int], None] = lambda _: None,
        reopen_camera: Callable[[], Camera] | None = None,
        utc_ns: Callable[[], int] = lambda: 0,
        tell: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        self._plan = run_plan(plan)
        self._stage = stage
        self._feed = feed
        self._out = out
        self._clock = clock
        self._policy = policy
        self._utc_ns = utc_ns
        self._tell = tell
        self._board = Board()
        self._control = Control(
            self._board, clock, note=self._note, tell=self._say, attended=policy.attended, answers=policy.answers
        )
        self._halting = Halting(stage, feed)
        self._mover = Mover(stage, self._control, self._board)
        self._taker = PlaneTaker(
            self._plan.stack,
            stage,
            camera,
            out,
            clock,
            self._control,
            self._board,
            check=self._check_out,
            utc_ns=utc_ns,
        )
        self._exposures = self._make_exposures(camera, done, switch_band, reopen_camera)
        self._committed = committed
        self._triggered = policy.triggered and not done  # the rest of a run is taken plane by plane
        self._removal = self._make_removal(known)
        self._inspection = self._make_inspection(inspect)
        self._focusing: Focusing = Focusing(
            self._plan, stage.limits, self._durable_planes, self._exposures.picture, self._note, focus=focus
        )
        self._between = Between(self._plan, clock, self._control, self._board, self._note)
        self.error: StereotomeError | None = None
        self.held: Question | None = None
        self._steps: dict[Kind, Callable[[Step], None]] = {
            Kind.WAIT: self._between.wait,
            Kind.TILT: self._tilt,
            Kind.FOCUS: self._focus,
            Kind.EXPOSE: self._exposures.take,
            Kind.COMMIT: self._commit,
            Kind.INSPECT: lambda step: self._inspection.look(step.section),
        }

    @property
    def status(self) -> RunStatus:
        """Where the run stands now."""
        board = self._board
        return RunStatus(
            board.state,
            board.phase,
            board.plane,
            len(self._plan),
            board.taken,
            self._out.durable,
            tuple(board.missed),
            board.section,
            self._plan.times,
            self._control.question,
            self._control.pausing,
        )

    def pause(self, scope: Scope = Scope.PLANE) -> None:
        """Wait at the end of the plane, stack or section in work, or before the next cut, until `resume` or `cancel`.

        A feed or cut that has begun is always brought to its end first.
        """
        self._control.pause(scope if self._plan.sections else min(scope, Scope.STACK, key=list(Scope).index))

    def resume(self) -> None:
        """Go on after `pause`."""
        self._control.resume()

    def answer(self, choice: str) -> None:
        """Answer the question of a run on HOLD; raises `devices.errors.InputError` if it is no answer to it."""
        self._control.answer(choice)

    def note(self, text: str) -> None:
        """Put a note of the operator's into the journal, of a run that has one."""
        self._note({"e": "note", "section": self._board.section, "text": text})

    def cancel(self) -> None:
        """End after the exposure or cut in progress; what was taken is kept. A move of the stage is halted."""
        self._control.cancel()
        self._halting.stage_if(lambda: self._board.phase in MOVING)

    def stop(self) -> None:
        """End and stop all motion at once; everything stays where it is."""
        self._control.stop()
        self._halting.stop()

    def execute(self) -> RunState:
        """Carry out the plan and return how it ended; `error` says why if it FAILED, `held` what is asked if HELD."""
        end = RunEnd.FAILED
        try:
            self._control.enter(RunState.ARMING)
            self._arm()
            self._control.enter(RunState.RUNNING)
            self._take_all()
            end = RunEnd.COMPLETED
        except Cancelled:
            end = RunEnd.CANCELLED
        except Held as held:
            end, self.held = RunEnd.HELD, held.question
        except StereotomeError as error:
            self._fail(error)
        finally:
            self._leave(end)
        return self._board.state

    def _make_exposures(
        self,
        camera: Camera,
        done: Collection[int],
        switch_band: Callable[[int], None],
        reopen_camera: Callable[[], Camera] | None,
    ) -> Exposures:
        return Exposures(
            self._plan,
            self._mover,
            self._taker,
            camera,
            self._out,
            self._clock,
            self._control,
            self._board,
            self._policy,
            done=done,
            offset_nm=lambda: self._focusing.focus.offset_nm,
            switch_band=switch_band,
            reopen_camera=reopen_camera,
            tell=self._say,
        )

    def _make_removal(self, known: Standing) -> Removal | None:
        if self._plan.sections is None:
            return None
        if self._feed is None:
            raise PlanError("a run of sections needs a feed.", fix="add [microtome] to the instrument file.")
        return Removal(
            self._plan.sections,
            self._mover,
            self._stage,
            self._feed,
            self._clock,
            self._control,
            self._board,
            note=self._note,
            known=known,
            asks=self._policy.asks,
            accepts_thickness=Finding.THICKNESS in self._policy.accepts,
        )

    def _make_inspection(self, inspect: Inspect) -> Inspection:
        knife = self._removal if self._removal and self._removal.has_knife else None
        hands = Hands(self._durable_planes, self._retake, knife.sweep if knife else None, self._note, self._say)
        sweeps = self._plan.sections.sweeps if self._plan.sections else 0
        accepts = self._policy.accepts
        return Inspection(inspect, hands, self._control, self._board, sweeps=sweeps, accepts=accepts)

    def _durable_planes(self, section: int) -> SectionPlanes:
        self._sections.settle()
        return self._sections.planes(section)

    @property
    def _sections(self) -> SectionOut:
        return cast("SectionOut", self._out)  # a plan with sections comes with such an `out`

    def _say(self, event: dict[str, Any]) -> None:
        self._tell(event)

    def _note(self, record: dict[str, Any]) -> None:
        """Put a record into the journal, of a run that has one."""
        note: Callable[[dict[str, Any]], None] | None = getattr(self._out, "note", None)
        if note is not None:
            note(record)
        if self._plan.sections:
            self._tell({"event": "journal", **record})

    def _fail(self, error: StereotomeError) -> None:
        if self.error is None:
            self.error = error
            self._control.enter(RunState.FAULTED)
        self._tell({"event": "error", "code": error.code, "message": str(error)})

    def _arm(self) -> None:
        self._plan.check(self._stage.limits)
        self._exposures.camera.configure(exposure_ms=self._plan.exposure_ms(0))
        self._hand_controls(enabled=False)
        if not self._triggered and not self._plan.bands:
            self._taker.arm()

    def _hand_controls(self, *, enabled: bool) -> None:
        if isinstance(self._stage, HandControls):
            self._stage.hand_controls(enabled=enabled)

    def _take_all(self) -> None:
        if self._removal:
            self._removal.begin()
        if self._triggered:
            self._take_triggered()
        self._between.begin(self._exposures.first_missing())
        if self._plan.at_camera_rate:
            self._take_at_camera_rate()
        for section in range(self._committed, self._plan.times):
            self._board.section = section
            self._control.heed(Scope.SECTION)
            self._take_section(section)

    def _take_section(self, section: int) -> None:
        removed = self._removal is None or self._removal.over(section)
        for step in self._plan.steps(section):
            if step.kind in self._steps:
                self._steps[step.kind](step)
            elif self._removal and not removed:
                self._remove(self._removal, step)

    def _remove(self, removal: Removal, step: Step) -> None:
        """Carry out a step of the removal; before the first, the disk must have room for what will be seen."""
        match step.kind:
            case Kind.PARK:
                self._with_room(lambda: self._sections.check_room(self._plan.slots_each))
                removal.park(step)
                self._taker.forget_approach()
            case Kind.FEED:
                removal.feed(step)
            case Kind.CUT:
                removal.cut(step)
            case Kind.CLEAR:
                removal.clear(step)
            case Kind.CLEAN:
                removal.clean(step)
            case _:
                raise AssertionError(step)

    def _tilt(self, step: Step) -> None:
        if not self._exposures.begun(step.section):
            self._between.tilt(step)
            self._taker.forget_approach()

    def _take_at_camera_rate(self) -> None:
        """Take a series as fast as frames come; what is lost on the way stays a gap at its time."""
        self._control.heed(Scope.PLANE)
        series = Series(self._plan, self._exposures.camera, self._out, self._clock, self._control, utc_ns=self._utc_ns)
        z_um = self._taker.go_to(self._plan.stack.plane(0))
        self._board.phase = Phase.EXPOSING
        for section in series.take(self._exposures.first_missing(), z_um, check=self._check_out):
            self._board.section = section
            self._exposures.record(section, 0, 0, z_um)
        for section, reason in series.lost.items():
            self._exposures.miss(Step(Kind.EXPOSE, section), CameraTimeout(reason, code="frame-lost"))
            self._exposures.recorded.add(section)

    def _focus(self, step: Step) -> None:
        """Bring the focus where the section's planes are to be taken, unless some of them are taken already."""
        if not self._exposures.begun(step.section):
            self._board.phase = Phase.FOCUSING
            self._focusing.before(step.section)
            self._taker.forget_approach()

    def _retake(self, slots: Collection[int], reason: str) -> None:
        """Take planes of the section in work again."""
        self._sections.reject(slots, reason)
        self._exposures.take_again(slots, self._board.section)

    def _check_out(self) -> None:
        self._with_room(self._out.check)

    def _with_room(self, check: Callable[[], None]) -> None:
        """Check the disk; one that fills up is asked about, and waited for, if the policy asks."""
        while True:
            try:
                check()
            except DiskLow as error:
                if not self._policy.asks:
                    raise
                answers = {AGAIN: "there is space now: go on", END: ENDS}
                self._control.ask(Question(error.code, f"{error} {error.why}", answers), solved=lambda: _passes(check))
            else:
                return

    def _commit(self, step: Step) -> None:
        """Commit-before-cut: nothing is removed before every plane of the face is durable, accepted or waived."""
        self._board.phase = Phase.COMMITTING
        self._sections.settle()
        waived = self._exposures.missing(step.section)
        self._sections.commit_section(step.section, waived)
        self._tell({"event": "section", "section": step.section, "waived": waived})

    def _take_triggered(self) -> None:
        """Take what stage and camera bring about by themselves; a pause is heeded before and after only."""
        self._control.heed(Scope.PLANE)
        self._board.phase = Phase.EXPOSING
        stack = TriggeredStack(
            self._plan.stack,
            self._stage,
            self._exposures.camera,
            self._out,
            self._clock,
            utc_ns=self._utc_ns,
            ended=lambda: self._control.cancelled,
            took=self._took,
        )
        try:
            complaint = stack.take(self._mover.timeout_s(self._plan.stack.start_nm))
        finally:
            self._control.checkpoint()  # a halt ends it as a stall: that was the operator, not a fault
        left = [plane.index for plane in self._plan.stack if plane.index not in self._exposures.recorded]
        if complaint or left:
            words = f"triggered stack: {complaint or 'frames were lost'}; taken one by one: {left or 'none'}"
            self._tell({"event": "warn", "plane": self._board.plane, "code": "stage-sequence", "message": words})
        self._taker.arm()

    def _took(self, place: TakenPlane) -> None:
        self._board.plane = place.plane
        self._exposures.record(0, 0, place.plane, place.z_um)

    def _leave(self, end: RunEnd) -> None:
        """Halt, go back, close the camera's delivery, put the last record: each step even if one before failed."""
        self._halting.leave()
        if end is RunEnd.CANCELLED:
            self._control.enter(RunState.CANCELLING)
        self._try(self._halting.everything if self._control.stopped else self._stage.halt)
        self._try(lambda: self._exposures.camera.stop(CAMERA_STOP_S))
        if self._removal:
            self._removal.leave()
        self._try(self._return)
        self._try(lambda: self._hand_controls(enabled=True))
        self._control.enter(RunState.FINALISING)
        self._board.phase = Phase.PERSISTING
        if self.error is not None:
            end = RunEnd.FAILED
        try:
            state = RunState(self._out.finish(end, self._reason()))
        except StereotomeError as error:
            self._fail(error)
            state = RunState.FAILED
        self._board.phase = Phase.WAITING
        self._control.enter(state)

    def _reason(self) -> str:
        if self.error is not None:
            return f"{self.error.code}: {self.error}"
        return "" if self.held is None else f"{self.held.code}: {self.held.words}"

    def _try(self, step: Callable[[], None]) -> None:
        try:
            step()
        except StereotomeError as error:
            self._fail(error)

    def _return(self) -> None:
        """Go to the stated position, also after an abort; not after `stop`, and not with a stage that failed."""
        sections = self._plan.sections
        target_nm = sections.park_nm if sections else self._plan.stack.return_nm
        stage_failed = isinstance(self.error, (LinkLost, StageStalled))
        if target_nm is None or self._control.stopped or stage_failed:
            return
        self._board.phase = Phase.RETURNING
        self._go_back(target_nm)

    def _go_back(self, target_nm: int) -> None:
        """Bring the stage there; a stop on the way is no fault."""
        try:
            self._stage.move_to(to_um(target_nm))
            if self._control.stopped:  # it was set between the look and the move
                self._stage.halt()
            self._stage.settle(self._mover.timeout_s(target_nm))
        except (Halted, StageStalled):
            if not self._control.stopped:
                raise


def _passes(check: Callable[[], None]) -> bool:
    try:
        check()
    except StereotomeError:
        return False
    return True
