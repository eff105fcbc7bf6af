"""Going on with a run that ended early: only the same run, on the same instrument. The view: `acquire.same_view`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.recipe import Recipe
from acquire.run_plan import RunPlan, plan_from
from acquire.store import RunEnd, is_run, open_run
from devices.errors import InputError, PlanError, StoreError, Unsafe

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store import StoredRun
    from devices.rig import RigSpec
    from devices.values import CameraCaps

SAME = ("name", "optics")  # what makes an instrument the same, beside its limits and its camera's frames


def interrupted_run(folder: Path, recipe: Recipe | None) -> StoredRun:
    """Open a run to go on with.

    Raises
    ------
    InputError
        The folder is no run of this program, or nothing is missing from it.
    PlanError
        ``recipe`` is given and is not the one the run was started with.
    StoreError
        Another process writes it, or its plan was changed.
    """
    if not is_run(folder):
        raise InputError(f"{folder} is not a run folder.", why="It has no run.json and journal.jsonl.", code="no-run")
    stored = open_run(folder)
    if stored.state is RunEnd.RUNNING:
        raise StoreError(f"{folder} is being written by another run.", fix="wait for it to end", code="run-busy")
    if "recipe" not in stored.manifest:
        raise InputError(
            f"{folder} was imported: it has no recipe to go on with.",
            fix="import it anew with what was missing",
            code="imported-run",
        )
    if not resumable(stored):
        raise InputError(f"{folder}: nothing is missing that can still be taken.", code="nothing-missing")
    if recipe is not None and recipe != stored_recipe(stored):
        raise PlanError(
            f"{folder} was started with another recipe.",
            why="A run is finished as it was planned, or not at all.",
            fix=("leave the recipe out: the run has its own", "start a new run with the new recipe"),
            code="other-recipe",
        )
    if stored_plan(stored).plan_id != stored.manifest["plan_id"]:
        raise StoreError(f"{folder}: the plan in run.json was changed.", code="plan-changed")
    return stored


def resumable(stored: StoredRun) -> bool:
    """Tell whether there is something left to do: of a section whose successor is cut, nothing can be taken."""
    if stored.state is RunEnd.INTERRUPTED:
        return True
    if stored_plan(stored).commits:
        return stored.committed < stored.layout.sections
    return bool(stored.missing)


def stored_recipe(stored: StoredRun) -> Recipe:
    """Return the recipe a run was started with."""
    return Recipe.model_validate(stored.manifest["recipe"])


def stored_plan(stored: StoredRun) -> RunPlan:
    """Return the plan of a run."""
    return plan_from(stored.manifest["plan"])


def check_same_instrument(stored: StoredRun, spec: RigSpec, caps: CameraCaps) -> None:
    """Raise `Unsafe` unless the instrument is the one the run was taken with."""
    now = spec.model_dump(mode="json", by_alias=True)
    then: dict[str, Any] = stored.manifest["instrument"]
    differs = [key for key in SAME if now[key] != then[key]]
    if now["stage"]["z"]["limits"] != then["stage"]["z"]["limits"]:
        differs.append("stage.z.limits")
    if (caps.shape, caps.dtype) != (stored.layout.shape, stored.layout.dtype):
        differs.append("the camera's frames")
    if differs:
        raise Unsafe(
            f"this is not the instrument of {stored.folder}: {', '.join(differs)} differ.",
            why="Planes of two instruments do not make one stack. Nothing moved.",
            fix="connect the instrument of the run, or start a new run",
            code="other-instrument",
        )
