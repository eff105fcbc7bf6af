"""All the console knows and does, without a window: panels draw it, keys and buttons call it, tests drive it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from acquire import replies, requests
from acquire.state import FINAL, RunState
from devices.clock import SystemClock
from devices.errors import StereotomeError
from display.console import contrast as grey
from display.console.alarms import SOUND, Alarms, sound
from display.console.camera_work import CameraWork
from display.console.files import FileEditor
from display.console.flipping import Flipping
from display.console.journal import words_of
from display.console.knife_work import KnifeWork
from display.console.monitor import Monitor
from display.console.moving import Jogger, Marks
from display.console.placing import Placing, enlarged
from display.console.run_queue import RunQueue, queue_file
from display.console.settings import settings_folder
from display.console.stack_form import Advice, StackForm, advice, form_of
from display.console.sticks import Stick
from display.console.viewing import LIVE, REVIEW, VIEWS, Viewing

if TYPE_CHECKING:
    from devices.protocols import Clock
    from devices.rig import RigSpec
    from display.console.bench import Bench
    from display.console.drawn import Line
    from display.console.eyes import Eyes
    from display.console.journal import Journal
    from display.console.settings import Settings
    from display.console.setup import Setup
    from display.console.tour import Tour

PLAN_EVERY_S = 5.0
FORM_EVERY_S = 0.2
TOP_OF_UNKNOWN = 4095


class Console:
    """What is shown and what can be done; used by the window's thread alone.

    Attributes
    ----------
    planned : Planned or StereotomeError or None
        What the form's recipe would cost, or why it cannot be carried out; None before the first answer.
    notice : str
        What was refused last, in words, beside the stage.
    reviewing : bool
        The review before a start is open.
    line : ((x, y), (x, y)) or None
        Two pixels of the live picture between which grey levels are plotted.
    viewing : Viewing
        What the review shows.
    shows, front : str
        Which of the panels with pictures was drawn last, and which is to come to the front.
    """

    def __init__(
        self, bench: Bench, eyes: Eyes, journal: Journal, settings: Settings, clock: Clock | None = None
    ) -> None:
        self.bench = bench
        self.eyes = eyes
        self.journal = journal
        self.settings = settings
        self.contrast = grey.Contrast(
            gamma=settings.gamma,
            table=settings.table,
            paint=settings.paint,
            ignored_percent=settings.ignored_percent,
        )
        self.stick = Stick(settings.stick_um_s)
        self.in_front = True
        self.files = FileEditor()
        self.queue = RunQueue()
        self.alarms = Alarms(journal, self._alarm)
        self.shows_alarms = False
        self.flipping = Flipping(journal, lambda: bench.rig)
        self.camera = CameraWork(self)
        self.knife = KnifeWork(self)
        self.monitor = Monitor()
        self.placing = Placing()
        self.line: Line | None = None
        self.viewing = Viewing()
        self.shows = self.front = ""
        self.full_screen = False
        self.jogger = Jogger(chosen=min(max(settings.jog, 0), 4))
        self.form = StackForm(folder=settings.folder, operator=settings.operator, notify=settings.notify)
        self.notice = ""
        self.planned: replies.Planned | StereotomeError | None = None
        self.reviewing = False
        self.shows_keys = False
        self.tour: Tour | None = None
        self.setup: Setup | None = None
        self.target_um = 0.0
        self.measured = ""
        self.pause_scope = "plane"
        self.clock = clock or SystemClock()
        self._folder = settings_folder()
        self._fits_first = True
        self._advised_for: RigSpec | None = None
        self._advice: Advice | None = None
        self._planned_for = ""
        self._planned_s = float("-inf")
        self._planning = False
        self._form_looked_s = float("-inf")

    # How things stand

    @property
    def state(self) -> replies.State | None:
        """The instrument as told last."""
        return self.bench.state

    @property
    def run(self) -> replies.RunView | None:
        """The run under way, or the last one."""
        state = self.state
        return None if state is None else state.run

    @property
    def running(self) -> bool:
        """Whether a run has the devices."""
        state = self.state
        return state is not None and state.state != RunState.IDLE

    @property
    def stopped(self) -> bool:
        """Whether STOP is latched, here or at the instrument."""
        state = self.state
        return self.bench.stop_asked or (state is not None and state.stopped)

    @property
    def top(self) -> int:
        """The largest grey level of the frames, before the first that of the instrument file."""
        return self.told_top if self.eyes.seen is None else self.eyes.seen.histogram.top

    @property
    def told_top(self) -> int:
        """The largest grey level by the instrument file."""
        return TOP_OF_UNKNOWN if self.bench.rig is None else (1 << self.bench.rig.camera.bit_depth) - 1

    @property
    def limits_um(self) -> tuple[float, float] | None:
        """Soft limits of the stage."""
        if self.bench.rig is None:
            return None
        limits = self.bench.rig.stage.z.soft_limits
        return limits.min_um, limits.max_um

    @property
    def advice(self) -> Advice | None:
        """What the optics say about the distance of planes."""
        rig = self.bench.rig
        if rig is not self._advised_for:  # asked in every frame
            self._advised_for, self._advice = rig, None if rig is None else advice(rig)
        return self._advice

    @property
    def feed(self) -> replies.FeedView | None:
        """Feed and knife as read last; None without them."""
        state = self.state
        return None if state is None else state.feed

    def why_no_motion(self) -> str:
        """Return why nothing can be moved by hand now; empty when it can."""
        if not self.bench.connected:
            return "the instrument does not answer"
        if self.stopped:
            return "STOP is latched: release it first"
        if self.running:
            return "a run has the devices"
        if not self.bench.commands:
            holder = self.state.holder if self.state is not None else ""
            return f"{holder or 'nobody'} commands, not this console"
        return ""

    def why_no_start(self) -> str:
        """Return why no run can be started now; empty when one can."""
        if words := self.why_no_motion():
            return words
        if self.form.sections.wanted and not self.form.marks.complete:
            return "set both marks first: the stage is parked while sections are cut, a stack around it would be empty"
        if self.planned is None:
            return "the plan is being made"
        if isinstance(self.planned, StereotomeError):
            return words_of(self.planned)
        short = self.planned.needed_bytes - self.planned.free_bytes
        return f"the disk is too full by {short / 1e9:.2f} GB" if short > 0 else ""

    # Every frame

    def tick(self) -> None:
        """Do what is due: take answers, send what wheel and keys asked for, plan what the form says."""
        self.bench.settle()
        self.alarms.tick()
        self._keep_queue()
        self.queue.tick(self)
        self._follow()
        self._monitor()
        self._stick_due()
        self._jog_due()
        self._plan_due()
        if self.tour is not None:
            self.tour.tick(self)

    def _keep_queue(self) -> None:
        """Take over the queue of this instrument with the command over it, and keep it in a file from then on."""
        rig = self.bench.rig
        if rig is None or not self.bench.commands:
            self.queue.leave()
            return
        try:
            self.queue.keep(queue_file(self._folder, rig.name))
        except OSError as error:
            self.journal.add("error", "queue", f"it cannot be kept: {error}")

    def _follow(self) -> None:
        seen = self.eyes.seen
        if seen is None:
            return
        if self._fits_first:
            self._fits_first, self.contrast = False, grey.fitted(self.contrast, seen.histogram)
        self.contrast = grey.followed(self.contrast, seen.histogram)

    def _monitor(self) -> None:
        """Watch the pictures of a run; previews from afar cannot be judged."""
        seen, run = self.eyes.seen, self.run if self.running else None
        if self.eyes.afar:
            return
        words = self.monitor.rest(seen) if run is None or seen is None else self.monitor.take(seen, run)
        if words:
            self.journal.add("error", "monitor", words)
            if self.monitor.pauses and self.bench.commands and run is not None and run.state == RunState.RUNNING:
                self.bench.ask(requests.PauseRun(scope="before_cut" if self.monitor.of_sections else "plane"), "run")

    def _stick_due(self) -> None:
        why_not = self.why_no_motion() or ("" if self.in_front else "the console's window is not in front")
        self.stick.tick(self.jogger, self.clock.now(), why_not)

    def _jog_due(self) -> None:
        if self.jogger.wanted_um and (words := self.why_no_motion()):
            self.jogger.forget()
            self.refuse(f"{words}. Nothing moved.")
        if by_um := self.jogger.due_um():
            self._move(requests.JogStage(by_um=by_um))

    def _plan_due(self) -> None:
        now_s = self.clock.now()
        if now_s - self._form_looked_s < FORM_EVERY_S:
            return
        self._form_looked_s = now_s
        text = self.form.recipe()
        old = self.clock.now() - self._planned_s > PLAN_EVERY_S and not self.running
        if self._planning or not self.bench.connected or (text == self._planned_for and not old):
            return
        self._planning, self._planned_for, self._planned_s = True, text, self.clock.now()
        self.bench.ask(requests.PlanRun(recipe=text, name="the form"), "plan", self._plan_made, quiet=True)

    def _plan_made(self, answer: replies.AnyReply | StereotomeError) -> None:
        self._planning = False
        if isinstance(answer, replies.Planned | StereotomeError):
            self.planned = answer

    # STOP

    def stop(self) -> None:
        """Stop all motion now; latches."""
        self.jogger.forget()
        self.stick.block()
        self.bench.stop()

    def release_stop(self) -> None:
        """Allow motion again: an act of its own."""
        self.bench.stop_asked, self.notice = False, ""
        self.bench.ask(requests.ClearStop(), "STOP")

    # The stage

    def jog(self, steps: float, *, faster: bool = False) -> None:
        """Ask for steps; they add up while a move is under way."""
        self.jogger.jog(steps, faster=faster)

    def go(self, z_um: float) -> None:
        """Go to a position."""
        if words := self.why_no_motion():
            self.refuse(f"{words}. Nothing moved.")
        else:
            self.jogger.under_way = True
            self._move(requests.MoveStage(z_um=z_um))

    def park(self) -> None:
        """Go where the objective is out of the way."""
        rig = self.bench.rig
        if rig is not None and rig.stage.z.park_um is not None:
            self.go(rig.stage.z.park_um)

    def zero(self) -> None:
        """Call this place 0 µm; the marks no longer hold."""
        self.form.marks = Marks()
        self.bench.ask(requests.ZeroStage(), "stage")

    def mark(self, end: str) -> None:
        """Set the ``top`` or the ``bottom`` of the stack where the stage is."""
        if self.state is not None and self.state.z_um is not None:
            setattr(self.form.marks, f"{end}_um", round(self.state.z_um, 3))

    def visit(self, end: str) -> None:
        """Go to the ``top`` or the ``bottom`` set before."""
        z_um = getattr(self.form.marks, f"{end}_um")
        if z_um is not None:
            self.go(z_um)

    def _move(self, request: requests.MoveStage | requests.JogStage) -> None:
        self.notice = ""
        self.bench.ask(request, "stage", self._moved)

    def _moved(self, answer: replies.AnyReply | StereotomeError) -> None:
        self.jogger.done()
        if isinstance(answer, StereotomeError):
            self.jogger.forget()
            self.stick.block()
            self.notice = "STOP ended this move." if self.stopped else words_of(answer)

    def refuse(self, words: str) -> None:
        """Say beside the stage what is not done, and why."""
        self.notice = words[0].upper() + words[1:]

    def auto_contrast(self) -> None:
        """Fit the contrast to the newest frame, once."""
        if self.eyes.seen is not None:
            self.contrast = replace(grey.fitted(self.contrast, self.eyes.seen.histogram), auto="off")

    # Runs

    def start_run(self) -> None:
        """Begin what the form says."""
        self.reviewing = False
        if words := self.why_no_start():
            self.journal.add("error", "run", f"not started: {words}")
            return
        self.notice = ""
        self.bench.ask(requests.StartRun(recipe=self.form.recipe(), name="the form"), "run")

    def queue_run(self) -> None:
        """Let what the form says wait for its turn."""
        self.queue.add(self.form.name, self.form.recipe())

    def fill_form(self, text: str) -> str:
        """Put what a recipe says into the form; return in words what came of it."""
        try:
            self.form = form_of(text)
        except StereotomeError as error:
            return f"{error.what} The form is as it was. {' '.join(error.fix)}"
        return "it is in the form now"

    def continue_run(self, folder: str) -> None:
        """Take what a run that ended early lacks."""
        self.bench.ask(requests.ContinueRun(folder=folder), "run")

    def pause(self) -> None:
        """Have the run wait at the boundary chosen."""
        self.bench.ask(requests.PauseRun(scope=self.pause_scope), "run")  # type: ignore[arg-type]

    def resume(self) -> None:
        """Let the run go on."""
        self.bench.ask(requests.ResumeRun(), "run")

    def run_or_pause(self) -> None:
        """Open the review before a start, pause, or go on: what comes next."""
        state = self.state.state if self.state is not None else ""
        if state == RunState.PAUSED:
            self.resume()
        elif state == RunState.RUNNING:
            self.pause()
        elif not self.running:
            self.reviewing = True

    def abort(self) -> None:
        """End the run after the exposure in work; the stage goes back, what was taken is kept."""
        self.bench.ask(requests.CancelRun(), "run")

    def answer(self, choice: str) -> None:
        """Answer what the run asks."""
        self.bench.ask(requests.AnswerRun(choice=choice), "run")

    def note(self, text: str) -> None:
        """Write a note into the journal of the run."""
        self.bench.ask(requests.NoteRun(text=text), "notes")

    def can_continue(self) -> bool:
        """Whether the last run ended with planes missing, and no run is under way."""
        run = self.run
        return run is not None and not self.running and run.state in FINAL and run.durable < run.planned

    # Looking

    @property
    def last_run(self) -> str:
        """Folder of the last run, once it is over; empty before."""
        return self.run.folder if self.run is not None and not self.running else ""

    def view(self, number: int) -> None:
        """Bring a view to the front, 1 the live picture, the others of the run looked at, else of the last."""
        view = VIEWS[number - 1]
        self.front = LIVE if view == LIVE else REVIEW
        if view != LIVE:
            if not self.viewing.folder and self.last_run:
                self.viewing.open(self.last_run)
            self.viewing.kind(view)

    def nearer(self, steps: float) -> None:
        """Enlarge the picture in front around its middle."""
        if self.shows == REVIEW:
            self.viewing.nearer(steps)
        else:
            self.placing = enlarged(self.placing, steps)

    def across(self) -> None:
        """Draw a line through the middle of the picture in front, to measure along; again for none."""
        if self.shows == REVIEW:
            self.viewing.across()
        elif self.line is not None or self.eyes.seen is None:
            self.line = None
        else:
            height, width = self.eyes.seen.pixels.shape[:2]
            self.line = ((0, height // 2), (width - 1, height // 2))

    def glasses_test(self) -> None:
        """Show each eye its name through the shutter glasses, or no more."""
        if self.flipping.shows:
            self.flipping.end()
        else:
            self.flipping.begin("eyes")

    def alarms_seen(self) -> None:
        """Show the alarms nobody has seen; when they are shown, note that they are seen."""
        if self.shows_alarms:
            self.alarms.seen()
        self.shows_alarms = bool(self.alarms.unseen) and not self.shows_alarms

    def _alarm(self) -> None:
        if self.settings.sound:
            sound(self._folder / SOUND)

    def remember(self) -> None:
        """Put what is chosen now into the settings."""
        for name in ("gamma", "table", "paint", "ignored_percent"):
            setattr(self.settings, name, getattr(self.contrast, name))
        self.settings.stick_um_s = self.stick.top_um_s
        self.settings.jog = self.jogger.chosen
        for name in ("folder", "operator", "notify"):
            setattr(self.settings, name, getattr(self.form, name))
