"""The recipe file: one run. What it leaves out comes from the instrument."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from acquire.estimate import Pace
from acquire.optics import depth_of_field_um, nyquist_step_um
from acquire.plan import DEFAULT_TOLERANCE_NM, StackPlan, steps_in_range
from acquire.run_plan import RunPlan, SectionPlan
from acquire.verdict import Finding
from devices.errors import LimitError, PlanError
from devices.feed_spec import KnifeSpec
from devices.toml_model import Table, load_model, load_text
from devices.values import to_nm

if TYPE_CHECKING:
    from pathlib import Path

    from devices.feed_spec import FeedLimits, FeedSpec
    from devices.rig import OpticsSpec, RigSpec

Positive = Annotated[float, Field(gt=0)]
KNIFE_WAYS_S = 1.0  # to the window and out of it
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
    """``[process]``: what is computed while the planes arrive.

    Attributes
    ----------
    method : str
        As ``stereotome process focus --method``.
    threshold : float or None
        Grey level for the method threshold.
    band : int or None
        The band of colour planes that decides.
    """

    extended_focus: bool = False
    range_image: bool = False
    stereo_pair: StereoPairSpec | None = None
    method: Literal["brightfield", "transparent", "confocal", "threshold"] = "brightfield"
    threshold: float | None = None
    band: Annotated[int, Field(ge=0, le=2)] | None = None

    @model_validator(mode="after")
    def _threshold_belongs_to_its_method(self) -> ProcessSpec:
        if (self.threshold is not None) != (self.method == "threshold"):
            raise ValueError('method = "threshold" and threshold = 120 belong together')
        return self

    @property
    def focus_options(self) -> dict[str, Any]:
        """What the focus measurement is told."""
        return self.model_dump(include={"method", "threshold", "band"}, exclude_none=True)

    @property
    def wanted(self) -> bool:
        """Whether anything is to be computed."""
        return self.extended_focus or self.range_image or self.stereo_pair is not None


class DebrisSpec(Table):
    """``[sections] debris_check``: what becomes of a face with debris on it.

    Attributes
    ----------
    on_debris : str
        ``recut`` wipes the face with the knife, the feed drawn back, and asks when that does not help; ``pause`` asks
        at once; ``skip`` notes it and goes on.
    sweeps : int
        How often it is wiped.
    sweep_nm : float
        How far the feed is drawn back for that.
    method, threshold
        How debris is found.
    """

    enabled: bool = True
    method: str = "edge-density"
    threshold: Positive = 0.35
    on_debris: Literal["recut", "pause", "skip"] = "recut"
    sweeps: Annotated[int, Field(ge=1, le=20)] = 3
    sweep_nm: Positive = 1000.0


class SectionsSpec(Table):
    """``[sections]``: the block is cut or polished, and each face is imaged in place.

    Attributes
    ----------
    count : int or None
        Faces to image.
    depth_um : float or None
        Instead of ``count``: as many as go into this depth.
    thickness_nm : float
        What is taken off between two faces.
    cut_then_image : bool
        The face that is there at the start is cut away before the first image; else it is the first image.
    clean : str
        Polisher: ``ask`` has the operator clean each face, ``wash`` waits ``clean_s``.
    autofocus_every : int
        Sections between two runs of the autofocus; 0 never.
    on_error : str
        Where something fails: ``pause`` asks, ``park-and-stop`` ends the run, ``continue`` leaves planes out that
        cannot be taken. A cut that is in doubt is always asked about.
    on_quality : str
        A face that stays frozen, blurred, saturated or incomplete when it is taken again: ``pause`` asks, ``accept``
        notes it and goes on.
    """

    count: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    depth_um: Positive | None = None
    thickness_nm: Positive
    cut_then_image: bool = True
    clean: Literal["ask", "wash"] = "ask"
    clean_s: Positive = 10.0
    autofocus_every: Annotated[int, Field(ge=0)] = 0
    focus_step_um: Positive = 2.0
    debris_check: DebrisSpec = DebrisSpec()
    on_error: Literal["pause", "park-and-stop", "continue"] = "pause"
    on_quality: Literal["pause", "accept"] = "pause"

    @model_validator(mode="after")
    def _makes_sense(self) -> SectionsSpec:
        if (self.count is None) == (self.depth_um is None):
            raise ValueError("give either count or depth_um")
        if self.depth_um is not None and self.depth_um * 1000 < self.thickness_nm:
            raise ValueError(f"depth_um {self.depth_um:g} is less than one section of {self.thickness_nm:g} nm")
        return self

    @property
    def sections(self) -> int:
        """How many faces are imaged."""
        if self.count is not None:
            return self.count
        assert self.depth_um is not None
        return int(to_nm(self.depth_um) // round(self.thickness_nm))

    @property
    def accepts(self) -> frozenset[Finding]:
        """What is noted and left as it is."""
        debris = {Finding.DEBRIS} if self.debris_check.on_debris == "skip" else set()
        quality = {Finding.FROZEN, Finding.INCOMPLETE, Finding.SATURATED, Finding.BLURRED, Finding.DUPLICATE}
        return frozenset(debris | (quality if self.on_quality == "accept" else set()))


class Recipe(Table):
    """A recipe file, ``recipe.toml``.

    ``[watch]`` is accepted as it is: its keys are not looked at until the program can watch.
    """

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: str = "stack"
    operator: str = ""
    notes: str = ""
    output: OutputSpec = OutputSpec()
    stack: StackSpec
    process: ProcessSpec = ProcessSpec()
    watch: dict[str, Any] | None = None
    sections: SectionsSpec | None = None


def load_recipe(path: Path, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read a recipe file for a run; raises `PlanError` with every problem of the file, each with its line."""
    return load_model(path, Recipe, PlanError, overrides=overrides)


def recipe_from_text(text: str, name: str, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read the text of a recipe; ``name`` stands for the file in messages. Raises as `load_recipe` does."""
    return load_text(text, name, Recipe, PlanError, overrides=overrides)


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


def plan_run(recipe: Recipe, rig: RigSpec) -> RunPlan:
    """Return the plan of a whole recipe on an instrument; raises as `plan_stack`."""
    sections = None if recipe.sections is None else _plan_sections(recipe.sections, rig)
    plan = RunPlan(plan_stack(recipe.stack, rig), sections=sections)
    plan.check(rig.stage.z.soft_limits)
    return plan


def _plan_sections(table: SectionsSpec, rig: RigSpec) -> SectionPlan:
    if rig.microtome is None:
        raise PlanError(
            "the recipe has [sections], but the instrument file has no [microtome].",
            fix=("add [microtome] to the instrument file", "leave [sections] out to take one focal stack"),
            code="no-microtome",
        )
    if rig.stage.z.park_um is None:
        raise PlanError(
            "the recipe has [sections], but the instrument file names no park_um.",
            why="While the knife moves, the stage has to be out of its way.",
            fix="set stage.z.park_um to where the objective is clear of knife and block.",
            code="no-park",
        )
    plan = SectionPlan(
        count=table.sections,
        thickness_nm=round(table.thickness_nm),
        park_nm=to_nm(rig.stage.z.park_um),
        removal="polish" if rig.microtome.kind == "polisher" else "cut",
        remove_first=table.cut_then_image,
        clean_s=table.clean_s if table.clean == "wash" else 0.0,
        sweeps=table.debris_check.sweeps if table.debris_check.on_debris == "recut" else 0,
        sweep_nm=round(table.debris_check.sweep_nm),
        focus_every=table.autofocus_every,
        focus_step_nm=to_nm(table.focus_step_um),
    )
    _check_feed(plan, rig.microtome.limits)
    return plan


def _check_feed(plan: SectionPlan, limits: FeedLimits) -> None:
    """Raise `LimitError` if a section is too thin or thick, or all together are deeper than the feed's whole travel."""
    if not limits.thickness_nm_min <= plan.thickness_nm <= limits.thickness_nm_max:
        raise LimitError(
            f"feed: a section of {plan.thickness_nm} nm is not within {limits.thickness_nm_min:g} … "
            f"{limits.thickness_nm_max:g} nm. Nothing moved.",
            fix="choose another thickness, or change limits in [microtome].",
        )
    depth_um, travel_um = plan.removals * plan.thickness_nm / 1000, limits.feed_um_max - limits.feed_um_min
    if depth_um > travel_um:
        raise LimitError(
            f"feed: {plan.removals} sections of {plan.thickness_nm} nm are {depth_um:.1f} µm deep; the feed travels "
            f"{travel_um:g} µm. Nothing moved.",
            fix="take fewer or thinner sections.",
        )


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
    pace = Pace(speed_um_s=axis.speed_um_s or 1000.0, settle_s=axis.settle_ms / 1000)
    return pace if rig.microtome is None else replace(pace, **_feed_pace(rig.microtome))


def _feed_pace(table: FeedSpec) -> dict[str, float]:
    speed_um_s, knife = table.feed_profile().axis.speed_um_s, table.knife or KnifeSpec()
    stroke_s = abs(knife.window_um[0] - knife.window_um[1]) / knife.speed_um_s
    return {"feed_um_s": speed_um_s, "cut_s": stroke_s + 2 * knife.clearance_um / speed_um_s + KNIFE_WAYS_S}
