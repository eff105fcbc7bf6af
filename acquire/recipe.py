"""The recipe file: one run. What it leaves out comes from the instrument."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from acquire.optics import depth_of_field_um, nyquist_step_um
from acquire.plan import DEFAULT_TOLERANCE_NM, Pace, StackPlan, steps_in_range
from devices.errors import PlanError
from devices.toml_model import Table, load_model, load_text
from devices.values import to_nm

if TYPE_CHECKING:
    from pathlib import Path

    from devices.rig import OpticsSpec, RigSpec

Positive = Annotated[float, Field(gt=0)]
BACKLASH_MARGIN = 2.0  # overshoot this many times the stated backlash


class OutputSpec(Table):
    """``[output]``.

    Attributes
    ----------
    folder : str
        With ``{date} {time} {name} {run} {operator} {instrument}``; ``{run}`` takes a format such as ``:03d`` and
        counts up to the first folder that does not exist.
    keep_free_gb : float
        The run does not start, or stops, below this.
    """

    folder: str = "data/{date}/{name}-{run:03d}"
    format: Literal["ome-zarr"] = "ome-zarr"
    compression: Literal["lz4", "zstd", "none"] = "lz4"
    keep_free_gb: Annotated[float, Field(ge=0)] = 1.0


class StackSpec(Table):
    """``[stack]``: one focal stack.

    Attributes
    ----------
    top_um, bottom_um : float
        The range, ends included.
    step : float, "nyquist" or "dof"
        Distance of planes in µm, or computed from the optics.
    planes : int or None
        Instead of ``step``: that many planes, evenly from end to end.
    direction : str
        ``up`` takes the stack from the bottom to the top.
    return_to : str
        Where the stage goes afterwards, also after an abort.
    exposure_ms : float or None
        None: the camera's in the instrument file.
    tolerance_um : float
        Largest distance from setpoint to readback at which a plane is taken.
    on_plane_error : str
        ``fail`` ends the run at a plane that cannot be taken; ``gap`` records it as missing and goes on.
    trigger : str
        ``hardware`` lets stage and camera trigger each other over their cables, with no computer between two planes.
    """

    top_um: float
    bottom_um: float
    step: Positive | Literal["nyquist", "dof"] | None = None
    planes: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    direction: Literal["up", "down"] = "up"
    return_to: Literal["start", "middle", "park", "stay"] = "start"
    exposure_ms: Positive | None = None
    tolerance_um: Positive = DEFAULT_TOLERANCE_NM / 1000
    on_plane_error: Literal["fail", "gap"] = "fail"
    trigger: Literal["software", "hardware"] = "software"

    @model_validator(mode="after")
    def _makes_sense(self) -> StackSpec:
        if self.top_um < self.bottom_um:
            raise ValueError(f"top_um {self.top_um:g} is below bottom_um {self.bottom_um:g}")
        if (self.step is None) == (self.planes is None):
            raise ValueError("give either step or planes")
        if self.planes == 1 and self.top_um != self.bottom_um:
            raise ValueError("one plane has no range: make top_um and bottom_um equal, or give more planes")
        return self


class StereoPairSpec(Table):
    """A stereo pair made from the range image."""

    angle_deg: Annotated[float, Field(gt=0, le=30)] = 6.0


class ProcessSpec(Table):
    """``[process]``: what is computed while the planes arrive."""

    extended_focus: bool = False
    range_image: bool = False
    stereo_pair: StereoPairSpec | None = None
    method: Literal["brightfield", "confocal"] = "brightfield"

    @property
    def wanted(self) -> bool:
        """Whether anything is to be computed."""
        return self.extended_focus or self.range_image or self.stereo_pair is not None


class Recipe(Table):
    """A recipe file, ``recipe.toml``.

    ``[watch]`` and ``[sections]`` are accepted as they are: their keys are not looked at until the program can watch
    and cut. A run with sections is refused, not taken as a single stack.
    """

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: str = "stack"
    operator: str = ""
    notes: str = ""
    output: OutputSpec = OutputSpec()
    stack: StackSpec
    process: ProcessSpec = ProcessSpec()
    watch: dict[str, Any] | None = None
    sections: dict[str, Any] | None = None


def load_recipe(path: Path, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read a recipe file for a run; raises `PlanError` with every problem of the file, each with its line."""
    return _without_sections(load_model(path, Recipe, PlanError, overrides=overrides), str(path))


def recipe_from_text(text: str, name: str, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read the text of a recipe; ``name`` stands for the file in messages. Raises as `load_recipe` does."""
    return _without_sections(load_text(text, name, Recipe, PlanError, overrides=overrides), name)


def _without_sections(recipe: Recipe, name: str) -> Recipe:
    if recipe.sections is not None:
        raise PlanError(
            f"{name}: runs with [sections] are not possible yet.",
            why="Nothing would be cut, and a single stack is not what the recipe asks for.",
            fix="leave [sections] out to take one focal stack.",
            code="no-sections",
        )
    return recipe


def step_um(step: float | str, optics: OpticsSpec, sensor_pixel_um: float | None) -> float:
    """Return a step in µm, computed from the optics for ``"nyquist"`` and ``"dof"``."""
    if step == "nyquist":
        return nyquist_step_um(optics.na, optics.wavelength_um, optics.medium_index)
    if step == "dof":
        return depth_of_field_um(
            optics.na, optics.wavelength_um, optics.medium_index, optics.magnification, sensor_pixel_um or 0.0
        )
    return float(step)


def plan_stack(stack: StackSpec, rig: RigSpec) -> StackPlan:
    """Return the plan of a recipe's stack on an instrument.

    Raises
    ------
    PlanError
        The recipe cannot be carried out as written.
    LimitError
        A position lies outside the instrument's limits.
    """
    axis = rig.stage.z
    first_um, last_um = (stack.bottom_um, stack.top_um) if stack.direction == "up" else (stack.top_um, stack.bottom_um)
    if stack.planes is None:
        assert stack.step is not None
        step_nm, count = steps_in_range(first_um, last_um, step_um(stack.step, rig.optics, rig.camera.pixel_um))
    else:
        count = stack.planes
        step_nm = round((to_nm(last_um) - to_nm(first_um)) / max(1, count - 1))
    plan = StackPlan(
        start_nm=to_nm(first_um),
        step_nm=step_nm,
        count=count,
        exposure_ms=stack.exposure_ms or rig.camera.exposure_ms,
        overshoot_nm=to_nm(BACKLASH_MARGIN * axis.backlash_um),
        tolerance_nm=to_nm(stack.tolerance_um),
        return_nm=_return_nm(stack, rig),
    )
    plan.check(axis.soft_limits)
    return plan


def _return_nm(stack: StackSpec, rig: RigSpec) -> int | None:
    first_um = stack.bottom_um if stack.direction == "up" else stack.top_um
    match stack.return_to:
        case "start":
            return to_nm(first_um)
        case "middle":
            return to_nm((stack.bottom_um + stack.top_um) / 2)
        case "park":
            if rig.stage.z.park_um is None:
                raise PlanError(
                    'return_to = "park", but the instrument file names no park_um.',
                    fix='set stage.z.park_um, or return_to = "start" | "middle" | "stay".',
                )
            return to_nm(rig.stage.z.park_um)
        case "stay":
            return None


def pace_of(rig: RigSpec) -> Pace:
    """Return how fast the instrument is, for estimates."""
    axis = rig.stage.z
    return Pace(speed_um_s=axis.speed_um_s or 1000.0, settle_s=axis.settle_ms / 1000)
