"""The command ``stereotome run``."""

from __future__ import annotations

import json
import queue
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from acquire.bench import instrument_spec, opened
from acquire.engine import FINAL, RunState
from acquire.estimate import timed_steps
from acquire.planning import pace_of, plan_run
from acquire.progress import progress
from acquire.recipe import Recipe, load_recipe
from acquire.recorder import size
from acquire.remote_session import remote_session, served_instrument
from acquire.resume import interrupted_run
from acquire.run_plan import Kind
from acquire.session import (
    Options,
    Outcome,
    Session,
    check_disk,
    cost_of,
    new_session,
    problems,
    resumed_session,
    run_folder,
)
from acquire.store import RunEnd, is_run, open_run
from acquire.terminal import Terminal
from acquire.useq_file import is_useq, read_useq
from acquire.watchdog import watched
from acquire.words import ranges, took
from devices.clock import SystemClock
from devices.errors import InputError, StereotomeError
from devices.rig import open_rig
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from acquire.estimate import Estimate, TimedStep
    from acquire.remote_session import RemoteSession
    from acquire.run_plan import RunPlan
    from acquire.state import Question
    from acquire.store import StoredRun
    from devices.rig import Rig, RigSpec

ENDED_EARLY, STOPPED, DISK, ON_HOLD = 9, 7, 6, 11
CLOCK = SystemClock()
RIG_TABLES = ("camera", "optics", "stage", "sim")


def run(
    recipe: Path | None = None,
    *,
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    sim: Annotated[bool, Parameter(negative="")] = False,
    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    out: Path | None = None,
    resume: Path | None = None,
    transcript: Path | None = None,
    dry_run: Annotated[bool, Parameter(negative="")] = False,
    yes: Annotated[bool, Parameter(name=["--yes", "-y"], negative="")] = False,
    on_hold: Literal["ask", "end"] | None = None,
    server: Annotated[bool | str, Parameter(negative="")] = False,
    answer: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    json_: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Take a stack as a recipe says, or say with --dry-run what would be taken or what a run folder lacks.

    Parameters
    ----------
    recipe
        The recipe file, or a useq-schema MDASequence in YAML or JSON; with --dry-run also the folder of a run.
    instrument
        The instrument file.
    sim
        Take the simulated bench in place of the hardware.
    set_
        Replace a value of the recipe or the instrument: --set stack.step=0.5
    out
        Folder of the run; must not exist. Without it the recipe's output.folder.
    resume
        Folder of a run that ended early: take what it lacks. The run has its own recipe.
    transcript
        Folder in which every exchange with the devices is recorded.
    dry_run
        List what would be done, and all problems at once; nothing moves.
    yes
        Start without asking.
    on_hold
        What becomes of a question of the run: ask at the terminal, or end the run, to be gone on with by --resume.
        Without it: ask if there is a terminal.
    server
        Have a running `stereotome serve` take it: --server, or --server=NAME. So it is anyhow when the instrument is
        being served.
    answer
        An answer given beforehand to the next question, and to the one after it: --answer again --answer not-done
    json_
        Write one JSON object a line to standard output.
    """
    if recipe is not None and recipe.is_dir():
        return _describe(recipe, dry_run=dry_run, as_json=json_)
    on_rig = tuple(given for given in set_ if given.startswith(RIG_TABLES))
    on_recipe = tuple(given for given in set_ if given not in on_rig)
    loaded = None if recipe is None else read_useq(recipe) if is_useq(recipe) else load_recipe(recipe, on_recipe)
    stored = None if resume is None else interrupted_run(resume, loaded)
    tell = _json_line if json_ else _nothing
    options = Options(
        inspect=None, attended=(sys.stdin.isatty() if on_hold is None else on_hold == "ask"), answers=answer
    )
    events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with ExitStack() as stack:
        served = None if sim or dry_run else served_instrument(stack, server, instrument)
        if served is not None:
            _check_remote(on_rig, transcript)
            remote = remote_session(served, recipe, resume, set_, out, events.put)
            return _report(_execute(remote, events, tell, quiet=json_, attended=options.attended), tell)
        cuts = loaded is not None and loaded.sections is not None
        spec = instrument_spec(stack, instrument, on_rig, sim=sim, block=cuts)
        if dry_run and loaded is not None:
            return _dry_run(loaded, spec, out, tell)
        if stored is not None:
            session = _resumed(stack, stored, spec, transcript, events.put, options)
        else:
            rig = partial(opened, spec, CLOCK, transcript, home=sim)
            session = _new(stack, _given(loaded), spec, out, rig, events.put, options, ask=not yes)
        if spec.microtome is not None:
            stack.enter_context(watched(spec, CLOCK, session.run.stop))
        outcome = _execute(session, events, tell, quiet=json_, attended=options.attended)
    return _report(outcome, tell)


def _check_remote(on_rig: Sequence[str], transcript: Path | None) -> None:
    """Raise `InputError` for what only who opens the instrument can choose."""
    if on_rig or transcript is not None:
        raise InputError(
            "the instrument is being served: its own values and transcripts are chosen there.",
            fix="give --set camera…, optics…, stage… and --transcript to stereotome serve",
            code="usage",
        )


def _given(recipe: Recipe | None) -> Recipe:
    if recipe is None:
        raise InputError("no recipe is given.", fix=("name its file", "go on with a run: --resume RUN"), code="usage")
    return recipe


def _new(
    stack: ExitStack,
    recipe: Recipe,
    spec: RigSpec,
    out: Path | None,
    opened: Callable[[], AbstractContextManager[Rig]],
    tell: Callable[[dict[str, Any]], None],
    options: Options,
    *,
    ask: bool,
) -> Session:
    folder = _ready(recipe, spec, out)
    rig = stack.enter_context(opened())
    _review(recipe, spec, folder, ask=ask)
    return new_session(recipe, rig, folder, CLOCK, tell, options)


def _resumed(
    stack: ExitStack,
    stored: StoredRun,
    spec: RigSpec,
    transcript: Path | None,
    tell: Callable[[dict[str, Any]], None],
    options: Options,
) -> Session:
    rig = stack.enter_context(open_rig(spec, clock=CLOCK, transcript=transcript))
    sys.stderr.write(f"going on with {stored.folder}; missing: {ranges(stored.missing)}\n")
    return resumed_session(stored, rig, CLOCK, tell, options)


def _ready(recipe: Recipe, spec: RigSpec, out: Path | None) -> Path:
    """Check everything that can be known before a port is opened, and say all that is wrong in one go."""
    now = datetime.now(UTC).astimezone()

    def enough_disk() -> None:
        cost = cost_of(plan_run(recipe, spec), spec, None)
        check_disk(run_folder(recipe, spec, out, now), cost, recipe.output.keep_free_gb)

    found = problems(
        [
            lambda: plan_run(recipe, spec),
            lambda: run_folder(recipe, spec, out, now),
            enough_disk,
        ]
    )
    unique = {error.message(): error for error in found}
    if unique:
        _raise_all(list(unique.values()))
    return run_folder(recipe, spec, out, now)


def _raise_all(found: list[StereotomeError]) -> None:
    for error in found[:-1]:
        sys.stderr.write(error.message() + "\n")
    raise found[-1]


def _review(recipe: Recipe, spec: RigSpec, folder: Path, *, ask: bool) -> None:
    plan = plan_run(recipe, spec)
    sys.stderr.write(f"{recipe.name}: {_summary(plan, cost_of(plan, spec, None))}\n  into {folder}\n")
    if ask and sys.stdin.isatty():
        sys.stderr.write("Start? [Y/n] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() not in {"", "y", "yes"}:
            raise InputError("not started.", why="The review was answered with no.", code="not-started")


def _summary(plan: RunPlan, cost: Estimate) -> str:
    first, *_, last = [plane.z_um for plane in plan.stack] * 2
    disk = f"{size(cost.bytes_on_disk)} at most" if cost.bytes_on_disk else "size known once the camera answers"
    repeated = f"{_repeats(plan)} of " if plan.times > 1 or plan.sections else ""
    return (
        f"{repeated}{plan.stack.count} planes from {first:+.3f} to {last:+.3f} µm, "
        f"step {plan.stack.step_nm / 1000:g} µm, {plan.stack.exposure_ms:g} ms each, about {took(cost.seconds)}, "
        f"{cost.dose_s:.3g} s of light on each face, {disk}"
    )


def _repeats(plan: RunPlan) -> str:
    if plan.sections is None:
        return f"{plan.times} points in time"
    cuts = plan.sections
    return f"{plan.times} sections of {cuts.thickness_nm} nm ({cuts.removals} removals), {cuts.depth_um:g} µm in all,"


def _dry_run(recipe: Recipe, spec: RigSpec, out: Path | None, tell: Callable[[dict[str, Any]], None]) -> int:
    folder = _ready(recipe, spec, out)
    plan = plan_run(recipe, spec)
    for timed in timed_steps(plan, pace_of(spec)):
        tell(_event_of(timed, plan))
        if tell is _nothing:
            sys.stdout.write(_line_of(timed, plan))
    cost = cost_of(plan, spec, None)
    sys.stderr.write(f"{recipe.name}: {_summary(plan, cost)}\n  would go into {folder}; nothing was moved\n")
    return 0


def _event_of(timed: TimedStep, plan: RunPlan) -> dict[str, Any]:
    step = timed.step
    event: dict[str, Any] = {"event": "plan", "do": str(step.kind), "at_s": round(timed.at_s, 2)}
    event |= {"section": step.section} if plan.times > 1 or plan.sections else {}
    event |= {"moves_um": [to_um(target_nm) for target_nm in step.moves_nm]} if step.moves_nm else {}
    event |= {"thickness_nm": step.thickness_nm} if step.kind is Kind.FEED else {}
    if step.kind is Kind.EXPOSE:
        event |= {"plane": step.plane, "band": step.band, "z_um": plan.stack.plane(step.plane).z_um}
    return event


def _line_of(timed: TimedStep, plan: RunPlan) -> str:
    step = timed.step
    route = " then ".join(f"{to_um(target_nm):+.3f}" for target_nm in step.moves_nm)
    where = f"section {step.section:4d}  " if plan.times > 1 or plan.sections else ""
    band = f" in {plan.bands[step.band].name}" if plan.bands else ""
    words = {
        Kind.PARK: f"park at {route} µm",
        Kind.FEED: f"feed {step.thickness_nm} nm",
        Kind.EXPOSE: f"plane {step.plane:4d}  {f'move to {route} µm, ' if route else ''}expose{band}",
    }
    return f"{where}at {timed.at_s:9.1f} s  {words.get(step.kind, str(step.kind))}\n"


@contextmanager
def _operator_signals(session: Session | RemoteSession) -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM end the run after the current plane; a second one stops all motion at once."""
    received: list[int] = []

    def on_signal(signum: int, _frame: object) -> None:
        received.append(signum)
        if len(received) == 1:
            sys.stderr.write("\nending after this plane; once more stops all motion now\n")
            session.run.cancel()
        else:
            session.run.stop()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _execute(
    session: Session | RemoteSession,
    events: queue.SimpleQueue[dict[str, Any]],
    tell: Callable[[dict[str, Any]], None],
    *,
    quiet: bool,
    attended: bool,
) -> Outcome:
    with (
        _operator_signals(session),
        ThreadPoolExecutor(1, "run") as engine,
        progress("planes", len(session.plan), quiet=quiet) as show,
    ):
        terminal = Terminal(session.answer) if attended else None
        result = engine.submit(session.execute)
        while not result.done() or not events.empty():
            if terminal is not None:
                terminal.take_answers()
            try:
                event = events.get(timeout=0.1)
            except queue.Empty:
                continue
            if terminal is not None:
                terminal.heard(event)
            tell(event)
            if event["event"] == "plane":
                show(session.status.taken)
        return result.result()


def _report(outcome: Outcome, tell: Callable[[dict[str, Any]], None]) -> int:
    for warning in outcome.warnings:
        sys.stderr.write(f"warning: {warning}\n")
    assert outcome.state in FINAL
    stored = open_run(outcome.folder)
    missing = stored.missing
    tell({"event": "done", "state": str(outcome.state), "folder": str(outcome.folder), "missing": missing})
    if tell is _nothing:
        sys.stdout.write(f"{outcome.folder}\n")
    if outcome.error is not None:
        sys.stderr.write(outcome.error.message() + "\n")
    if outcome.held is not None:
        sys.stderr.write(_held(outcome.held, outcome.folder))
    sys.stderr.write(f"{outcome.state}: {_kept(outcome.durable, outcome.planned, missing)}\n")
    return _exit_code(outcome)


def _held(question: Question, folder: Path) -> str:
    """Say what a run waits for."""
    choices = "".join(f"   or: {choice}: {meaning}\n" for choice, meaning in question.answers.items())
    return f"hold[{question.code}]: {question.words}\n{choices}  fix: go on and answer: --resume {folder}\n"


def _kept(durable: int, planned: int, missing: list[int]) -> str:
    words = f"{durable} of {planned} planes are durable and verified"
    return f"{words}; missing: {ranges(missing)}" if missing else words


def _exit_code(outcome: Outcome) -> int:
    match outcome.state:
        case RunState.COMPLETED:
            return 0
        case RunState.COMPLETED_WITH_GAPS:
            return ENDED_EARLY
        case RunState.HELD:
            return DISK if outcome.held is not None and outcome.held.code == "disk-full" else ON_HOLD
        case RunState.CANCELLED:
            return STOPPED if outcome.durable else 130
        case _:
            return _failure_code(outcome)


def _failure_code(outcome: Outcome) -> int:
    """Return 6 for a full disk whatever was kept, 9 for any other failure once there is data to keep."""
    code = 1 if outcome.error is None else outcome.error.exit_code
    return ENDED_EARLY if outcome.durable and code != 6 else code


def _describe(folder: Path, *, dry_run: bool, as_json: bool) -> int:
    """Say what a run folder holds and what it lacks."""
    if not is_run(folder):
        raise InputError(f"{folder} is not a run folder.", why="It has no run.json and journal.jsonl.", code="no-run")
    if not dry_run:
        raise InputError(
            f"{folder} is a run, not a recipe.",
            fix=(f"see what it lacks: stereotome run --dry-run {folder}", f"go on with it: --resume {folder}"),
            code="is-run",
        )
    stored = open_run(folder)
    if stored.state is not RunEnd.RUNNING:
        stored.publish()
    durable, planned = len(stored.planes), stored.layout.planned
    if as_json:
        _json_line(
            {
                "event": "plan",
                "folder": str(folder),
                "state": str(stored.state),
                "planned": planned,
                "durable": durable,
                "missing": stored.missing,
                "missed": {str(plane): reason for plane, reason in stored.missed.items()},
            }
        )
    else:
        sys.stdout.write(f"{stored.state}: {_kept(durable, planned, stored.missing)}\n")
        for plane, reason in sorted(stored.missed.items()):
            sys.stdout.write(f"  plane {plane} could not be taken: {reason}\n")
    return 0


def _json_line(event: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(event, ensure_ascii=False) + "\n")
    sys.stdout.flush()


def _nothing(_: dict[str, Any]) -> None:
    """Tell nobody."""
