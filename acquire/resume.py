"""Going on with a run that ended early: only the same run, on the same instrument, over the same view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recipe import Recipe
from acquire.run_plan import RunPlan, plan_from
from acquire.snap import snap
from acquire.standing import Act, standing
from acquire.store import RunEnd, is_run, open_run
from devices.bands import choose_bands, switch_band
from devices.errors import InputError, PlanError, StoreError, Unsafe
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store import StoredRun
    from devices.protocols import Clock
    from devices.rig import Rig, RigSpec
    from devices.values import CameraCaps

BIN_PX = 4
SAME_VIEW = 0.6  # correlation of binned pictures; another field of the same specimen stays near 0
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


def check_same_view(stored: StoredRun, rig: Rig, clock: Clock) -> None:
    """Take the last durable plane again and raise `Unsafe` unless it shows the same; a run without planes passes.

    Of a run of sections only a plane of the face that lies free now can be compared. The new picture is compared and
    forgotten; the plane on disk stays as it is.
    """
    slot = _comparable(stored)
    if slot is None:
        return
    plan, header = stored_plan(stored), stored.planes[slot].header
    z_nm = to_nm(header.setpoint_um)  # the focus may have moved since the plan was made
    for target_nm in (z_nm - plan.stack.approach * plan.stack.overshoot_nm, z_nm):
        rig.stage.move_to(to_um(target_nm))
        rig.stage.settle(60.0)
    if plan.bands:
        switch_band(rig.camera, choose_bands(rig.spec.band, [plan.bands[header.band].name])[0], header.exposure_ms)
    picture, _ = snap(rig.camera, clock, header.exposure_ms, header.z_um)
    likeness = correlation(picture, stored.read(slot))
    if not likeness >= SAME_VIEW:
        raise Unsafe(
            f"plane {slot} does not look as it did: correlation {likeness:.2f}, at least {SAME_VIEW:g} is expected.",
            why="The specimen, the light or the focus changed since; later planes would not fit the earlier ones.",
            fix=("bring back the view, then try again", "start a new run"),
            code="other-view",
        )


def _comparable(stored: StoredRun) -> int | None:
    """Return the last durable plane of what lies before the camera now; None if nothing of it was taken."""
    last = max(stored.planes, default=None)
    if last is None or stored_plan(stored).sections is None:
        return last
    now = standing(stored.records)
    face_is_out = now.cleared or now.feed is Act.PENDING
    section = now.section if now.cleared else now.section - 1
    return last if face_is_out and stored.layout.place(last)[0] == section else None


def correlation(live: np.ndarray, stored: np.ndarray) -> float:
    """Return the normalised cross-correlation of two pictures after binning 4x4, which takes most of the noise away.

    Parameters
    ----------
    live, stored : ndarray, shape (y, x) or (y, x, 3), uint8 or uint16

    Returns
    -------
    float
        From -1 to 1; 0 when a picture shows nothing.
    """
    a, b = _binned(live), _binned(stored)
    scale = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    return float(np.sum(a * b)) / scale if scale else 0.0


def _binned(pixels: np.ndarray) -> np.ndarray:
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(np.float64)
    height, width = (max(1, n // BIN_PX) for n in grey.shape)
    cut = grey[: height * BIN_PX, : width * BIN_PX]
    if min(grey.shape) < BIN_PX:
        return np.asarray(grey - grey.mean())
    blocks = cut.reshape(height, BIN_PX, width, BIN_PX).mean(axis=(1, 3))
    return np.asarray(blocks - blocks.mean())
