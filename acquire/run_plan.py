"""A whole run as immutable data: sections or points in time, bands, a focal stack in each; it lists its own steps."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal

from acquire.per_cut import PerCut, per_cut
from acquire.plan import StackPlan, id_of
from devices.errors import PlanError
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.frame import FrameHeader, Missed
    from devices.values import Limits

Removal = Literal["cut", "polish"]


class Kind(StrEnum):
    """What a step of a run is."""

    WAIT = "wait"
    PARK = "park"
    FEED = "feed"
    CUT = "cut"
    CLEAR = "clear"
    CLEAN = "clean"
    TILT = "tilt"
    FOCUS = "focus"
    BAND = "band"
    EXPOSE = "expose"
    INSPECT = "inspect"
    COMMIT = "commit"


@dataclass(frozen=True)
class Step:
    """One step: for EXPOSE with the way there, for FEED with the thickness.

    Attributes
    ----------
    kind : Kind
        What is done.
    section, band, plane : int
        Where in the plan it belongs.
    moves_nm : tuple of int
        Where the stage is sent, one after the other.
    thickness_nm : int
        What a FEED advances.
    """

    kind: Kind
    section: int
    band: int = 0
    plane: int = 0
    moves_nm: tuple[int, ...] = ()
    thickness_nm: int = 0


@dataclass(frozen=True)
class SectionPlan:
    """Sections of a block, one after the other.

    Attributes
    ----------
    count : int
        How many faces are imaged.
    thickness_nm : PerCut
        What each cut takes off, in whole nm.
    park_nm : int
        Where the stage is while feed and knife move.
    removal : str
        ``cut``: a knife takes off what was fed. ``polish``: what is fed is ground away, then the face is cleaned.
    remove_first : bool
        The face that is there at the start is removed before the first image, not imaged.
    clean_s : float
        How long a polished face is washed; 0 asks the operator to clean it.
    sweeps : int
        How often the knife may wipe debris off a face.
    sweep_nm : int
        How far the feed is drawn back for that.
    focus_every : int
        Sections between two runs of the autofocus; 0 never.
    focus_step_nm : int
        What the focus may be moved at most from one section to the next.
    tolerance_nm : PerCut or None
        How far what the feed read back for a cut may be off before anybody is asked; None never.
    """

    count: int
    thickness_nm: PerCut
    park_nm: int
    removal: Removal = "cut"
    remove_first: bool = True
    clean_s: float = 0.0
    sweeps: int = 3
    sweep_nm: int = 1000
    focus_every: int = 0
    focus_step_nm: int = 2000
    tolerance_nm: PerCut | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise PlanError("the run has no sections.", fix="set sections.count.")
        if self.thickness_nm.cuts is not None and self.thickness_nm.cuts < self.removals:
            raise PlanError("a section has no thickness.", fix="set sections.thickness_nm.")

    @property
    def removals(self) -> int:
        """How many times material is removed."""
        return self.count if self.remove_first else self.count - 1

    @property
    def depth_um(self) -> float:
        """What all cuts together take off."""
        return self.thickness_nm.total_nm(self.removals) / 1000

    def removes(self, section: int) -> bool:
        """Tell whether something is removed before a section is imaged."""
        return section > 0 or self.remove_first

    def canonical(self) -> dict[str, Any]:
        """Return the plan as plain data; what came later than the first runs is left out where it is not used."""
        tolerance = {} if self.tolerance_nm is None else {"tolerance_nm": self.tolerance_nm.told}
        plain = {key: value for key, value in asdict(self).items() if key != "tolerance_nm"}
        return {**plain, "thickness_nm": self.thickness_nm.told, **tolerance}

    def cut(self, section: int) -> int:
        """Return which cut lays a section's face free, from 1; 0 for a face that is there at the start."""
        return section + self.remove_first

    def depth_nm(self, section: int, origin_nm: float) -> float:
        """Return the feed's place for a section, from where it stood at the start; never a sum of rounded steps."""
        return origin_nm + self.thickness_nm.total_nm(self.cut(section))


@dataclass(frozen=True)
class SeriesPlan:
    """The same again and again.

    Attributes
    ----------
    count : int
        Points in time.
    interval_ms : float
        From one to the next; 0 is as fast as the camera gives frames.
    """

    count: int
    interval_ms: float = 0.0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise PlanError("the series has no points in time.", fix="set series.count.")


@dataclass(frozen=True)
class BandPlan:
    """A band by its name in the instrument file, and its exposure."""

    name: str
    exposure_ms: float


@dataclass(frozen=True)
class RunPlan:
    """Everything a run takes. Each plane has a fixed slot: section, band and plane in this order, from 0.

    Attributes
    ----------
    stack : StackPlan
        What is taken of each section in each band.
    bands : tuple of BandPlan
        Empty: one, the camera as it is.
    sections, series : SectionPlan, SeriesPlan or None
        What is repeated.
    tilts_deg : tuple of float
        Or the tilts of the specimen at which the stack is taken. Only one of the three.
    plane_by_plane : bool
        All bands of a plane before the next plane, instead of all planes of a band before the next band.
    """

    stack: StackPlan
    bands: tuple[BandPlan, ...] = ()
    sections: SectionPlan | None = None
    series: SeriesPlan | None = None
    plane_by_plane: bool = False
    tilts_deg: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if sum(map(bool, (self.sections, self.series, self.tilts_deg))) > 1:
            raise PlanError("a run takes sections, a series or tilts.", fix="leave all out but one.")

    @property
    def times(self) -> int:
        """How many sections or points in time there are."""
        repeated = self.sections or self.series
        return repeated.count if repeated else max(1, len(self.tilts_deg))

    @property
    def commits(self) -> bool:
        """Whether what was taken of a section or tilt cannot be added to once the next has begun."""
        return bool(self.sections or self.tilts_deg)

    @property
    def at_camera_rate(self) -> bool:
        """Whether it is a single place, looked at as fast as the camera gives frames."""
        series = self.series
        return series is not None and not series.interval_ms and self.stack.count == 1 and not self.bands

    @property
    def band_count(self) -> int:
        """How many bands there are, at least one."""
        return max(1, len(self.bands))

    @property
    def slots_each(self) -> int:
        """Planes of one section, all bands together."""
        return self.band_count * self.stack.count

    def __len__(self) -> int:
        return self.times * self.slots_each

    def slot(self, section: int, band: int, plane: int) -> int:
        """Return the place of a plane in the plan."""
        return (section * self.band_count + band) * self.stack.count + plane

    def slot_of(self, what: FrameHeader | Missed) -> int:
        """Return the place of a frame, or of what was missed."""
        return self.slot(what.section, what.band, what.plane)

    def slots_of(self, section: int) -> range:
        """Return the places of a section's planes."""
        return range(section * self.slots_each, (section + 1) * self.slots_each)

    def exposure_ms(self, band: int) -> float:
        """Return the exposure of a band."""
        return self.bands[band].exposure_ms if self.bands else self.stack.exposure_ms

    def steps(self, section: int) -> Iterator[Step]:
        """Return what is done for one section, in order."""
        if self.series and section and self.series.interval_ms:
            yield Step(Kind.WAIT, section)
        if self.tilts_deg:
            yield Step(Kind.TILT, section)
        if self.sections and self.sections.removes(section):
            yield from self._removal(section, self.sections)
        if self.sections and self.sections.focus_every and section % self.sections.focus_every == 0:
            yield Step(Kind.FOCUS, section)
        yield from self._exposures(section)
        if self.sections:
            yield Step(Kind.INSPECT, section)
        if self.commits:
            yield Step(Kind.COMMIT, section)

    def _removal(self, section: int, sections: SectionPlan) -> Iterator[Step]:
        yield Step(Kind.PARK, section, moves_nm=(sections.park_nm,))
        yield Step(Kind.FEED, section, thickness_nm=round(sections.thickness_nm.nm(sections.cut(section))))
        if sections.removal == "cut":
            yield Step(Kind.CUT, section)
            yield Step(Kind.CLEAR, section)
        else:
            yield Step(Kind.CLEAN, section)

    def _exposures(self, section: int) -> Iterator[Step]:
        """Return the exposures with their moves; a plane that was just visited in another band needs no move."""
        if self.plane_by_plane:
            for plane, moves in self.stack.route():
                for band in range(self.band_count):
                    yield Step(Kind.EXPOSE, section, band, plane.index, () if band else moves)
            return
        for band in range(self.band_count):
            for plane, moves in self.stack.route():
                yield Step(Kind.EXPOSE, section, band, plane.index, moves)

    def check(self, limits: Limits) -> None:
        """Raise `devices.errors.LimitError` if any target of the stage lies outside ``limits``; nothing is sent."""
        self.stack.check(limits)
        if self.sections:
            limits.check(to_um(self.sections.park_nm))

    def canonical(self) -> dict[str, Any]:
        """Return the plan as plain data; of a plain stack, that of the stack."""
        if self == RunPlan(self.stack):
            return self.stack.canonical()
        own = {"stack": self.stack.canonical(), "sections": self.sections and self.sections.canonical()}
        return {**asdict(self), **own, "tilts_deg": list(self.tilts_deg)}

    @property
    def plan_id(self) -> str:
        """sha256 of the canonical JSON: equal plans have equal ids."""
        return id_of(self.canonical())


def run_plan(plan: StackPlan | RunPlan) -> RunPlan:
    """Return a run of one stack, or what already is a run."""
    return plan if isinstance(plan, RunPlan) else RunPlan(plan)


def plan_from(canonical: dict[str, Any]) -> RunPlan:
    """Return the plan that `RunPlan.canonical` wrote down."""
    if "stack" not in canonical:
        return RunPlan(_stack_from(canonical))
    return RunPlan(
        stack=_stack_from(canonical["stack"]),
        bands=tuple(BandPlan(**band) for band in canonical["bands"]),
        sections=_sections_from(canonical["sections"]) if canonical["sections"] else None,
        series=SeriesPlan(**canonical["series"]) if canonical["series"] else None,
        plane_by_plane=canonical["plane_by_plane"],
        tilts_deg=tuple(canonical["tilts_deg"]),
    )


def _sections_from(canonical: dict[str, Any]) -> SectionPlan:
    told: dict[str, Any] = {
        key: per_cut(canonical[key]) for key in ("thickness_nm", "tolerance_nm") if key in canonical
    }
    return SectionPlan(**{**canonical, **told})


def _stack_from(canonical: dict[str, Any]) -> StackPlan:
    positions = canonical.get("positions_nm")
    return replace(StackPlan(**{**canonical, "positions_nm": None}), positions_nm=positions and tuple(positions))
