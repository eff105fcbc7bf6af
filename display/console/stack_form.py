"""What the operator fills in for a run, and the recipe it makes; the instrument judges it as any other recipe."""

from __future__ import annotations

import shlex
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from acquire.optics import depth_of_field_um, nyquist_step_um
from acquire.per_cut import per_cut
from acquire.recipe import recipe_from_text
from devices.errors import PlanError
from devices.toml_write import toml_text
from devices.values import to_nm
from display.console.moving import Marks

if TYPE_CHECKING:
    from acquire.per_cut import PerCut
    from acquire.recipe import SectionsSpec, StackSpec
    from devices.rig import RigSpec

Spacing = Literal["planes", "step", "nyquist", "dof"]
SPACINGS: tuple[Spacing, ...] = ("planes", "step", "nyquist", "dof")
ON_QUALITY = ("pause", "accept")
ON_ERROR = ("pause", "park-and-stop", "continue")
NM_PER_UM = 1000
RETURNS = ("start", "middle", "park", "stay")
Direction = Literal["up", "down"]


@dataclass
class SectionsForm:
    """Sections to cut, as ``[sections]`` of a recipe.

    Attributes
    ----------
    thickness : str
        As typed, in nm: one for all cuts, or ranges of cuts, ``1-20: 100, 21-: 50``.
    """

    wanted: bool = False
    by_depth: bool = False
    count: int = 10
    depth_um: float = 1.0
    thickness: str = "100"
    cut_first: bool = True
    sweeps: int = 3
    autofocus_every: int = 0
    on_quality: str = "pause"
    on_error: str = "pause"

    @property
    def number(self) -> int:
        """How many sections are cut: as many as asked for, or as go into the depth.

        Raises
        ------
        ValueError
            The thickness as typed is none, in words.
        """
        return self._cuts.cuts_within(to_nm(self.depth_um)) if self.by_depth else self.count

    @property
    def total_um(self) -> float:
        """How deep all cuts go together; raises as `number`."""
        return self._cuts.total_nm(self.number) / NM_PER_UM

    @property
    def first_nm(self) -> float:
        """Thickness of the first cut; raises as `number`."""
        return self._cuts.nm(1)

    @property
    def _cuts(self) -> PerCut:
        return per_cut(self.thickness).each(round)

    def table(self) -> dict[str, Any]:
        """Return the recipe's table."""
        return {
            **({"depth_um": float(self.depth_um)} if self.by_depth else {"count": self.count}),
            "thickness_nm": _as_written(self.thickness),
            "cut_then_image": self.cut_first,
            "autofocus_every": self.autofocus_every,
            "on_quality": self.on_quality,
            "on_error": self.on_error,
            "debris_check": {"on_debris": "recut", "sweeps": self.sweeps} if self.sweeps else {"on_debris": "pause"},
        }


def _as_written(thickness: str) -> float | str:
    """Return a thickness as a recipe has it; what is none as it was typed: who reads the recipe says why."""
    with suppress(ValueError):
        return per_cut(thickness).told
    return thickness


@dataclass
class StackForm:
    """A stack between the marks, or around where the stage is without them."""

    name: str = "stack"
    notes: str = ""
    operator: str = ""
    folder: str = "data/{date}/{name}-{run:03d}"
    marks: Marks = field(default_factory=Marks)
    around_um: float = 20.0
    spacing: Spacing = "planes"
    planes: int = 21
    step_um: float = 1.0
    direction: Direction = "up"
    return_to: str = "middle"  # back where it was: a stack around here does not wander when it is repeated
    exposure_ms: float | None = None
    focus: bool = True
    stereo: bool = True
    keep_free_gb: float = 1.0
    notify: str = ""
    sections: SectionsForm = field(default_factory=SectionsForm)

    def recipe(self) -> str:
        """Return the recipe's text."""
        tables: dict[str, Any] = {
            "schema": 1,
            "name": self.name,
            "operator": self.operator,
            "notes": self.notes,
            "output": {"folder": self.folder, "keep_free_gb": float(self.keep_free_gb)},
            "stack": {**self._range(), **self._spacing(), "direction": self.direction, "return_to": self.return_to},
        }
        if self.exposure_ms is not None:
            tables["stack"]["exposure_ms"] = float(self.exposure_ms)
        if self.focus and not self.sections.wanted:
            tables["process"] = {"extended_focus": True, "range_image": True}
            if self.stereo:
                tables["process"]["stereo_pair"] = {"angle_deg": 6.0}
        if self.notify.strip():
            tables["watch"] = {"notify": {"command": words_of_command(self.notify)}}
        if self.sections.wanted:
            tables["sections"] = self.sections.table()
        return toml_text(tables)

    def _range(self) -> dict[str, float]:
        if not self.marks.complete:
            return {"around_um": float(self.around_um)}
        bottom_um, top_um = self.marks.in_order()
        return {"bottom_um": round(bottom_um, 3), "top_um": round(top_um, 3)}

    def _spacing(self) -> dict[str, Any]:
        match self.spacing:
            case "planes":
                return {"planes": self.planes}
            case "step":
                return {"step": float(self.step_um)}
            case "nyquist" | "dof":
                return {"step": self.spacing}


def form_of(text: str) -> StackForm:
    """Return the form that makes the same run as a recipe's text.

    Raises
    ------
    PlanError
        It is no good recipe; ``no-field``: it says something the form has no field for, so nothing of it is taken.
    """
    recipe = recipe_from_text(text, "the recipe")
    stack, process, notify = recipe.stack, recipe.process, recipe.watch.notify
    form = StackForm(
        name=recipe.name,
        notes=recipe.notes,
        operator=recipe.operator,
        folder=recipe.output.folder,
        marks=Marks(top_um=stack.top_um, bottom_um=stack.bottom_um),
        direction=stack.direction,
        return_to=stack.return_to,
        exposure_ms=stack.exposure_ms,
        focus=process.extended_focus,
        stereo=process.stereo_pair is not None,
        keep_free_gb=recipe.output.keep_free_gb,
        notify="" if notify is None else shlex.join(notify.command),
        sections=SectionsForm() if recipe.sections is None else _sections_of(recipe.sections),
        **_spacing_of(stack),
    )
    made = recipe_from_text(form.recipe(), "the form").model_dump()
    said = recipe.model_dump(exclude_unset=True)
    if lacking := differences(said, made) or differences(recipe.model_dump(), made):
        raise PlanError(
            f"the form has no field for {', '.join(lacking)}.",
            fix="queue the recipe as it is: it runs all the same.",
            code="no-field",
        )
    return form


def _spacing_of(stack: StackSpec) -> dict[str, Any]:
    """Return how far planes lie apart, and around where, as fields of the form."""
    around = {} if stack.around_um is None else {"around_um": stack.around_um}
    if stack.planes is not None:
        return {**around, "spacing": "planes", "planes": stack.planes}
    if isinstance(stack.step, float):
        return {**around, "spacing": "step", "step_um": stack.step}
    return {**around, "spacing": stack.step or "planes"}


def _sections_of(sections: SectionsSpec) -> SectionsForm:
    debris, plain = sections.debris_check, SectionsForm()
    return SectionsForm(
        wanted=True,
        by_depth=sections.depth_um is not None,
        count=sections.count or plain.count,
        depth_um=sections.depth_um or plain.depth_um,
        thickness=str(sections.thickness_nm),
        cut_first=sections.cut_then_image,
        sweeps=debris.sweeps if debris.on_debris == "recut" else 0,
        autofocus_every=sections.autofocus_every,
        on_quality=sections.on_quality,
        on_error=sections.on_error,
    )


def differences(one: dict[str, Any], other: dict[str, Any], within: str = "") -> list[str]:
    """Return the keys, as ``table.key``, under which two recipes do not say the same."""
    found: list[str] = []
    for key, value in one.items():
        against = other[key]
        if isinstance(value, dict) and isinstance(against, dict):
            found += differences(value, against, f"{within}{key}.")
        elif value != against:
            found.append(f"{within}{key}")
    return found


def words_of_command(text: str) -> list[str]:
    """Return the words of a command as a shell takes them; with a quotation that does not end, as they stand."""
    try:
        return shlex.split(text)
    except ValueError:
        return text.split()


@dataclass(frozen=True)
class Advice:
    """What the optics say about the distance of planes, in µm."""

    nyquist_um: float
    depth_of_field_um: float

    def overlap_percent(self, step_um: float) -> float:
        """Return how much of its depth of field a plane shares with the next: extended focus needs some."""
        return max(0.0, 100 * (1 - abs(step_um) / self.depth_of_field_um))


def advice(rig: RigSpec) -> Advice:
    """Return what the instrument's optics say."""
    lens = rig.optics
    return Advice(
        nyquist_step_um(lens.na, lens.wavelength_um, lens.medium_index),
        depth_of_field_um(
            lens.na, lens.wavelength_um, lens.medium_index, lens.magnification, rig.camera.pixel_um or 0.0
        ),
    )
