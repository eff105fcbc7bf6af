"""What a client may ask of an instrument process."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta, Struct

Name = Annotated[str, Meta(max_length=200)]
Words = Annotated[str, Meta(max_length=4000)]
Lane = Literal["at once", "motion", "camera", "run"]


class Request(Struct, frozen=True, kw_only=True, tag=str.lower):
    """Base of what a client may ask.

    Attributes
    ----------
    expect_state : str or None
        Refuse unless the run, or the bench without one (``"IDLE"``), is in this state.
    expect_section : int or None
        Refuse unless this is the section in work; without a run, the number of strokes the knife has counted.
    """

    needs_lease: ClassVar[bool] = True
    lane: ClassVar[Lane] = "at once"

    expect_state: Name | None = None
    expect_section: int | None = None


class Hello(Request, frozen=True, kw_only=True, tag="hello"):
    """Who is there? The only request that needs no epoch."""

    needs_lease: ClassVar[bool] = False


class GetState(Request, frozen=True, kw_only=True, tag="get-state"):
    """How do things stand? Answered by `State`."""

    needs_lease: ClassVar[bool] = False


class GetInstrument(Request, frozen=True, kw_only=True, tag="get-instrument"):
    """What are you? Answered by `InstrumentView`."""

    needs_lease: ClassVar[bool] = False


class GetValues(Request, frozen=True, kw_only=True, tag="get-values"):
    """The last value of every topic of the telemetry; answered by `Values`."""

    needs_lease: ClassVar[bool] = False


class TakeLease(Request, frozen=True, kw_only=True, tag="take-lease"):
    """Ask to be the one who commands; answered by `Lease`."""

    needs_lease: ClassVar[bool] = False
    actor: Name


class KeepLease(Request, frozen=True, kw_only=True, tag="keep-lease"):
    """I am still there."""


class ReleaseLease(Request, frozen=True, kw_only=True, tag="release-lease"):
    """Somebody else may command."""


class Snap(Request, frozen=True, kw_only=True, tag="snap"):
    """Take one frame; answered by `Picture`."""

    lane: ClassVar[Lane] = "camera"


class StartLive(Request, frozen=True, kw_only=True, tag="start-live"):
    """Show frames as they come, at most ``frames_per_s``."""

    lane: ClassVar[Lane] = "camera"
    frames_per_s: Annotated[float, Meta(gt=0, le=1000)] = 30.0


class StopLive(Request, frozen=True, kw_only=True, tag="stop-live"):
    """Show no more frames."""

    lane: ClassVar[Lane] = "camera"


class SetCamera(Request, frozen=True, kw_only=True, tag="set-camera"):
    """Set the exposure and, if given, the part of the frame: x, y, width, height in pixels."""

    lane: ClassVar[Lane] = "camera"
    exposure_ms: Annotated[float, Meta(gt=0)]
    roi: tuple[int, int, int, int] | None = None


class MoveStage(Request, frozen=True, kw_only=True, tag="move-stage"):
    """Go to a position and rest there; answered by `Position`."""

    lane: ClassVar[Lane] = "motion"
    z_um: float


class JogStage(Request, frozen=True, kw_only=True, tag="jog-stage"):
    """Go by a distance from here; answered by `Position`."""

    lane: ClassVar[Lane] = "motion"
    by_um: float


class ZeroStage(Request, frozen=True, kw_only=True, tag="zero-stage"):
    """Call the present place 0 µm; answered by `Position`."""

    lane: ClassVar[Lane] = "motion"


class ApproachSection(Request, frozen=True, kw_only=True, tag="approach-section"):
    """Feed to an absolute depth in one go; answered by `Depth`."""

    lane: ClassVar[Lane] = "motion"
    depth_um: float


class HomeFeed(Request, frozen=True, kw_only=True, tag="home-feed"):
    """Let the feed search its reference: it may travel its whole length; answered by `Depth`."""

    lane: ClassVar[Lane] = "motion"


class RetractKnife(Request, frozen=True, kw_only=True, tag="retract-knife"):
    """Bring the knife out without a further feed; answered by `Depth`."""

    lane: ClassVar[Lane] = "motion"


class FeedSection(Request, frozen=True, kw_only=True, tag="feed-section"):
    """Feed forward by the thickness of one section; answered by `Depth`. Says which section it means."""

    lane: ClassVar[Lane] = "motion"
    thickness_nm: float
    expect_section: int


class ArmKnife(Request, frozen=True, kw_only=True, tag="arm-knife"):
    """Allow one cut within the next 10 s."""

    lane: ClassVar[Lane] = "motion"


class CutSection(Request, frozen=True, kw_only=True, tag="cut-section"):
    """Take one section with the armed knife, once; answered by `Depth`. Says which section it means."""

    lane: ClassVar[Lane] = "motion"
    expect_section: int


class PlanRun(Request, frozen=True, kw_only=True, tag="plan-run"):
    """What would a recipe cost here and now? Nothing moves; answered by `Planned`. Fields as in `StartRun`."""

    needs_lease: ClassVar[bool] = False
    lane: ClassVar[Lane] = "run"
    recipe: Annotated[str, Meta(max_length=500_000)]
    name: Name = "recipe"
    overrides: tuple[Name, ...] = ()
    out: Words | None = None


class StartRun(Request, frozen=True, kw_only=True, tag="start-run"):
    """Take what a recipe says; answered by `Started`.

    Attributes
    ----------
    recipe : str
        The recipe's text (TOML).
    name : str
        What to call it in messages: usually the file's name.
    overrides : tuple of str
        Values that replace the recipe's: ``"stack.step=0.5"``.
    out : str or None
        Folder of the run; without it the recipe's own.
    """

    lane: ClassVar[Lane] = "run"
    recipe: Annotated[str, Meta(max_length=500_000)]
    name: Name = "recipe"
    overrides: tuple[Name, ...] = ()
    out: Words | None = None


class ContinueRun(Request, frozen=True, kw_only=True, tag="continue-run"):
    """Take what a run that ended early lacks; answered by `Started`."""

    lane: ClassVar[Lane] = "run"
    folder: Words


class PauseRun(Request, frozen=True, kw_only=True, tag="pause-run"):
    """Wait at the next boundary of this kind."""

    lane: ClassVar[Lane] = "run"
    scope: Literal["plane", "stack", "section", "before_cut"] = "plane"


class ResumeRun(Request, frozen=True, kw_only=True, tag="resume-run"):
    """Go on after a pause."""

    lane: ClassVar[Lane] = "run"


class CancelRun(Request, frozen=True, kw_only=True, tag="cancel-run"):
    """End the run after the exposure in progress; what was taken is kept."""

    lane: ClassVar[Lane] = "run"


class AnswerRun(Request, frozen=True, kw_only=True, tag="answer-run"):
    """Answer the question upon which a run holds."""

    lane: ClassVar[Lane] = "run"
    choice: Name


class NoteRun(Request, frozen=True, kw_only=True, tag="note-run"):
    """Write a note into the journal of the run under way."""

    lane: ClassVar[Lane] = "run"
    text: Words


class ClearStop(Request, frozen=True, kw_only=True, tag="clear-stop"):
    """Allow motion again after a stop, once what it halted is at rest."""

    lane: ClassVar[Lane] = "motion"


class Stop(Request, frozen=True, kw_only=True, tag="stop"):
    """Stop all motion now and end the run; needs no lease. Answered by `Stopped`. Goes to a socket of its own."""

    needs_lease: ClassVar[bool] = False


AnyRequest = (
    Hello
    | GetState
    | GetInstrument
    | GetValues
    | TakeLease
    | KeepLease
    | ReleaseLease
    | Snap
    | StartLive
    | StopLive
    | SetCamera
    | MoveStage
    | JogStage
    | ZeroStage
    | ApproachSection
    | HomeFeed
    | RetractKnife
    | FeedSection
    | ArmKnife
    | CutSection
    | PlanRun
    | StartRun
    | ContinueRun
    | PauseRun
    | ResumeRun
    | CancelRun
    | AnswerRun
    | NoteRun
    | ClearStop
    | Stop
)
