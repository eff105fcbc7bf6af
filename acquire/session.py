"""One run from recipe to folder: checks everything first, then joins instrument, ring, store, observers and engine."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.autofocus import Focus, focus_of
from acquire.engine import Policy, Run, RunState
from acquire.estimate import Estimate, estimate
from acquire.interlock import guarded
from acquire.observe import Observer, known_observer
from acquire.ome_zarr import FocalArray
from acquire.planning import pace_of, plan_run
from acquire.quality import quality_of
from acquire.recorder import Recorder, disk_errors, disk_full, ring_slots, size
from acquire.report import write_report
from acquire.resume import check_same_instrument, stored_plan, stored_recipe
from acquire.ring import RingWriter, shared_memory_folder
from acquire.ring_janitor import sweep_stale
from acquire.same_view import check_same_view
from acquire.sequence import check_triggered
from acquire.standing import Standing, standing
from acquire.state import Scope
from acquire.store import RunStore, free_bytes, open_run
from acquire.verdict import no_inspection
from acquire.watch import Notifier, RunLog, all_of
from devices.bands import choose_bands, switch_band
from devices.clock import SystemClock
from devices.errors import InputError, PlanError, StereotomeError
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.recipe import Recipe
    from acquire.run_plan import RunPlan
    from acquire.state import Question, RunStatus
    from acquire.store import StoredRun
    from acquire.verdict import Inspect
    from devices.protocols import Clock
    from devices.rig import Rig, RigSpec
    from devices.values import CameraCaps

SHARED_TIME = SystemClock()  # of ring and recorder: other processes and threads wait on the same, whatever the run's is
DISK_MARGIN = 1.05
OBSERVER_START_S = 30.0
OBSERVER_END_S = 300.0
OBSERVER_RESULTS = "focus"


@dataclass(frozen=True)
class Outcome:
    """How a session ended: the engine's last state, its error, where the data is, and what observers said."""

    state: RunState
    error: StereotomeError | None
    folder: Path
    durable: int
    planned: int
    warnings: tuple[str, ...]
    held: Question | None = None


def run_folder(recipe: Recipe, spec: RigSpec, out: Path | None, now: datetime) -> Path:
    """Return the folder of a new run: ``out``, or the recipe's template filled in; never one that exists.

    Raises
    ------
    InputError
        ``out`` exists already.
    PlanError
        The template has a name in braces that is not known.
    """
    if out is not None:
        if out.exists():
            raise InputError(
                f"{out} exists already. Nothing was started.",
                why="A run never writes into a folder that holds something.",
                fix="choose another folder: --out DIR",
                code="output-exists",
            )
        return out
    return next(folder for folder in _candidates(recipe, spec, now) if not folder.exists())


def _candidates(recipe: Recipe, spec: RigSpec, now: datetime) -> Iterator[Path]:
    template = recipe.output.folder
    fields = {
        "date": f"{now:%Y-%m-%d}",
        "time": f"{now:%H%M%S}",
        "name": recipe.name,
        "operator": recipe.operator,
        "instrument": spec.name,
    }
    for run in range(1, 1_000_000):
        try:
            filled = template.format(run=run, **fields)
        except (KeyError, ValueError, IndexError):
            raise PlanError(
                f"output.folder = {template!r} cannot be filled in.",
                fix="use only {date} {time} {name} {run} {operator} {instrument}; {run} may have a format such as :03d",
            ) from None
        yield Path(filled) if "{run" in template or run == 1 else Path(f"{filled}-{run}")


def needed_bytes(plan_bytes: int, keep_free_gb: float) -> int:
    """Return the free bytes a run asks for before it starts."""
    return round(plan_bytes * DISK_MARGIN + keep_free_gb * 1e9)


def check_disk(folder: Path, cost: Estimate, keep_free_gb: float) -> None:
    """Raise `StoreError` unless the disk holds the whole run and its reserve."""
    free = free_bytes(folder.absolute())
    if free < needed_bytes(cost.bytes_on_disk, keep_free_gb):
        raise disk_full(
            f"the run needs {size(cost.bytes_on_disk * DISK_MARGIN)} plus {size(keep_free_gb * 1e9)} reserve; "
            f"{size(free)} is free.",
            why="Nothing was started.",
        )


def problems(checks: list[Callable[[], object]]) -> list[StereotomeError]:
    """Run every check and return all that failed, so that a user mends them in one go."""
    found = []
    for check in checks:
        try:
            check()
        except StereotomeError as error:
            found.append(error)
    return found


def cost_of(plan: RunPlan, spec: RigSpec, caps: CameraCaps | None) -> Estimate:
    """Return what a plan costs; without a connected camera the frame size of the instrument file is taken."""
    if caps is not None:
        return estimate(plan, caps.frame_bytes, pace_of(spec))
    width, height = spec.camera.size_px or (0, 0)
    return estimate(plan, width * height * (1 if spec.camera.bit_depth == 8 else 2), pace_of(spec))


@dataclass(frozen=True)
class Options:
    """What whoever starts a session may choose, beside the recipe.

    Attributes
    ----------
    inspect : callable or None
        Looks at each section before the next is cut; see `acquire.verdict`. None: `acquire.quality`, as the recipe
        says.
    attended : bool
        Somebody may answer questions; without, a question ends the run as HELD.
    answers : tuple of str
        Given beforehand to the questions to come.
    """

    inspect: Inspect | None = no_inspection
    attended: bool = True
    answers: tuple[str, ...] = ()


class Session:
    """A run ready to start: `execute` does everything and returns; all else may be called from any thread.

    Made by `new_session` or `resumed_session`.

    Attributes
    ----------
    plan : RunPlan
        What is taken.
    folder, ring_path : Path
        Where it goes, and the ring in which its frames appear.
    run : Run
        The engine.
    """

    def __init__(
        self,
        recipe: Recipe,
        rig: Rig,
        plan: RunPlan,
        make_store: Callable[[CameraCaps], RunStore],
        clock: Clock,
        tell: Callable[[dict[str, Any]], None],
        *,
        options: Options = Options(),
        stored: StoredRun | None = None,
    ) -> None:
        self.plan = plan
        rig = guarded(rig, clock)
        triggered = recipe.stack.trigger == "hardware"
        if triggered:
            check_triggered(plan.stack, rig.stage, rig.camera)
        for name in recipe.process.observers:
            known_observer(name)
        rig.camera.configure(exposure_ms=plan.exposure_ms(0))  # what it refuses is known before anything is written
        caps = rig.camera.caps()
        sweep_stale(shared_memory_folder())
        with ExitStack() as undo, disk_errors():
            waits = not (triggered or plan.at_camera_rate)
            slots = ring_slots(caps.frame_bytes, free_bytes(shared_memory_folder()), camera_waits=waits)
            ring = RingWriter.create("run", caps.shape, caps.dtype, slots, clock=SHARED_TIME)
            undo.callback(ring.close)
            store = make_store(caps)
            undo.callback(store.close)
            keep_free = round(recipe.output.keep_free_gb * 1e9)
            recorder = Recorder(store, ring, SHARED_TIME, keep_free_bytes=keep_free)
            undo.pop_all()
        self.folder = store.folder
        self._log = RunLog(store.folder)
        tell = self._tell = all_of(tell, self._log.hear, Notifier(recipe.watch.notify, recipe.name).hear)
        self.ring_path = ring.path
        self._observers = _start_observers(recipe, ring.path, store.folder)
        self.run = Run(
            plan,
            rig.stage,
            rig.camera,
            recorder,
            clock,
            feed=rig.feed,
            policy=_policy(recipe, options, triggered=triggered),
            done=store.durable_planes,
            committed=0 if stored is None else stored.committed,
            known=Standing() if stored is None else standing(stored.records),
            inspect=options.inspect or quality_of(recipe, caps),
            focus=Focus() if stored is None else focus_of(stored.records),
            switch_band=_band_switch(plan, rig),
            reopen_camera=rig.reopen_camera,
            utc_ns=time.time_ns,
            tell=tell,
        )

    @property
    def status(self) -> RunStatus:
        """Where the run stands now."""
        return self.run.status

    def pause(self, scope: Scope = Scope.PLANE) -> None:
        """Pause at the end of the plane, stack or section in work, or before the next cut."""
        self.run.pause(scope)

    def resume(self) -> None:
        """Go on after `pause`."""
        self.run.resume()

    def cancel(self) -> None:
        """End after the exposure or cut in progress; what was taken is kept."""
        self.run.cancel()

    def stop(self) -> None:
        """End and stop all motion at once."""
        self.run.stop()

    def answer(self, choice: str) -> None:
        """Answer the question of a run on HOLD."""
        self.run.answer(choice)

    def note(self, text: str) -> None:
        """Put a note of the operator's into the journal."""
        self.run.note(text)

    def execute(self) -> Outcome:
        """Take everything, wait for the observers, and return how it ended."""
        warnings = [
            f"{observer.name} is late: it will catch up from the disk."
            for observer in self._observers
            if not observer.wait_until_ready(OBSERVER_START_S)
        ]
        self._tell({"event": "start", "folder": str(self.folder), "planned": len(self.plan)})
        state = self.run.execute()
        warnings += [said for observer in self._observers if (said := observer.finish(OBSERVER_END_S))]
        status = self.run.status
        self._tell({"event": "ended", "state": str(state), "durable": status.durable, "planned": status.planned})
        warnings += self._write_report()
        self._log.close()
        return Outcome(
            state, self.run.error, self.folder, status.durable, status.planned, tuple(warnings), self.run.held
        )

    def _write_report(self) -> list[str]:
        """Tell the story of the run; return what kept it from being told."""
        try:
            write_report(open_run(self.folder))
        except (OSError, StereotomeError) as error:
            return [f"no report was written: {error}"]
        return []


def _policy(recipe: Recipe, options: Options, *, triggered: bool) -> Policy:
    sections = recipe.sections
    if sections is None:
        gap = recipe.stack.on_plane_error == "gap"
        return Policy(gap_on_error=gap, triggered=triggered, attended=options.attended, answers=options.answers)
    return Policy(
        gap_on_error=sections.on_error == "continue",
        asks=sections.on_error != "park-and-stop",
        attended=options.attended,
        answers=options.answers,
        accepts=sections.accepts,
    )


def _band_switch(plan: RunPlan, rig: Rig) -> Callable[[int], None]:
    """Return what takes on a band of the plan by its number; the camera is not armed then."""
    bands = choose_bands(rig.spec.band, [band.name for band in plan.bands])
    return lambda number: switch_band(rig.camera, bands[number], plan.exposure_ms(number))


def new_session(
    recipe: Recipe,
    rig: Rig,
    folder: Path,
    clock: Clock,
    tell: Callable[[dict[str, Any]], None],
    options: Options = Options(),
) -> Session:
    """Make ready a run in a folder of its own; raises if the disk cannot hold it."""
    here_um = rig.stage.position_um() if recipe.stack.starts_here else 0.0
    plan = plan_run(recipe, rig.spec, here_um)

    def make_store(caps: CameraCaps) -> RunStore:
        check_disk(folder, cost_of(plan, rig.spec, caps), recipe.output.keep_free_gb)
        manifest = _manifest(recipe, rig.spec, plan, caps)
        return RunStore.create(folder, manifest, _layout(plan, recipe, rig.spec, caps), clock)

    return Session(recipe, rig, plan, make_store, clock, tell, options=options)


def resumed_session(
    stored: StoredRun,
    rig: Rig,
    clock: Clock,
    tell: Callable[[dict[str, Any]], None],
    options: Options = Options(),
) -> Session:
    """Make ready the rest of a run that ended early.

    Raises
    ------
    Unsafe
        The instrument, the view or the stage's zero is not that of the run.
    """
    recipe, plan = stored_recipe(stored), stored_plan(stored)
    rig.camera.configure(exposure_ms=plan.exposure_ms(0))
    caps = rig.camera.caps()
    check_same_instrument(stored, rig.spec, caps)
    rest = replace(cost_of(plan, rig.spec, caps), bytes_on_disk=len(stored.missing) * caps.frame_bytes)
    check_disk(stored.folder, rest, recipe.output.keep_free_gb)
    plan.check(rig.stage.limits)
    compared = check_same_view(stored, guarded(rig, clock), clock)

    def make_store(_: CameraCaps) -> RunStore:
        store = RunStore.reopen(stored.folder, clock)
        if compared is not None:
            store.journal.append(compared.record)
        return store

    if compared is not None and compared.doubt:
        tell({"event": "warn", "plane": compared.slot or 0, "code": "z-not-compared", "message": compared.doubt})
    return Session(recipe, rig, plan, make_store, clock, tell, options=options, stored=stored)


def _start_observers(recipe: Recipe, ring: Path, folder: Path) -> list[Observer]:
    process = recipe.process
    named = [Observer(name, ring, folder, folder / name, {}) for name in process.observers]
    if not process.wanted:
        return named
    options: dict[str, Any] = process.focus_options
    if process.stereo_pair is not None:
        options["angle_deg"] = process.stereo_pair.angle_deg
    name = "focus" if process.stereo_pair is None else "stereo"
    return [Observer(name, ring, folder, folder / OBSERVER_RESULTS, options), *named]


def _layout(plan: RunPlan, recipe: Recipe, spec: RigSpec, caps: CameraCaps) -> FocalArray:
    return FocalArray(
        planned=len(plan),
        shape=caps.shape,
        dtype=caps.dtype,
        start_um=to_um(plan.stack.start_nm),
        step_um=to_um(plan.stack.step_nm),
        pixel_um=spec.object_pixel_um,
        compression=recipe.output.compression,
        sections=plan.times,
        channels=tuple(band.name for band in plan.bands),
        colours=tuple(band.colour for band in choose_bands(spec.band, [band.name for band in plan.bands])),
        interval_s=None if plan.series is None else (plan.series.interval_ms or plan.stack.exposure_ms) / 1000,
    )


def _manifest(recipe: Recipe, spec: RigSpec, plan: RunPlan, caps: CameraCaps) -> dict[str, Any]:
    return {
        "name": recipe.name,
        "created_utc": datetime.now(UTC).isoformat(),
        "software": f"stereotome {version('stereotome')}",
        "plan_id": plan.plan_id,
        "plan": plan.canonical(),
        "camera": {"name": caps.name, "bit_depth": caps.bit_depth, "timed": caps.timed},
        "recipe": recipe.model_dump(mode="json", by_alias=True),
        "instrument": spec.model_dump(mode="json", by_alias=True),
    }
