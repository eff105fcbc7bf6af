"""Bands: channels, filters and lights of an instrument as named settings, and how a camera takes them on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Protocol, runtime_checkable

from pydantic import AfterValidator, Field

from devices.errors import RigError, did_you_mean
from devices.toml_model import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from devices.protocols import Camera

Setting = str | int | float | bool


class BandSpec(Table):
    """``[[band]]``.

    Attributes
    ----------
    name : str
        By which a plan asks for it: letters, digits, ``-``, ``_`` and ``+``.
    exposure_ms : float or None
        Exposure in this band; None takes the plan's.
    settings : dict
        Property of the camera, or of what hangs on it, to value. Micro-Manager: ``"Filter.Label" = "GFP"``, without a
        point of the camera itself; GenICam: names of features.
    unit : str
        What the pixels of this band count.
    colour : str or None
        ``"#rrggbb"``, in which viewers show it.
    """

    name: Annotated[str, Field(pattern=r"^[\w+-]{1,40}$")]
    exposure_ms: Annotated[float | None, Field(gt=0)] = None
    settings: Annotated[dict[str, Setting], Field(default_factory=dict)]
    unit: str = "counts"
    colour: Annotated[str | None, Field(pattern=r"^#[0-9a-fA-F]{6}$")] = None


def _each_once(bands: tuple[BandSpec, ...]) -> tuple[BandSpec, ...]:
    names = [band.name for band in bands]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"more than one band is called {', '.join(twice)}")
    return bands


Bands = Annotated[tuple[BandSpec, ...], Field(strict=False), AfterValidator(_each_once)]


@runtime_checkable
class BandSwitch(Protocol):
    """A camera whose properties, and those of what hangs on it, can be set by name."""

    def apply_settings(self, settings: Mapping[str, Setting]) -> None:
        """Set each property and read it back, in the order given; to be called while not armed.

        Raises
        ------
        RigError
            There is no such property; nothing was set.
        Refused
            A value was not taken on.
        """
        ...


def choose_bands(bands: Sequence[BandSpec], names: Sequence[str]) -> tuple[BandSpec, ...]:
    """Return the bands a plan asks for, in its order.

    Raises
    ------
    RigError
        The instrument has no such band, or one is asked for twice.
    """
    known = {band.name: band for band in bands}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise RigError(f"there is no band '{unknown[0]}'{did_you_mean(unknown[0], list(known))}")
    if len(set(names)) != len(names):
        raise RigError(f"a band is asked for twice: {', '.join(names)}", fix="name each band once.")
    return tuple(known[name] for name in names)


def switch_band(camera: Camera, band: BandSpec, exposure_ms: float) -> None:
    """Take on a band while the camera is not armed; ``exposure_ms`` counts where the band has none of its own.

    Raises
    ------
    RigError
        The camera cannot set properties or has not this one, or its frames have another shape or type in this band.
    Refused, LimitError
        The camera did not take on a value.
    """
    before = camera.caps()
    if band.settings:
        if not isinstance(camera, BandSwitch):
            raise RigError(
                f"band '{band.name}': the camera {before.name} has no properties to set.",
                fix="take its settings out of the instrument file, or use a micro-manager or genicam camera.",
            )
        camera.apply_settings(band.settings)
    camera.configure(exposure_ms=band.exposure_ms or exposure_ms)
    after = camera.caps()
    if (after.shape, after.dtype) != (before.shape, before.dtype):
        raise RigError(
            f"band '{band.name}': frames of {after.shape} {after.dtype}, before it {before.shape} {before.dtype}.",
            fix="the bands of a stack are all of one size and type: leave those settings out of the band.",
        )
