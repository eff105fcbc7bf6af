"""An instrument process from a script: everything a console can ask, in plain calls.

::

    with Instrument.connect() as instrument:
        instrument.command("ann")
        instrument.move(12.5)
        pixels, z_um = instrument.snap()
        instrument.start_run(Path("recipe.toml"))
        print(instrument.wait_for_run().state)
"""

from __future__ import annotations

import getpass
import json
import threading
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from acquire import replies, requests
from acquire.client_io import SILENT_S, Wires
from acquire.keys import ClientKeys
from acquire.meeting import CHANNELS, Meeting, ServerGone, find_meeting
from acquire.preview_viewer import PreviewViewer
from acquire.state import FINAL
from acquire.viewer import RingViewer
from devices.clock import SystemClock
from devices.errors import DeviceBusy, InputError, StereotomeError
from devices.feed_errors import undecided
from devices.rig import RigSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from devices.protocols import Clock

R = TypeVar("R", bound=replies.Reply)


class Instrument:
    """An instrument served by another process, on this or another computer; may be used by any thread.

    Every call waits for its answer and raises the error the instrument tells, with its code as in docs/errors.md. A
    call whose answer is lost on the way is asked again under the same number and is carried out once.
    """

    def __init__(self, meeting: Meeting, *, keys: ClientKeys | None = None, clock: Clock | None = None) -> None:
        self.meeting = meeting
        self._keys = keys
        self._clock = clock or SystemClock()
        self._state: replies.State | None = None
        self._heard_s = self._clock.now()
        self._run_number = 0
        self._changed = threading.Condition()
        self._listeners: list[Callable[[replies.Told], None]] = []
        self._wires = Wires(meeting, self._clock, self._told, keys=keys)
        try:
            self.welcome = self._call(requests.Hello(), replies.Welcome)
        except BaseException:
            self._wires.close()
            raise
        self._wires.epoch = self.welcome.epoch

    @classmethod
    def connect(cls, name: str | Path | None = None, *, keys: Path | None = None) -> Self:
        """Connect to an instrument process.

        Parameters
        ----------
        name : str, Path or None
            The instrument's name, a connection file, or ``"tcp://HOST:PORT"``; None for the only one served here.
        keys : Path, optional
            Folder with this client's keys, for an instrument on another computer.

        Raises
        ------
        ServerGone
            Nobody answers.
        KeysError
            The keys are missing or not admitted.
        """
        meeting = _afar(name) if isinstance(name, str) and name.startswith("tcp://") else find_meeting(name)
        return cls(meeting, keys=None if keys is None else ClientKeys(keys))

    @property
    def state(self) -> replies.State:
        """How things stand, as told last; asks only before the first telling."""
        return self._state or self._call(requests.GetState(), replies.State)

    @property
    def told(self) -> replies.State | None:
        """How things stand, as told last; None before the first telling. Asks nothing."""
        return self._state

    def refresh(self) -> replies.State:
        """Ask how things stand now."""
        self._state = self._call(requests.GetState(), replies.State)
        return self._state

    @property
    def silent_s(self) -> float:
        """Time since the instrument was heard last, in s; it tells its state at least once a second."""
        return self._clock.now() - self._heard_s

    def listen(self, listener: Callable[[replies.Told], None]) -> None:
        """Have every state and event told from now on, in the client's own thread; the listener must be quick."""
        self._listeners.append(listener)

    def wait_for(self, wanted: Callable[[replies.State], bool], timeout_s: float) -> replies.State:
        """Return the first state that is wanted.

        Raises
        ------
        ServerGone
            The instrument fell silent, or the state did not come in time.
        """
        deadline = self._clock.now() + timeout_s
        with self._changed:
            while self._state is None or not wanted(self._state):
                left_s = deadline - self._clock.now()
                if left_s <= 0 or self.silent_s > SILENT_S:
                    raise ServerGone("the state waited for did not come.", why=f"It is {self._state}.")
                self._changed.wait(min(left_s, 1.0))
            return self._state

    def wait_for_change(self, timeout_s: float) -> None:
        """Wait until something is told, at most for so long."""
        with self._changed:
            self._changed.wait(timeout_s)

    def command(self, actor: str = "", *, wait_s: float = 0.0) -> None:
        """Become the one who commands; needed by everything that changes something, except `stop`.

        Parameters
        ----------
        actor : str
            Who asks, told to others; the user's name when left out.
        wait_s : float
            How long to wait for another to give it back, or to fall silent.

        Raises
        ------
        DeviceBusy
            Somebody else commands (``lease-held``).
        """
        deadline = self._clock.now() + wait_s
        while True:
            try:
                lease = self._call(requests.TakeLease(actor=actor or getpass.getuser()), replies.Lease)
            except DeviceBusy:
                if self._clock.now() >= deadline:
                    raise
                self._clock.sleep(0.2)
            else:
                self._wires.lease = lease.token
                return

    def release(self) -> None:
        """Let somebody else command."""
        self._call(requests.ReleaseLease(), replies.Done)
        self._wires.lease = ""

    @property
    def commands(self) -> bool:
        """Whether this client commands, as far as it knows."""
        return bool(self._wires.lease)

    def stop(self) -> replies.Stopped:
        """Stop all motion now and end the run; anyone may. Motion is refused until `clear_stop`."""
        return self._call(requests.Stop(), replies.Stopped)

    def clear_stop(self) -> None:
        """Allow motion again after a stop."""
        self._call(requests.ClearStop(), replies.Done)

    def move(self, z_um: float) -> float:
        """Bring the stage to a position in µm and return where it rests."""
        return self._call(requests.MoveStage(z_um=z_um), replies.Position).z_um

    def jog(self, by_um: float) -> float:
        """Bring the stage further by a distance in µm and return where it rests."""
        return self._call(requests.JogStage(by_um=by_um), replies.Position).z_um

    def zero(self) -> None:
        """Call the stage's present place 0 µm."""
        self._call(requests.ZeroStage(), replies.Position)

    def picture(self) -> replies.Picture:
        """Take one frame, with where, when and how it was taken."""
        return self._call(requests.Snap(), replies.Picture)

    def snap(self) -> tuple[np.ndarray, float]:
        """Take one frame: its pixels, (height, width[, bands]) uint8 or uint16, and z in µm."""
        picture = self.picture()
        pixels = np.frombuffer(picture.pixels, picture.dtype).reshape(picture.shape)
        return pixels, picture.z_um

    def start_live(self, frames_per_s: float = 30.0) -> None:
        """Show frames as they come."""
        self._call(requests.StartLive(frames_per_s=frames_per_s), replies.Done)

    def stop_live(self) -> None:
        """Show no more."""
        self._call(requests.StopLive(), replies.Done)

    def set_camera(self, exposure_ms: float, roi: tuple[int, int, int, int] | None = None) -> None:
        """Set the exposure and, if given, the part of the frame: x, y, width, height in pixels."""
        self._call(requests.SetCamera(exposure_ms=exposure_ms, roi=roi), replies.Done)

    def viewer(self) -> RingViewer:
        """Return a viewer of the newest frames in full, through shared memory; on the instrument's own computer."""
        return RingViewer(lambda: self.state.ring, self._clock)

    def previews(self) -> PreviewViewer:
        """Return a viewer of small pictures of the newest frames, a few a second; from any computer."""
        return PreviewViewer(self.meeting.endpoints["preview"], self._keys)

    def approach(self, depth_um: float) -> replies.Depth:
        """Bring the block near the knife."""
        return self._call(requests.ApproachSection(depth_um=depth_um), replies.Depth)

    def home_feed(self) -> replies.Depth:
        """Let the feed search its reference: it may travel its whole length."""
        return self._call(requests.HomeFeed(), replies.Depth)

    def retract_knife(self) -> replies.Depth:
        """Bring the knife out without a further feed."""
        return self._call(requests.RetractKnife(), replies.Depth)

    def feed(self, thickness_nm: float, *, expect_section: int) -> replies.Depth:
        """Feed forward by one section; refused unless the knife has counted ``expect_section`` strokes."""
        return self._removing(requests.FeedSection(thickness_nm=thickness_nm, expect_section=expect_section))

    def arm_knife(self) -> None:
        """Allow one cut within the next 10 s."""
        self._call(requests.ArmKnife(), replies.Done)

    def cut(self, *, expect_section: int) -> replies.Depth:
        """Take one section with the armed knife; refused unless it has counted ``expect_section`` strokes."""
        return self._removing(requests.CutSection(expect_section=expect_section))

    def instrument(self) -> RigSpec:
        """Return what the instrument is."""
        tables = self._call(requests.GetInstrument(), replies.InstrumentView).tables
        return RigSpec.model_validate_json(json.dumps(tables))  # from JSON, as a list there may be a tuple

    def plan_run(
        self, recipe: Path | str, *, overrides: Sequence[str] = (), out: Path | None = None
    ) -> replies.Planned:
        """Say what `start_run` would do and cost; nothing moves."""
        text, name = _recipe(recipe)
        folder = None if out is None else str(out)
        asked = requests.PlanRun(recipe=text, name=name, overrides=tuple(overrides), out=folder)
        return self._call(asked, replies.Planned)

    def note(self, text: str) -> None:
        """Write a note into the journal of the run under way."""
        self._call(requests.NoteRun(text=text), replies.Done)

    def start_run(
        self, recipe: Path | str, *, overrides: Sequence[str] = (), out: Path | None = None
    ) -> replies.Started:
        """Begin what a recipe says: a file, or its text. Paths in it are the instrument's."""
        text, name = _recipe(recipe)
        folder = None if out is None else str(out)
        return self._began(requests.StartRun(recipe=text, name=name, overrides=tuple(overrides), out=folder))

    def continue_run(self, folder: Path) -> replies.Started:
        """Take what a run that ended early lacks."""
        return self._began(requests.ContinueRun(folder=str(folder)))

    def pause(self, scope: str = "plane") -> None:
        """Have the run wait at the next boundary: plane, stack, section or before_cut."""
        self._call(requests.PauseRun(scope=scope), replies.Done)  # type: ignore[arg-type]

    def resume(self) -> None:
        """Let the run go on."""
        self._call(requests.ResumeRun(), replies.Done)

    def cancel(self) -> None:
        """End the run after the exposure in progress."""
        self._call(requests.CancelRun(), replies.Done)

    def answer(self, choice: str) -> None:
        """Answer what the run asks: one of ``state.run.question.answers``."""
        self._call(requests.AnswerRun(choice=choice), replies.Done)

    def wait_for_run(self, timeout_s: float = float("inf")) -> replies.RunView:
        """Wait until the run started here, or the one under way, is over and return how it ended."""
        number = self._run_number

        def over(state: replies.State) -> bool:
            run = state.run
            return run is not None and state.state == "IDLE" and run.number >= number and run.state in FINAL

        run = self.wait_for(over, timeout_s).run
        assert run is not None
        return run

    def ask(self, request: requests.AnyRequest, *, wait_s: float = 10.0) -> Future[replies.AnyReply]:
        """Ask without waiting, for programs that have something else to do; see `acquire.messages`."""
        return self._wires.ask(request, wait_s=wait_s)

    def close(self) -> None:
        """Leave; the instrument goes on, and who commanded no longer does."""
        try:
            if self._wires.lease and self.silent_s < SILENT_S:
                self.release()
        except StereotomeError:  # it is gone, or somebody else commands
            self._wires.lease = ""
        finally:
            self._wires.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _call(self, request: requests.AnyRequest, kind: type[R]) -> R:
        reply = self._wires.ask(request).result()
        if not isinstance(reply, kind):
            raise InputError(f"the instrument answered a {type(request).__name__} with {reply}.", code="serve-request")
        return reply

    def _removing(self, request: requests.FeedSection | requests.CutSection) -> replies.Depth:
        """Ask for a feed or cut; one of which no answer came may have been made or not, and is not asked for again."""
        try:
            return self._call(request, replies.Depth)
        except ServerGone as gone:
            what = "feed" if isinstance(request, requests.FeedSection) else "cut"
            raise undecided(f"the instrument process was told to {what} once", gone) from gone

    def _began(self, request: requests.StartRun | requests.ContinueRun) -> replies.Started:
        started = self._call(request, replies.Started)
        self._run_number = started.number
        return started

    def _told(self, told: replies.Told) -> None:
        with self._changed:
            self._heard_s = self._clock.now()
            if isinstance(told, replies.State):
                self._state = told
            self._changed.notify_all()
        for listener in self._listeners:
            listener(told)


def _afar(address: str) -> Meeting:
    """Return where an instrument on another computer is: four ports from the one given on."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not port.isdecimal():
        raise InputError(f"{address} names no port.", fix="write tcp://HOST:PORT", code="usage")
    endpoints = {channel: f"tcp://{host}:{int(port) + index}" for index, channel in enumerate(CHANNELS)}
    return Meeting(instrument=address, pid=0, endpoints=endpoints, key="")


def _recipe(recipe: Path | str) -> tuple[str, str]:
    if isinstance(recipe, str):
        return recipe, "recipe"
    try:
        return recipe.read_text(encoding="utf-8"), str(recipe)[-200:]
    except (OSError, UnicodeDecodeError) as cause:
        raise InputError(f"{recipe}: cannot be read as text: {cause}", fix="check the name") from None
