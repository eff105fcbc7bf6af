"""From a recipe and an instrument to a plan: positions from ranges and optics, everything checked against limits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from acquire.estimate import Pace
from acquire.optics import depth_of_field_um, nyquist_step_um
from acquire.per_cut import per_cut
from acquire.plan import StackPlan, listed, steps_in_range
from acquire.recipe import BandUse
from acquire.run_plan import BandPlan, RunPlan, SectionPlan, SeriesPlan
from devices.bands import choose_bands
from devices.errors import LimitError, PlanError
from devices.feed_spec import KnifeSpec
from devices.values import to_nm

if TYPE_CHECKING:
    from acquire.per_cut import PerCut
    from acquire.recipe import Recipe, SectionsSpec, StackSpec
    from devices.feed_spec import FeedLimits, FeedSpec
    from devices.rig import OpticsSpec, RigSpec

KNIFE_WAYS_S = 1.0  # to the window and out of it
NM_PER_UM = 1000
TOLERANCE, READING_COUNTS = 0.1, 3.0  # of a section's thickness
BACKLASH_MARGIN = 2.0  # overshoot this many times the stated backlash


def step_um(step: float | str, optics: OpticsSpec, sensor_pixel_um: float | None) -> float:
    """Return a step in µm, computed from the optics for ``"nyquist"`` and ``"dof"``."""
    if step == "nyquist":
        return nyquist_step_um(optics.na, optics.wavelength_um, optics.medium_index)
    if step == "dof":
        return depth_of_field_um(
            optics.na, optics.wavelength_um, optics.medium_index, optics.magnification, sensor_pixel_um or 0.0
        )
    return float(step)


def plan_stack(stack: StackSpec, rig: RigSpec, here_um: float = 0.0) -> StackPlan:
    """Return the plan of a recipe's stack on an instrument whose stage is at ``here_um``.

    Raises
    ------
    PlanError
        The recipe cannot be carried out as written.
    LimitError
        A position lies outside the instrument's limits.
    """
    exposure_ms = stack.exposure_ms or rig.camera.exposure_ms
    common: dict[str, Any] = {
        "overshoot_nm": to_nm(BACKLASH_MARGIN * rig.stage.z.backlash_um),
        "tolerance_nm": to_nm(stack.tolerance_um),
        "return_nm": _return_nm(stack, rig, here_um),
    }
    positions_um = stack.listed_um(here_um)
    if positions_um is not None:
        plan = listed([to_nm(z_um) for z_um in positions_um], exposure_ms, **common)
    else:
        start_nm, step_nm, count = _evenly(stack, rig, here_um)
        plan = StackPlan(start_nm, step_nm, count, exposure_ms, **common)
    plan.check(rig.stage.z.soft_limits)
    return plan


def _ends_um(stack: StackSpec, here_um: float) -> tuple[float, float]:
    """Return where the first and the last plane are."""
    positions_um = stack.listed_um(here_um)
    if positions_um is not None:
        return positions_um[0], positions_um[-1]
    bottom_um, top_um = stack.range_um(here_um)
    assert bottom_um is not None
    assert top_um is not None
    return (bottom_um, top_um) if stack.direction == "up" else (top_um, bottom_um)


def _evenly(stack: StackSpec, rig: RigSpec, here_um: float) -> tuple[int, int, int]:
    """Return start, step and number of evenly spaced planes."""
    first_um, last_um = _ends_um(stack, here_um)
    if stack.planes is None:
        assert stack.step is not None
        step_nm, count = steps_in_range(first_um, last_um, step_um(stack.step, rig.optics, rig.camera.pixel_um))
    else:
        count = stack.planes
        step_nm = int((to_nm(last_um) - to_nm(first_um)) / max(1, count - 1))  # towards the first: none lies beyond
    return to_nm(first_um), step_nm, count


def plan_run(recipe: Recipe, rig: RigSpec, here_um: float = 0.0) -> RunPlan:
    """Return the plan of a whole recipe on an instrument whose stage is at ``here_um``; raises as `plan_stack`."""
    stack = plan_stack(recipe.stack, rig, here_um)
    series = recipe.series
    plan = RunPlan(
        stack,
        bands=_plan_bands(recipe.stack, rig, stack.exposure_ms),
        sections=None if recipe.sections is None else _plan_sections(recipe.sections, rig),
        series=None if series is None else SeriesPlan(series.count, 1000 * series.interval_s),
        tilts_deg=() if recipe.tilt is None else recipe.tilt.angles_deg,
        plane_by_plane=recipe.stack.order == "plane",
    )
    plan.check(rig.stage.z.soft_limits)
    return plan


def _plan_bands(stack: StackSpec, rig: RigSpec, exposure_ms: float) -> tuple[BandPlan, ...]:
    uses = [BandUse(name=use) if isinstance(use, str) else use for use in stack.bands]
    known = choose_bands(rig.band, [use.name for use in uses])
    return tuple(
        BandPlan(use.name, use.exposure_ms or band.exposure_ms or exposure_ms)
        for use, band in zip(uses, known, strict=True)
    )


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
        thickness_nm=table.thickness_nm.each(round),
        park_nm=to_nm(rig.stage.z.park_um),
        removal="polish" if rig.microtome.kind == "polisher" else "cut",
        remove_first=table.cut_then_image,
        clean_s=table.clean_s if table.clean == "wash" else 0.0,
        sweeps=table.debris_check.sweeps if table.debris_check.on_debris == "recut" else 0,
        sweep_nm=round(table.debris_check.sweep_nm),
        focus_every=table.autofocus_every,
        focus_step_nm=to_nm(table.focus_step_um),
        tolerance_nm=thickness_tolerance_nm(table, rig.microtome),
    )
    _check_feed(plan, rig.microtome.limits)
    return plan


def thickness_tolerance_nm(table: SectionsSpec, feed: FeedSpec) -> PerCut:
    """Return how far a cut may be off; two readings of a feed are each good to half a count and one at rest."""
    if table.thickness_tolerance_nm is not None:
        return per_cut(round(table.thickness_tolerance_nm))
    count_nm = NM_PER_UM / feed.feed_profile().axis.counts_per_um
    return table.thickness_nm.each(lambda nm: round(max(TOLERANCE * nm, READING_COUNTS * count_nm)))


def _check_feed(plan: SectionPlan, limits: FeedLimits) -> None:
    """Raise `LimitError` if a section is too thin or thick, or all together are deeper than the feed's whole travel."""
    for thickness_nm in plan.thickness_nm.extremes_nm:
        if not limits.thickness_nm_min <= thickness_nm <= limits.thickness_nm_max:
            raise LimitError(
                f"feed: a section of {thickness_nm:g} nm is not within {limits.thickness_nm_min:g} … "
                f"{limits.thickness_nm_max:g} nm. Nothing moved.",
                fix="choose another thickness, or change limits in [microtome].",
            )
    depth_um, travel_um = plan.depth_um, limits.feed_um_max - limits.feed_um_min
    if depth_um > travel_um:
        raise LimitError(
            f"feed: {plan.removals} sections of {plan.thickness_nm} nm are {depth_um:.1f} µm deep; the feed travels "
            f"{travel_um:g} µm. Nothing moved.",
            fix="take fewer or thinner sections.",
        )


def _return_nm(stack: StackSpec, rig: RigSpec, here_um: float) -> int | None:
    first_um, last_um = _ends_um(stack, here_um)
    match stack.return_to:
        case "start":
            return to_nm(first_um)
        case "middle":
            return to_nm((first_um + last_um) / 2)
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
