"""The recipe file: one run. What it leaves out comes from the instrument."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, PlainSerializer, PlainValidator, WithJsonSchema, model_validator

from acquire.per_cut import PerCut, per_cut
from acquire.plan import DEFAULT_TOLERANCE_NM
from acquire.verdict import Finding
from devices.errors import PlanError
from devices.toml_model import Table, load_model, load_text
from devices.values import to_nm

if TYPE_CHECKING:
    from pathlib import Path

Positive = Annotated[float, Field(gt=0)]


def _whole_nm(told: object) -> PerCut:
    """Return what is told of each cut; of what rounds to 0 nm, raise `ValueError`."""
    cuts = per_cut(told)
    cuts.each(round)
    return cuts


EachCut = Annotated[
    PerCut,
    PlainValidator(_whole_nm),
    PlainSerializer(lambda cuts: cuts.told),
    WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {"type": "string"}]}),
]


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


class BandUse(Table):
    """A band to take, with an exposure of its own."""

    name: str
    exposure_ms: Positive | None = None


class StackSpec(Table):
    """``[stack]``: one focal stack, by a range, around where the stage is, or by a list.

    Attributes
    ----------
    top_um, bottom_um : float or None
        The range, ends included.
    around_um : float or None
        Instead: a range of this length, half of it above and half below where the stage is when the run begins.
    positions_um : tuple of float or None
        Instead: these positions, in this order; they need not be evenly apart.
    offsets_um : tuple of float or None
        Instead: these distances from where the stage is when the run begins.
    bands : tuple
        Names of the instrument's bands to take each plane in, or tables with ``name`` and ``exposure_ms``.
    order : str
        ``stack``: all planes of a band, then the next band. ``plane``: all bands of a plane, then the next plane.
    step : float, "nyquist" or "dof"
        Distance of planes in µm, or computed from the optics.
    planes : int or None
        Instead of ``step``: that many planes, evenly over the range: whole nm apart, so that the last may be short of
        its end by a nm for each plane, and is never beyond.
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

    top_um: float | None = None
    bottom_um: float | None = None
    around_um: Annotated[float, Field(ge=0)] | None = None
    positions_um: Annotated[tuple[float, ...] | None, Field(strict=False, min_length=1)] = None
    offsets_um: Annotated[tuple[float, ...] | None, Field(strict=False, min_length=1)] = None
    bands: Annotated[tuple[str | BandUse, ...], Field(strict=False)] = ()
    order: Literal["stack", "plane"] = "stack"
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
        ranged = self.top_um is not None or self.bottom_um is not None
        if sum((ranged, self.around_um is not None, bool(self.positions_um), bool(self.offsets_um))) != 1:
            raise ValueError("give top_um and bottom_um, or around_um, or positions_um, or offsets_um")
        if self.listed_um(0.0) is not None:
            if self.step is not None or self.planes is not None:
                raise ValueError("a list of positions needs neither step nor planes")
            return self
        return self._sensible_range()

    def _sensible_range(self) -> StackSpec:
        first_um, last_um = self.range_um(0.0)
        if first_um is None or last_um is None:
            raise ValueError("a range needs both top_um and bottom_um")
        if last_um < first_um:
            raise ValueError(f"top_um {last_um:g} is below bottom_um {first_um:g}")
        if (self.step is None) == (self.planes is None):
            raise ValueError("give either step or planes")
        if self.planes == 1 and first_um != last_um:
            raise ValueError("one plane has no range: make top_um and bottom_um equal, or give more planes")
        return self

    @property
    def starts_here(self) -> bool:
        """Whether the plan depends on where the stage is when the run begins."""
        return self.around_um is not None or self.offsets_um is not None

    def listed_um(self, here_um: float) -> tuple[float, ...] | None:
        """Return the listed positions, for a stage that is at ``here_um``; None for a range."""
        if self.offsets_um is not None:
            return tuple(here_um + offset_um for offset_um in self.offsets_um)
        return self.positions_um

    def range_um(self, here_um: float) -> tuple[float | None, float | None]:
        """Return bottom and top, for a stage that is at ``here_um``."""
        if self.around_um is None:
            return self.bottom_um, self.top_um
        return here_um - self.around_um / 2, here_um + self.around_um / 2


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
    observers : tuple of str
        Names of the entry-point group ``stereotome.observers``; each is a process of its own.
    """

    extended_focus: bool = False
    range_image: bool = False
    stereo_pair: StereoPairSpec | None = None
    method: Literal["brightfield", "transparent", "confocal", "threshold"] = "brightfield"
    threshold: float | None = None
    band: Annotated[int, Field(ge=0, le=2)] | None = None
    observers: Annotated[tuple[str, ...], Field(strict=False)] = ()

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
    thickness_nm : float or str
        What is taken off between two faces, or ranges of cuts with a thickness each, ``"1-20: 100, 21-: 50"``.
    cut_then_image : bool
        The face that is there at the start is cut away before the first image; else it is the first image.
    clean : str
        Polisher: ``ask`` has the operator clean each face, ``wash`` waits ``clean_s``.
    thickness_tolerance_nm : float or None
        How far the thickness that the feed read back may be off before anything is cut unasked; a tenth of the
        thickness, or what the feed can resolve if that is more, when left out.
    autofocus_every : int
        Sections between two runs of the autofocus; 0 never.
    on_error : str
        Where something fails: ``pause`` asks, ``park-and-stop`` ends the run, ``continue`` leaves planes out that
        cannot be taken. A cut that is in doubt is always asked about.
    on_quality : str
        A face that stays frozen, blurred, saturated or incomplete when it is taken again, or a section of another
        thickness: ``pause`` asks, ``accept`` notes it and goes on.
    """

    count: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    depth_um: Positive | None = None
    thickness_nm: EachCut
    thickness_tolerance_nm: Positive | None = None
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
        if self.sections < 1:
            raise ValueError(f"depth_um {self.depth_um:g} is less than one section of {self.thickness_nm.nm(1):g} nm")
        if self.count is not None:
            self.thickness_nm.check(self.count if self.cut_then_image else self.count - 1)
        return self

    @property
    def sections(self) -> int:
        """How many faces are imaged."""
        if self.count is not None:
            return self.count
        assert self.depth_um is not None
        return self.thickness_nm.each(round).cuts_within(to_nm(self.depth_um))

    @property
    def accepts(self) -> frozenset[Finding]:
        """What is noted and left as it is."""
        debris = {Finding.DEBRIS} if self.debris_check.on_debris == "skip" else set()
        quality = {Finding.FROZEN, Finding.INCOMPLETE, Finding.SATURATED, Finding.BLURRED, Finding.DUPLICATE}
        quality.add(Finding.THICKNESS)
        return frozenset(debris | (quality if self.on_quality == "accept" else set()))


class SeriesSpec(Table):
    """``[series]``: the stack again and again, time as an axis.

    Attributes
    ----------
    count : int
        How often.
    interval_s : float
        From the beginning of one to the beginning of the next; 0 is as fast as it goes, a single plane at camera rate.
    """

    count: Annotated[int, Field(ge=1, le=10_000_000)]
    interval_s: Annotated[float, Field(ge=0)] = 0.0


class TiltSpec(Table):
    """``[tilt]``: the stack at known tilts of the specimen, for a stereo pair; the operator tilts, and says so.

    Attributes
    ----------
    angles_deg : tuple of float
        Tilt of each view, as the operator sets it.
    """

    angles_deg: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]


class NotifySpec(Table):
    """``[watch] notify``: a command of the user's that is run when something happens.

    Attributes
    ----------
    on : tuple of str
        At an ``error``, when the run is ``done`` however it ends, and at a ``hold``, which waits for an answer.
    every_sections : int
        Also each time that many sections are done; 0 never.
    command : tuple of str
        Program and arguments; ``{text}`` in them becomes what happened. The run does not wait for it.
    """

    on: Annotated[tuple[Literal["error", "done", "hold"], ...], Field(strict=False)] = ("error", "done", "hold")
    every_sections: Annotated[int, Field(ge=0)] = 0
    command: Annotated[tuple[str, ...], Field(strict=False, min_length=1)]


class WatchSpec(Table):
    """``[watch]``: who hears of the run.

    Attributes
    ----------
    observer : str or None
        Where `stereotome serve` shows it; a run by itself shows nothing.
    """

    observer: str | None = None
    notify: NotifySpec | None = None


class Recipe(Table):
    """A recipe file, ``recipe.toml``."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: str = "stack"
    operator: str = ""
    notes: str = ""
    output: OutputSpec = OutputSpec()
    stack: StackSpec
    process: ProcessSpec = ProcessSpec()
    watch: WatchSpec = WatchSpec()
    sections: SectionsSpec | None = None
    series: SeriesSpec | None = None
    tilt: TiltSpec | None = None

    @model_validator(mode="after")
    def _one_thing_repeated(self) -> Recipe:
        given = [name for name in ("sections", "series", "tilt") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"give only one of [{'], ['.join(given)}]")
        return self


def load_recipe(path: Path, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read a recipe file for a run; raises `PlanError` with every problem of the file, each with its line."""
    return load_model(path, Recipe, PlanError, overrides=overrides)


def recipe_from_text(text: str, name: str, overrides: tuple[str, ...] = ()) -> Recipe:
    """Read the text of a recipe; ``name`` stands for the file in messages. Raises as `load_recipe` does."""
    return load_text(text, name, Recipe, PlanError, overrides=overrides)
