"""What an instrument process answers, and what it tells everybody."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import Struct


class Reply(Struct, frozen=True, kw_only=True, tag=str.lower):
    """Base of what the instrument answers and tells."""


class Welcome(Reply, frozen=True, kw_only=True, tag="welcome"):
    """Answer to `Hello`.

    Attributes
    ----------
    instrument : str
        Its name, as in its file.
    epoch : str
        To be sent with every further request.
    program : str
        Version of the program.
    pid : int
        Of the instrument process.
    stage_limits_um : (float, float)
        Soft limits of the z stage.
    """

    instrument: str
    epoch: str
    program: str
    pid: int
    stage_limits_um: tuple[float, float]


class Lease(Reply, frozen=True, kw_only=True, tag="lease"):
    """The right to command: the token to send, and how long it lasts without a word from its holder."""

    token: str
    lasts_s: float


class Done(Reply, frozen=True, kw_only=True, tag="done"):
    """It was done."""


class Working(Reply, frozen=True, kw_only=True, tag="working"):
    """It is being done, or waits for its turn; ask again by the same number."""


class Failed(Reply, frozen=True, kw_only=True, tag="failed"):
    """It was not done, or not to its end: an error as in docs/errors.md."""

    code: str
    what: str
    why: str = ""
    fix: tuple[str, ...] = ()
    exit_code: int = 1


class Position(Reply, frozen=True, kw_only=True, tag="position"):
    """Where the z stage rests, in µm, read back."""

    z_um: float


class Depth(Reply, frozen=True, kw_only=True, tag="depth"):
    """Where the feed stands, in nm, and how many strokes the knife has counted."""

    depth_nm: float
    cuts: int


class Picture(Reply, frozen=True, kw_only=True, tag="picture"):
    """One frame: rows of pixels, and where and when it was taken."""

    shape: tuple[int, ...]
    dtype: Literal["uint8", "uint16"]
    pixels: bytes
    z_um: float
    exposure_ms: float
    utc_ns: int


class Started(Reply, frozen=True, kw_only=True, tag="started"):
    """A run began.

    Attributes
    ----------
    number : int
        Counts the runs of this instrument process from 1.
    folder : str
        Where its data goes, on the instrument's disk.
    planned : int
        Planes.
    """

    number: int
    folder: str
    planned: int


class InstrumentView(Reply, frozen=True, kw_only=True, tag="instrument-view"):
    """What the instrument is: the tables of its file, as of `devices.rig.RigSpec`."""

    tables: dict[str, Any]


class Planned(Reply, frozen=True, kw_only=True, tag="planned"):
    """What a recipe would do and cost.

    Attributes
    ----------
    folder : str
        Where a run would put its data if it began now.
    planes, sections, planes_each : int
        Planes in all, sections (or points in time), planes of one stack.
    first_um, last_um, step_um : float
        Of one stack.
    seconds, dose_s : float
        Time from start to end; light on one face.
    bytes_on_disk, needed_bytes, free_bytes : int
        Size as if nothing could be compressed, what has to be free with margin and reserve, what is free.
    """

    folder: str
    planes: int
    sections: int
    planes_each: int
    first_um: float
    last_um: float
    step_um: float
    seconds: float
    dose_s: float
    bytes_on_disk: int
    needed_bytes: int
    free_bytes: int


class Stopped(Reply, frozen=True, kw_only=True, tag="stopped"):
    """What was told to stop, and what could not be told, in words."""

    told: tuple[str, ...]
    failed: tuple[str, ...] = ()


class Question(Reply, frozen=True, kw_only=True, tag="question"):
    """What a run on HOLD wants to know: a stable code, words for people, and what each choice does."""

    code: str
    words: str
    answers: dict[str, str]


class RunView(Reply, frozen=True, kw_only=True, tag="run-view"):
    """A run as observers see it.

    Attributes
    ----------
    number : int
        Counts the runs of this instrument process from 1.
    state, phase : str
        As in docs/run.md.
    section, sections, plane : int
        Section in work, from 0, and how many are planned; plane in work.
    planned, taken, durable, missed : int
        Planes: in all, exposed, verified on disk, recorded as missing.
    pausing : str
        The scope of a pause asked for, empty when none.
    question : Question or None
        What the operator has to decide; of a run that ended as HELD, what was asked.
    left_s : float or None
        Estimate of the time left.
    error : Failed or None
        Why it ended as FAILED.
    warnings : tuple of str
        What its observers said, once it is over.
    """

    number: int
    name: str
    folder: str
    state: str
    phase: str
    section: int
    sections: int
    plane: int
    planned: int
    taken: int
    durable: int
    missed: int
    pausing: str = ""
    question: Question | None = None
    left_s: float | None = None
    error: Failed | None = None
    warnings: tuple[str, ...] = ()


class FeedView(Reply, frozen=True, kw_only=True, tag="feed-view"):
    """Feed and knife as they were read last."""

    state: str
    depth_nm: float
    knife: str
    cuts: int


class State(Reply, frozen=True, kw_only=True, tag="state"):
    """How things stand; also the value of the topic ``state``.

    Attributes
    ----------
    state : str
        ``IDLE``, or the state of the run.
    z_um : float or None
        Where the stage was read last; None before.
    z_age_s : float
        How long ago that was.
    live : bool
        Whether live frames are shown.
    ring : str
        File of shared memory in which frames appear; empty when none do.
    camera : str
        What its frames are: ``"512 x 512 uint16"``.
    holder : str
        Who commands; empty when nobody.
    stopped : bool
        Motion is refused until `ClearStop`.
    why_stopped : str
        Why, where nobody asked for it.
    run : RunView or None
        The run under way, or the last one.
    """

    state: str
    z_um: float | None
    z_age_s: float
    live: bool
    exposure_ms: float
    ring: str
    camera: str
    holder: str
    stopped: bool
    run: RunView | None = None
    feed: FeedView | None = None
    utc_ns: int = 0
    why_stopped: str = ""


class Event(Reply, frozen=True, kw_only=True, tag="event"):
    """Something that happened in a run; the value of the topic ``run``. What must not be lost is in the journal."""

    event: dict[str, Any]


class Preview(Reply, frozen=True, kw_only=True, tag="preview"):
    """A frame made small for looking at it; the value of the topic ``preview``.

    Attributes
    ----------
    jpeg : bytes
        The picture; grey levels from ``black`` to ``white`` of the frame span its own.
    number : int
        Of the frame in its ring.
    shape : tuple of int
        Of the frame itself.
    """

    jpeg: bytes
    number: int
    section: int
    plane: int
    z_um: float
    shape: tuple[int, ...]
    black: int
    white: int
    utc_ns: int


class Values(Reply, frozen=True, kw_only=True, tag="values"):
    """Topics of the telemetry with the number and the value last sent on each."""

    values: dict[str, tuple[int, State | Event]]


AnyReply = (
    Welcome
    | Lease
    | Done
    | Working
    | Failed
    | Position
    | Depth
    | Picture
    | Planned
    | Started
    | Stopped
    | State
    | Values
    | InstrumentView
)
Told = State | Event | Preview


class Telling(Struct, frozen=True):
    """What goes out on a topic; ``number`` counts per topic, so that a reader knows newer from older."""

    number: int
    told: Told
