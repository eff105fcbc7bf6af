"""Brings about the next face: park, feed, cut, clear. Each command is announced in the journal before it is given.

What is announced and not confirmed, because the program died or the device failed, is looked at and never repeated
blindly: `acquire.standing` judges, and in doubt the operator is asked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.interlock import PARK_TOLERANCE_NM, lease_of
from acquire.standing import (
    ACCEPT,
    AGAIN,
    CUT_ANSWERS,
    DONE,
    END,
    ENDS,
    NOT_DONE,
    NOTHING_REMOVED,
    SAME_PLACE_NM,
    Act,
    Doubt,
    Standing,
    check_place,
    check_still_parked,
    check_thickness,
    judge_cut,
    judge_feed,
)
from acquire.state import Phase, Question, Scope
from acquire.verdict import Finding
from devices.errors import DeviceError, PlanError, Unsafe
from devices.feed_errors import FeedHalted, FeedUndecided, KnifeFailed
from devices.feed_values import FeedState, KnifeState
from devices.protocols import Microtome
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.control import Control
    from acquire.journal import Record
    from acquire.run_plan import SectionPlan, Step
    from acquire.state import Board
    from acquire.taker import Mover
    from devices.protocols import Clock, Feed, Stage

HOLDER = "a run of sections"
REST_S = 0.1
REST_LOOKS = 1200
KNIFE_REST_S = 0.6  # a knife told to cut may begin only after this
CLEAR_TWICE_S = 0.05


class Removal:
    """The steps PARK, FEED, CUT, CLEAR and CLEAN of a section.

    Parameters
    ----------
    plan : SectionPlan
        What is removed.
    mover, stage, feed : Mover, Stage, Feed
        The devices.
    note : callable
        Puts a record into the journal; returns when it is durable.
    known : Standing
        What an earlier part of the run has done.
    asks : bool
        A device that fails leads to a question; otherwise to the end of the run.
    accepts_thickness : bool
        A section of another thickness is noted, and nobody is asked.
    """

    def __init__(
        self,
        plan: SectionPlan,
        mover: Mover,
        stage: Stage,
        feed: Feed,
        clock: Clock,
        control: Control,
        board: Board,
        *,
        note: Callable[[Record], None],
        known: Standing = NOTHING_REMOVED,
        asks: bool = True,
        accepts_thickness: bool = False,
    ) -> None:
        self._plan = plan
        self._mover = mover
        self._stage = stage
        self._feed_axis = feed
        self._microtome = _microtome(plan, feed)
        self._clock = clock
        self._control = control
        self._board = board
        self._write = note
        self._asks = asks
        self._accepts_thickness = accepts_thickness
        self._lease = lease_of(stage)
        self.known = known

    def begin(self) -> None:
        """Note where the feed stands when the run begins; when it goes on, make sure that it stands where it was left.

        Nothing is compared while the journal leaves open what the feed did: the steps that follow find out.
        """
        if self.known.origin_nm is None:
            self._check_ready()
            self._note({"e": "origin", "depth_nm": self._feed_axis.position_nm(), "cuts": self._feed_axis.cut_count()})
        elif self.known.cleared or self.known.feed is Act.PENDING:
            self._through(self._check_place)
        else:
            self._through(self._check_still_parked)

    def _check_ready(self) -> None:
        """Raise `Unsafe` before anything was moved, unless the feed is referenced and at rest."""
        if isinstance(self._feed_axis, Microtome) and (state := self._feed_axis.resolve()) is not FeedState.READY:
            raise Unsafe(
                f"feed: it is {state}, not ready. Nothing was started.",
                fix="home it: stereotome section home --yes -i INSTRUMENT",
            )

    def over(self, section: int) -> bool:
        """Tell whether the face of a section lies free already."""
        return self.known.section > section or (self.known.section == section and self.known.cleared)

    def park(self, step: Step) -> None:
        """Bring the stage out of the knife's way and read that it is there."""
        self._enter(step)
        self._bring_away()

    def _bring_away(self) -> None:
        z_um = self._mover.move(self._plan.park_nm, Phase.PARKING)
        self._check_parked(z_um)

    def feed(self, step: Step) -> None:
        """Advance by a section; read back."""
        self._control.heed(Scope.BEFORE_CUT)
        self._board.phase = Phase.FEEDING
        self._lease.take(HOLDER)
        self._through(lambda: self._feed(step.section))

    def cut(self, step: Step) -> None:
        """Make one stroke."""
        self._board.phase = Phase.CUTTING
        self._through(lambda: self._cut(step.section))

    def clear(self, step: Step) -> None:
        """Make sure, twice, that the knife is out of the way."""
        self._board.phase = Phase.CLEARING
        self._through(lambda: self._clear(step.section))
        self._lease.release()

    @property
    def has_knife(self) -> bool:
        """Whether a face can be wiped."""
        return self._microtome is not None

    def sweep(self, section: int) -> None:
        """Let the knife wipe over the face of a section, with the feed drawn back."""
        self._bring_away()
        self._lease.take(HOLDER)
        self._board.phase = Phase.SWEEPING
        self._through(lambda: self._sweep(section))
        self._board.phase = Phase.CLEARING
        self._through(lambda: self._clear(section))
        self._lease.release()

    def _sweep(self, section: int) -> None:
        if self.known.cleared:  # else it was begun before, and failed: a wipe more or less does no harm, so clear only
            assert self._microtome is not None
            self._note({"e": "sweep_intent", "section": section, "distance_nm": self._plan.sweep_nm})
            self._microtome.arm()
            self._microtome.sweep(self._plan.sweep_nm)
            self._write({"e": "sweep_done", "section": section, "cuts_after": self._feed_axis.cut_count()})

    def clean(self, step: Step) -> None:
        """Wash a polished face, or have it cleaned."""
        self._board.phase = Phase.CLEANING
        if self.known.cut is not Act.DONE:
            if self._plan.clean_s:
                self._clock.sleep(self._plan.clean_s)
            else:
                self._control.ask(_clean_question(step.section))
            self._note({"e": "clean_done", "section": step.section})
        self._note({"e": "clear", "section": step.section, "knife": "absent", "z_um": self._stage.position_um()})
        self._lease.release()

    def leave(self) -> None:
        """Let others move the stage again; it stays parked until the knife is seen to be clear."""
        self._lease.release()

    def _enter(self, step: Step) -> None:
        if self.known.section != step.section:
            self.known = self.known.next(step.section)

    def _note(self, record: Record) -> None:
        self._write(record)
        self.known = self.known.heard(record)

    def _depth_nm(self, section: int) -> float:
        """Return the place of the feed for a section; -1 is where it stood at the start."""
        assert self.known.origin_nm is not None
        return self._plan.depth_nm(section, self.known.origin_nm)

    @property
    def _place_nm(self) -> float:
        """Where the feed was left: what it read back for this section or, before it is fed, for the one before."""
        assert self.known.depth_nm is not None
        return self.known.depth_nm

    def _through(self, act: Callable[[], None]) -> None:
        """Do something to its end; what fails or is in doubt is asked, then looked at anew."""
        question, self.known = self.known.unanswered, replace(self.known, unanswered=None)
        while True:
            try:
                if question is not None:
                    self._settle(self._control.ask(question))
                act()
            except Doubt as doubt:
                question = doubt.question
            except DeviceError as error:
                if not self._asks:
                    raise
                question = self._question(error)
            else:
                return

    def _question(self, error: DeviceError) -> Question:
        look = {AGAIN: "look at feed and knife again, and go on with what they say", END: ENDS}
        return Question(error.code, f"{error} {error.why}".strip(), CUT_ANSWERS if self.known.doubtful else look)

    def _settle(self, choice: str) -> None:
        if choice == ACCEPT:
            self._accept_thickness()
        if choice in (DONE, NOT_DONE):
            said = "cut_done" if choice == DONE else "cut_not_done"
            self._note({"e": said, "section": self.known.section, "by": "operator"})
        self._look_again()

    def _look_again(self) -> None:
        """Let the driver find out what it can; what still is wrong shows in the next command."""
        if self._microtome is not None:
            try:
                self._microtome.resolve()
            except DeviceError as error:
                self._write({"e": "fault", "code": error.code, "message": str(error)})

    def _feed(self, section: int) -> None:
        target_nm = self._depth_nm(section)
        if self.known.feed is Act.BEGUN:
            self._recover_feed(section, self._place_nm, target_nm)
        if self.known.feed is Act.PENDING:
            self._note({"e": "feed_intent", "section": section, "target_nm": target_nm})
            self._feed_axis.advance_to(target_nm)
            self._note({"e": "feed_done", "section": section, "readback_nm": self._feed_axis.position_nm()})
        self._judge_thickness(section)

    def _judge_thickness(self, section: int) -> None:
        """Raise `Doubt` if the section is of another thickness than planned; noted, and accepted if that was said."""
        plan, cut = self._plan, self._plan.cut(section)
        if plan.tolerance_nm is None:
            return
        try:
            check_thickness(self.known, plan.thickness_nm.nm(cut), plan.tolerance_nm.nm(cut))
        except Doubt as doubt:
            figures = {"fed_nm": self.known.fed_nm}
            told = {"section": section, "finding": str(Finding.THICKNESS), "words": doubt.question.words}
            self._write({"e": "verdict", **told, "planes": [], "figures": figures})
            if not self._accepts_thickness:
                raise
            self._accept_thickness()

    def _accept_thickness(self) -> None:
        self._note({"e": "accepted", "section": self.known.section, "finding": str(Finding.THICKNESS)})

    def _recover_feed(self, section: int, previous_nm: float, target_nm: float) -> None:
        here_nm = self._resting_nm()
        act = judge_feed(here_nm, previous_nm, target_nm, self._behind_nm)
        said = "feed_done" if act is Act.DONE else "feed_not_done"
        self._note({"e": said, "section": section, "readback_nm": here_nm, "recovered": True})

    def _cut(self, section: int) -> None:
        assert self._microtome is not None
        if self.known.cut is Act.BEGUN:
            self._recover_cut(section)
        if self.known.cut is Act.PENDING:
            self._bring_to_depth()
            begin_s, before = self._clock.now(), self._feed_axis.cut_count()
            self._note({"e": "cut_intent", "section": section, "cuts_before": before})
            self._microtome.arm()
            self._stroke(section)
            took_s = round(self._clock.now() - begin_s, 3)
            after = self._feed_axis.cut_count()
            self._note({"e": "cut_done", "section": section, "cuts_after": after, "duration_s": took_s})

    def _stroke(self, section: int) -> None:
        """Cut; when the knife fails on its way, note that its counter alone does not tell what became of the face."""
        try:
            self._feed_axis.cut()
        except (FeedHalted, FeedUndecided, KnifeFailed) as error:
            self._note({"e": "cut_doubtful", "section": section, "code": error.code, "message": str(error)})
            raise

    def _recover_cut(self, section: int) -> None:
        """Find out whether a cut that was begun was made."""
        knife, counted = self._resting_knife()
        act = judge_cut(knife, counted, self.known.cuts_before, doubtful=self.known.doubtful)
        said = "cut_done" if act is Act.DONE else "cut_not_done"
        self._note({"e": said, "section": section, "cuts_after": counted, "recovered": True})

    def _clear(self, section: int) -> None:
        """Bring the knife out if it is not, the feed to its depth if a stroke left it behind, and look twice."""
        if self._microtome is not None and self._feed_axis.knife_state() is not KnifeState.CLEAR:
            self._microtome.abort()
            self._microtome.resolve()
        self._bring_to_depth()
        self._check_clear()
        self._clock.sleep(CLEAR_TWICE_S)
        self._check_clear()
        knife, z_um = str(self._feed_axis.knife_state()), self._stage.position_um()
        self._note({"e": "clear", "section": section, "knife": knife, "z_um": z_um})

    def _check_clear(self) -> None:
        state = self._feed_axis.knife_state()
        if state is not KnifeState.CLEAR:
            raise Unsafe(f"knife: it is {state}, not clear. The stage stays parked.", fix="look at the knife.")

    def _check_parked(self, z_um: float) -> None:
        if abs(to_nm(z_um) - self._plan.park_nm) > PARK_TOLERANCE_NM:
            raise Unsafe(
                f"z stage: it is at {z_um:+.2f} µm, not parked at {to_um(self._plan.park_nm):+.2f} µm. Nothing "
                "was cut.",
                fix="look what moved it, then go on.",
            )

    def _check_place(self) -> None:
        """Raise `Doubt` unless the feed stands where the journal says it was left."""
        check_place(self._resting_nm(), self._place_nm)

    def _check_still_parked(self) -> None:
        """Raise `Doubt` unless the stage reads what it read when feed and knife were begun: it was parked then."""
        check_still_parked(to_nm(self._stage.position_um()), self._plan.park_nm, PARK_TOLERANCE_NM)

    def _bring_to_depth(self) -> None:
        """Bring a feed that a stroke left drawn back to its depth again; raise `Doubt` if it is anywhere else."""
        place_nm, here_nm = self._place_nm, self._resting_nm()
        if self._microtome and place_nm - self._behind_nm <= here_nm < place_nm - SAME_PLACE_NM:
            self._microtome.approach_to(place_nm)
            here_nm = self._resting_nm()
        check_place(here_nm, place_nm)

    def _resting_nm(self) -> float:
        """Return where the feed stands once it stands still, and let its driver take note of it.

        A driver that was opened while feed or knife still moved does not let them move again until it has looked.
        """
        before_nm = self._feed_axis.position_nm()
        for _ in range(REST_LOOKS):
            self._clock.sleep(REST_S)
            here_nm = self._feed_axis.position_nm()
            if here_nm == before_nm:
                if isinstance(self._feed_axis, Microtome):
                    self._feed_axis.resolve()
                return here_nm
            before_nm = here_nm
        raise DeviceError("feed: it does not come to rest.", fix="stop it: stereotome section stop")

    def _resting_knife(self) -> tuple[KnifeState, int]:
        """Return what the knife says once it says the same twice, so long apart that a stroke would have begun."""
        before = (self._feed_axis.knife_state(), self._feed_axis.cut_count())
        for _ in range(REST_LOOKS):
            self._clock.sleep(KNIFE_REST_S)
            now = (self._feed_axis.knife_state(), self._feed_axis.cut_count())
            if now == before and now[0] is not KnifeState.CUTTING:
                return now
            before = now
        raise DeviceError("knife: its stroke does not end.", fix="look at the knife: stereotome section show")

    @property
    def _behind_nm(self) -> float:
        return max(self._microtome.behind_nm, self._plan.sweep_nm) if self._microtome else 0.0


def _microtome(plan: SectionPlan, feed: Feed) -> Microtome | None:
    """Return the feed as one with a knife, if the plan cuts."""
    if plan.removal == "polish":
        return None
    if not isinstance(feed, Microtome):
        raise PlanError("the feed has no knife.", fix='add [microtome.knife], or set sections.removal = "polish".')
    return feed


def _clean_question(section: int) -> Question:
    return Question(
        "clean", f"Section {section} is polished. Clean the face.", {DONE: "it is clean: take its image", END: ENDS}
    )
