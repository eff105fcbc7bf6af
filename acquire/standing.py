"""How far the removal of a section came: what the journal says, and what feed and knife themselves say to it.

Pure functions. A removing command of which only the intent is in the journal is judged by the feed's own reading and
the knife's own counter; when these do not decide, nobody guesses: that is a `Doubt`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from acquire.state import Question
from acquire.verdict import Finding
from devices.feed_values import KnifeState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from acquire.journal import Record

SAME_PLACE_NM = 10.0
AGAIN, DONE, NOT_DONE, ACCEPT, END = "again", "done", "not-done", "accept", "end"
ENDS = "end the run; what was taken is kept"


class Act(StrEnum):
    """How far one command came, as the journal knows it."""

    PENDING = "pending"
    BEGUN = "begun"
    DONE = "done"


CUT_ANSWERS = {
    AGAIN: "look at the knife again, after you have seen to it",
    DONE: "the section is cut: the face is a fresh one",
    NOT_DONE: "it is not cut: the face is the one imaged last; cut it now",
    END: ENDS,
}
SAYS: dict[str, dict[str, Any]] = {
    "feed_intent": {"feed": Act.BEGUN},
    "feed_not_done": {"feed": Act.PENDING},
    "cut_done": {"cut": Act.DONE, "doubtful": False},
    "clean_done": {"cut": Act.DONE},
    "cut_doubtful": {"doubtful": True},
    "cut_not_done": {"cut": Act.PENDING, "doubtful": False},
    "clear": {"cleared": True},
    "sweep_intent": {"cleared": False},
    "answer": {"unanswered": None},
}


class Doubt(Exception):
    """Feed and knife do not say whether a command was executed; the operator has to look.

    Attributes
    ----------
    question : Question
        What to ask.
    """

    def __init__(self, question: Question) -> None:
        super().__init__(question.words)
        self.question = question


@dataclass(frozen=True)
class Standing:
    """What the journal says of the section in work.

    Attributes
    ----------
    section : int
        The section.
    feed, cut : Act
        Of its feed, and of its cut or cleaning.
    cleared : bool
        Its removal is over: knife out, face free.
    cuts_before : int
        What the knife counted before the cut.
    doubtful : bool
        The knife moved, and it failed: that it counted no cut does not mean that it made none.
    origin_nm : float or None
        Where the feed stood when the run began.
    unanswered : Question or None
        What was asked about its feed or cut, and nobody answered.
    depth_nm, before_nm : float or None
        Where the feed read back for it, and for the section before.
    accepted : bool
        Its thickness was accepted as it is.
    """

    section: int = 0
    feed: Act = Act.PENDING
    cut: Act = Act.PENDING
    cleared: bool = False
    cuts_before: int = 0
    doubtful: bool = False
    origin_nm: float | None = None
    unanswered: Question | None = None
    depth_nm: float | None = None
    before_nm: float | None = None
    accepted: bool = False

    @property
    def fed_nm(self) -> float | None:
        """How far the feed went for it, as far as that is known."""
        return None if self.depth_nm is None or self.before_nm is None else self.depth_nm - self.before_nm

    def next(self, section: int) -> Standing:
        """Return what is known of another section before anything was done for it."""
        return Standing(section, origin_nm=self.origin_nm, depth_nm=self.depth_nm)

    def heard(self, record: Record) -> Standing:
        """Return what is known after one more record."""
        section = record.get("section", self.section)
        now = self if section == self.section else self.next(section)
        match record["e"]:
            case "origin":
                return replace(now, origin_nm=record["depth_nm"], depth_nm=record["depth_nm"])
            case "feed_done":
                return replace(now, feed=Act.DONE, before_nm=now.depth_nm, depth_nm=record["readback_nm"])
            case "accepted" if record["finding"] == Finding.THICKNESS:
                return replace(now, accepted=True)
            case "cut_intent":
                return replace(now, cut=Act.BEGUN, cuts_before=record["cuts_before"])
            case "hold" if Act.BEGUN in (now.feed, now.cut):
                return replace(now, unanswered=Question(record["code"], record["question"], record["answers"]))
            case event if event in SAYS:
                return replace(now, **SAYS[event])
            case _:
                return self


NOTHING_REMOVED = Standing()


def standing(records: Iterable[Record]) -> Standing:
    """Return where the removal stands after all these records."""
    now = NOTHING_REMOVED
    for record in records:
        now = now.heard(record)
    return now


def judge_feed(now_nm: float, previous_nm: float, target_nm: float, behind_nm: float) -> Act:
    """Tell from where a resting feed stands whether the feed that was begun was executed.

    Parameters
    ----------
    now_nm : float
        Where it stands.
    previous_nm, target_nm : float
        Where it was before, and where it was sent.
    behind_nm : float
        How far behind its place the driver may have left it, to take up lost motion.

    Raises
    ------
    Doubt
        It stands at neither place.
    """
    if abs(now_nm - target_nm) <= SAME_PLACE_NM:
        return Act.DONE
    if previous_nm - behind_nm - SAME_PLACE_NM <= now_nm <= previous_nm + SAME_PLACE_NM:
        return Act.PENDING
    raise Doubt(
        Question(
            "feed-ambiguous",
            f"The feed stands at {now_nm / 1000:.3f} µm; it was at {previous_nm / 1000:.3f} µm and was sent to "
            f"{target_nm / 1000:.3f} µm. Nothing is fed or cut before it is known why.",
            {AGAIN: "look again, after you have seen to the feed", END: ENDS},
        )
    )


def check_place(here_nm: float, expected_nm: float) -> None:
    """Raise `Doubt` unless the feed stands where it was left."""
    if abs(here_nm - expected_nm) > SAME_PLACE_NM:
        raise Doubt(
            Question(
                "feed-moved",
                f"The feed stands at {here_nm / 1000:.3f} µm, but was left at {expected_nm / 1000:.3f} µm. Somebody "
                "moved it, or its power went off and on. Nothing is fed or cut before it is known why.",
                {AGAIN: "look again, after you have brought it back", END: ENDS},
            )
        )


def check_still_parked(here_nm: float, park_nm: float, tolerance_nm: float) -> None:
    """Raise `Doubt` unless the stage still reads the place where it was parked out of the knife's way."""
    if abs(here_nm - park_nm) > tolerance_nm:
        raise Doubt(
            Question(
                "stage-moved",
                f"The stage reads {here_nm / 1000:+.2f} µm, but was left parked at {park_nm / 1000:+.2f} µm while feed "
                "and knife were at work. Somebody moved it, or its zero is another one now: then neither its park "
                "position nor its planes are where they were.",
                {AGAIN: "look again, after you have brought back its zero and parked it", END: ENDS},
            )
        )


def check_thickness(standing: Standing, thickness_nm: float, tolerance_nm: float) -> None:
    """Raise `Doubt` if the feed read back another thickness than planned, and nobody has accepted it."""
    fed_nm = standing.fed_nm
    if standing.accepted or fed_nm is None or abs(fed_nm - thickness_nm) <= tolerance_nm:
        return
    raise Doubt(
        Question(
            str(Finding.THICKNESS),
            f"The feed went {fed_nm:.0f} nm for section {standing.section}, {thickness_nm:g} nm are planned, "
            f"{tolerance_nm:g} nm off is allowed. Nothing of it is removed yet.",
            {ACCEPT: "go on with it: what was read back is recorded as its thickness", END: ENDS},
        )
    )


def judge_cut(knife: KnifeState, counted: int, before: int, *, doubtful: bool = False) -> Act:
    """Tell from the knife, at rest, whether the cut that was begun was executed.

    With ``doubtful`` the stroke is known to have failed on its way; then only a counted cut decides.

    Raises
    ------
    Doubt
        It is stuck, or its place and its counter do not agree.
    """
    if knife is not KnifeState.JAMMED and counted == before + 1:
        return Act.DONE
    if knife is KnifeState.CLEAR and counted == before and not doubtful:
        return Act.PENDING
    raise Doubt(
        Question(
            "cut-ambiguous",
            f"A cut was begun and nobody knows whether it was made: the knife is {knife} and counted {counted} cuts, "
            f"{before} before. Compare the live image with the last section.",
            CUT_ANSWERS,
        )
    )
