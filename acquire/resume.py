"""Going on with a run that ended early: only the same run, on the same instrument, over the same view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.engine import FIRST_FRAME_S, POLL_S, FrameGate
from acquire.frame import FrameHeader
from acquire.plan import StackPlan
from acquire.recipe import Recipe
from acquire.store import RunEnd, is_run, open_run
from devices.errors import CameraTimeout, InputError, PlanError, StoreError, Unsafe
from devices.values import to_um

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
        The folder is no run, or nothing is missing from it.
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
    if not stored.missing:
        raise InputError(f"{folder}: nothing is missing, all planes are durable.", code="nothing-missing")
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


def stored_recipe(stored: StoredRun) -> Recipe:
    """Return the recipe a run was started with."""
    return Recipe.model_validate(stored.manifest["recipe"])


def stored_plan(stored: StoredRun) -> StackPlan:
    """Return the plan of a run."""
    return StackPlan(**stored.manifest["plan"])


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

    The new picture is compared and forgotten; the plane on disk stays as it is.
    """
    if not stored.planes:
        return
    plan, plane = stored_plan(stored), max(stored.planes)
    z_nm = plan.start_nm + plane * plan.step_nm
    for target_nm in (z_nm - plan.approach * plan.overshoot_nm, z_nm):
        rig.stage.move_to(to_um(target_nm))
        rig.stage.settle(60.0)
    likeness = correlation(_snap(rig, clock, plan.exposure_ms), stored.read(plane))
    if not likeness >= SAME_VIEW:
        raise Unsafe(
            f"plane {plane} does not look as it did: correlation {likeness:.2f}, at least {SAME_VIEW:g} is expected.",
            why="The specimen, the light or the focus changed since; later planes would not fit the earlier ones.",
            fix=("bring back the view, then try again", "start a new run"),
            code="other-view",
        )


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


class _Picture:
    """Keeps the one frame a gate lets through."""

    def __init__(self) -> None:
        self.pixels = np.empty(0)

    def put(self, pixels: np.ndarray, header: FrameHeader) -> None:  # noqa: ARG002  as the engine hands frames over
        self.pixels = pixels.copy()


def _snap(rig: Rig, clock: Clock, exposure_ms: float) -> np.ndarray:
    picture = _Picture()
    gate = FrameGate(picture, rig.camera.caps(), exposure_ms)
    header = FrameHeader(plane=0, setpoint_um=0.0, z_um=0.0, exposure_ms=exposure_ms)
    rig.camera.arm(None, gate)
    try:
        gate.expect(header, round(clock.now() * 1e9))
        rig.camera.trigger()
        deadline = clock.now() + max(FIRST_FRAME_S, 5 * exposure_ms / 1000)
        while not gate.passed():
            if clock.now() > deadline:
                raise CameraTimeout("camera: no frame to compare with the last plane.", fix="stereotome doctor")
            clock.sleep(POLL_S)
    finally:
        gate.forget()
        rig.camera.stop(2.0)
    return picture.pixels
