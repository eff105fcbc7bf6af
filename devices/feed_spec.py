"""``[microtome]`` of an instrument file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, Field, model_validator

from devices.errors import RigError
from devices.profile import Action, LinkTable, Profile, load_profile
from devices.toml_model import Table

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Unit = Annotated[int, Field(ge=1, le=247)]


def _loads(name: str) -> str:
    try:
        load_profile(name)
    except RigError as error:
        raise ValueError(error.what) from None
    return name


ProfileName = Annotated[str, AfterValidator(_loads)]


class FeedLimits(Table):
    """How deep and how thick: the travel of the feed, and the thickness of one section."""

    feed_um_min: float = 0.0
    feed_um_max: float
    thickness_nm_min: Positive = 20
    thickness_nm_max: Positive = 2000

    @model_validator(mode="after")
    def _in_order(self) -> FeedLimits:
        for low, high in (("feed_um_min", "feed_um_max"), ("thickness_nm_min", "thickness_nm_max")):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} must be below {high}")
        return self


class KnifeSpec(Table):
    """``[microtome.knife]``: the unit that drives the knife, and the stroke.

    Attributes
    ----------
    profile, unit
        Of the controller on the same line; None: the one of the feed.
    window_um : (float, float)
        Where the stroke begins and ends; the knife cuts from the first towards the second.
    speed_um_s : float
        Cutting speed.
    clearance_um : float
        How far the feed draws back before the knife returns.
    grace_s : float
        What a stroke may take beyond window over speed.
    """

    profile: ProfileName | None = None
    unit: Unit | None = None
    window_um: Annotated[tuple[float, float], Field(strict=False)] = (1500.0, 0.0)
    speed_um_s: Positive = 300.0
    clearance_um: NotNegative = 20.0
    grace_s: Positive = 15.0


class FeedSpec(Table):
    """``[microtome]``: a microtome's or polisher's feed over Modbus.

    Attributes
    ----------
    profile : str
        A shipped register map or the path of one.
    port : str
        Serial port for RTU, ``host:port`` for the two kinds over TCP.
    link, baud, parity, unit, timeout_s, gap_ms, word_order, counts_per_um, invert, backlash_um, speed_um_s
        Replace what the profile says, for this installation.
    kind : str
        A microtome cuts what it advanced; a polisher removes some, and that is measured afterwards.
    """

    driver: str = "modbus"
    profile: ProfileName
    port: str
    kind: Literal["microtome", "polisher"] = "microtome"
    link: Literal["rtu", "tcp", "rtu_over_tcp"] | None = None
    baud: Annotated[int, Field(ge=300, le=4_000_000)] | None = None
    parity: Literal["N", "E", "O"] | None = None
    unit: Unit | None = None
    timeout_s: Positive | None = None
    gap_ms: NotNegative | None = None
    word_order: Literal["big", "little"] | None = None
    counts_per_um: Positive | None = None
    invert: bool | None = None
    backlash_um: NotNegative | None = None
    speed_um_s: Positive | None = None
    limits: FeedLimits
    knife: KnifeSpec | None = None
    interlock: Literal["knife_clear", "none"] = "knife_clear"
    home_timeout_s: Positive = 120.0

    @model_validator(mode="after")
    def _limits_inside_profile(self) -> FeedSpec:
        axis = load_profile(self.profile).axis
        if not axis.min_um <= self.limits.feed_um_min < self.limits.feed_um_max <= axis.max_um:
            raise ValueError(
                f"limits: feed_um_min … feed_um_max must lie within {axis.min_um:g} … {axis.max_um:g} µm of the profile"
            )
        if self.limits.thickness_nm_max > axis.max_step_um * 1000:
            raise ValueError(f"limits: thickness_nm_max is above the profile's max_step_um {axis.max_step_um:g} µm")
        return self

    @model_validator(mode="after")
    def _fits_into_registers(self) -> FeedSpec:
        profile = self.feed_profile()
        axis = profile.axis
        for depth_um in (self.limits.feed_um_min, self.limits.feed_um_max):
            supplied = {"pos": round(depth_um * axis.counts_per_um), "acc": axis.acc, "dec": axis.dec, "seq": 0}
            profile.writes(profile.do.move_abs, supplied | {"speed": round(axis.speed_um_s * axis.speed_per_um_s)})
        return self

    def feed_profile(self) -> Profile:
        """Return the register map with what this installation replaces."""
        profile = load_profile(self.profile)
        axis = _replaced(self, ("counts_per_um", "invert", "backlash_um", "speed_um_s"))
        if self.counts_per_um is not None:
            ratio = self.counts_per_um / profile.axis.counts_per_um
            axis["speed_per_um_s"] = profile.axis.speed_per_um_s * ratio
        return profile.model_copy(
            update={
                "link": self.link_of(profile),
                "address": profile.address.model_copy(update=_replaced(self, ("word_order",))),
                "axis": profile.axis.model_copy(update=axis),
            }
        )

    def knife_profile(self) -> Profile:
        """Return the register map of the knife's controller; its link has the knife's unit."""
        table, own = self.knife or KnifeSpec(), self.feed_profile()
        profile = load_profile(table.profile) if table.profile else own
        unit = table.unit or (profile if table.profile else own).link.unit
        return profile.model_copy(update={"link": own.link.model_copy(update={"unit": unit})})

    def stops(self) -> list[tuple[Profile, Action]]:
        """Return what stops the feed and, if there is one, the knife."""
        feed, knife = self.feed_profile(), self.knife_profile()
        own = [(feed, feed.do.stop)]
        return own if knife.knife is None else [*own, (knife, knife.knife.stop)]

    def link_of(self, profile: Profile) -> LinkTable:
        """Return the link with what this installation replaces."""
        changes = _replaced(self, ("baud", "parity", "unit", "timeout_s", "gap_ms"))
        if self.link is not None:
            changes["kind"] = self.link
        return profile.link.model_copy(update=changes)


class MicrotomeFile(BaseModel):
    """An instrument file of which only ``[microtome]`` matters: the feed can be tried before the rest is there."""

    microtome: FeedSpec | None = None


def _replaced(spec: FeedSpec, names: tuple[str, ...]) -> dict[str, object]:
    return {name: value for name in names if (value := getattr(spec, name)) is not None}
