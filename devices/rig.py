"""The instrument file: what is connected and what it may do; read with every problem at once, opened in order."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from devices.bands import Bands  # noqa: TC001  pydantic reads the annotations
from devices.errors import DeviceError, LinkLost, RigError, StereotomeError
from devices.feed_spec import FeedSpec  # noqa: TC001
from devices.glasses_spec import GlassesSpec  # noqa: TC001
from devices.registry import DeviceContext, factory, unknown_driver
from devices.toml_model import Table, load_model
from devices.values import Limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from devices.protocols import Camera, Clock, Eyewear, Feed, Stage
    from devices.registry import Kind


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
NEEDED_BY_CAMERA = {"folder": ("source", "step_um"), "opencv": ("source",)}
Pixels = Annotated[int, Field(ge=1, le=65535)]


def _known_camera(name: str) -> str:
    return _known(name, unknown_driver(name, "camera"))


def _known_stage(name: str) -> str:
    return _known(name, unknown_driver(name, "stage"))


def _known(name: str, problem: str | None) -> str:
    if problem:
        raise ValueError(problem)
    return name


class CameraSpec(Table):
    """``[camera]``.

    Attributes
    ----------
    driver : str
        ``sim``, ``folder``, ``opencv``, or any installed entry point.
    source : str or None
        folder: images or a multi-page TIFF, relative to the instrument file; opencv: index, device, file or pattern.
    address : str or None
        sim: ``"127.0.0.1:PORT"`` of the bench, as `stereotome sim serve` writes it.
    size_px : (int, int) or None
        Width and height; None takes what the camera has.
    pixel_um : float or None
        Pitch of the pixels at the sensor.
    z0_um, step_um : float
        folder: z of the first image, and from each image to the next (negative: downwards).
    """

    driver: Annotated[str, AfterValidator(_known_camera)]
    source: str | None = None
    address: str | None = None
    size_px: Annotated[tuple[Pixels, Pixels] | None, Field(strict=False)] = None
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    pixel_um: Positive | None = None
    exposure_ms: Positive = 10.0
    z0_um: float = 0.0
    step_um: float | None = None

    @model_validator(mode="after")
    def _has_what_its_driver_needs(self) -> CameraSpec:
        missing = [key for key in NEEDED_BY_CAMERA.get(self.driver, ()) if getattr(self, key) is None]
        if missing:
            raise ValueError(f"the driver '{self.driver}' needs {' and '.join(missing)}")
        return self


class OpticsSpec(Table):
    """``[optics]``: of the objective, and the wavelength that sets its depth of field."""

    magnification: Positive
    na: Positive
    medium_index: Annotated[float, Field(ge=1)] = 1.0
    wavelength_um: Positive = 0.55

    @model_validator(mode="after")
    def _na_below_index(self) -> OpticsSpec:
        if self.na >= self.medium_index:
            raise ValueError(f"na {self.na:g} must be below medium_index {self.medium_index:g}")
        return self


class LimitsSpec(Table):
    """Soft limits of an axis in µm, ends included."""

    min_um: float
    max_um: float

    @model_validator(mode="after")
    def _in_order(self) -> LimitsSpec:
        if self.min_um >= self.max_um:
            raise ValueError(f"min_um {self.min_um:g} must be below max_um {self.max_um:g}")
        return self


class AxisSpec(Table):
    """``[stage.z]``.

    Attributes
    ----------
    port : str
        Device name or pyserial URL: ``/dev/serial/by-id/…``, ``COM5``, ``socket://host:port``.
    units_per_um : float
        Controller units in a µm; 10 for ASI, which counts tenths.
    invert : bool
        The controller counts downwards where this file counts upwards.
    axis : str or None
        The axis' name at a controller that has several (PI); None takes the only one.
    limits : LimitsSpec
        Soft limits, enforced in the driver before any byte is sent.
    park_um : float or None
        Where faults and shutdown may leave the axis; None: where it is.
    settle_ms : float
        Rest after the arrival, before `Stage.settle` returns.
    backlash_um : float
        Lost motion; planes are approached from one side, from further away than this.
    may_move_on_enable : bool
        An axis that lost its reference may search it when it is opened, anywhere within its travel.
    reference_by : str
        What it searches: ``switch``, ``negative-limit`` or ``positive-limit``.
    """

    driver: Annotated[str, AfterValidator(_known_stage)]
    port: str
    baud: Annotated[int, Field(ge=50, le=4_000_000)] = 9600
    units_per_um: Positive = 10.0
    invert: bool = False
    axis: str | None = None
    limits: LimitsSpec
    park_um: float | None = None
    speed_um_s: Positive | None = None
    settle_ms: NotNegative = 0.0
    backlash_um: NotNegative = 0.0
    may_move_on_enable: bool = False
    reference_by: Literal["switch", "negative-limit", "positive-limit"] = "switch"

    @property
    def soft_limits(self) -> Limits:
        """The limits as drivers use them."""
        return Limits(self.limits.min_um, self.limits.max_um)

    @model_validator(mode="after")
    def _park_inside_limits(self) -> AxisSpec:
        if self.park_um is not None and not self.limits.min_um <= self.park_um <= self.limits.max_um:
            raise ValueError(f"park_um {self.park_um:g} is outside the limits")
        return self


class StageSpec(Table):
    """``[stage]``: the axes."""

    z: AxisSpec


class SimSpec(Table):
    """``[sim]``: the simulated bench that stands in for this instrument.

    Attributes
    ----------
    faults : tuple of str
        Such as ``"z.late@3"``; `stereotome sim serve` knows them.
    """

    seed: Annotated[int, Field(ge=0)] = 7
    faults: Annotated[tuple[str, ...], Field(strict=False)] = ()
    specimen: Literal["relief", "depth", "block"] = "relief"


class RigSpec(Table):
    """An instrument file, ``instrument.toml``.

    Attributes
    ----------
    band : tuple of BandSpec
        Channels, filters and lights as named settings.
    microtome : FeedSpec or None
        The feed of a microtome or polisher, if there is one.
    glasses : GlassesSpec or None
        Shutter glasses, if there are any.
    input : dict or None
        Accepted as it is: its keys are not looked at until the program takes input from such devices.
    """

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: str
    notes: str = ""
    camera: CameraSpec
    optics: OpticsSpec
    stage: StageSpec
    sim: SimSpec = SimSpec()
    band: Bands = ()
    microtome: FeedSpec | None = None
    glasses: GlassesSpec | None = None
    input: dict[str, Any] | None = None

    @property
    def object_pixel_um(self) -> float | None:
        """Size of a pixel at the object in µm, None when the sensor's is not known."""
        return None if self.camera.pixel_um is None else self.camera.pixel_um / self.optics.magnification


def load_rig(path: Path, overrides: Sequence[str] = ()) -> RigSpec:
    """Read an instrument file; ``overrides`` as in `devices.toml_model.load_model`.

    Raises
    ------
    RigError
        With every problem of the file, each with its line.
    """
    spec = load_model(path, RigSpec, RigError, overrides=overrides)
    if spec.camera.driver != "folder" or spec.camera.source is None:
        return spec
    source = str(path.absolute().parent / spec.camera.source)
    return spec.model_copy(update={"camera": spec.camera.model_copy(update={"source": source})})


class Rig:
    """An open instrument.

    Attributes
    ----------
    spec : RigSpec
        What the file says.
    stage : Stage
        The z axis.
    camera : Camera
        The camera.
    feed : Feed or None
        Of the microtome, if the file names one.
    glasses : Eyewear or None
        Shutter glasses, if the file names any.

    Parameters
    ----------
    open_camera : callable, optional
        Opens the camera anew; what cannot do it is the camera it was for ever.
    """

    def __init__(
        self,
        spec: RigSpec,
        stage: Stage,
        camera: Camera,
        feed: Feed | None = None,
        glasses: Eyewear | None = None,
        *,
        open_camera: Callable[[], Camera] | None = None,
    ) -> None:
        self.spec = spec
        self.stage = stage
        self.camera = camera
        self.feed = feed
        self.glasses = glasses
        self._open_camera = open_camera

    def reopen_camera(self) -> Camera:
        """Open the camera anew, after its connection was lost, and return it.

        Raises
        ------
        DeviceError
            It does not answer, or another kind of camera does (device-other). The one before stays the rig's.
        """
        if self._open_camera is None:
            return self.camera
        before = self.camera
        with suppress(StereotomeError):  # nobody may be there to be told
            before.close()
        camera: Camera = self._open_camera()
        if camera.caps().shape != before.caps().shape or camera.caps().dtype != before.caps().dtype:
            camera.close()
            raise DeviceError(
                "camera: another one answers than before.",
                fix="connect the one the run began with",
                code="device-other",
            )
        self.camera = camera
        return camera


@contextmanager
def open_rig(spec: RigSpec, *, clock: Clock, transcript: Path | None = None) -> Iterator[Rig]:
    """Open stage, feed, glasses and camera in this order; close them in reverse, whatever happens between.

    Parameters
    ----------
    spec : RigSpec
        The instrument.
    clock : Clock
        Time for all devices.
    transcript : Path, optional
        Folder into which each link records its exchanges.

    Raises
    ------
    RigError
        A driver is not installed, or its table lacks a key it needs.
    DeviceError
        A device is missing, silent or taken.
    """
    with ExitStack() as open_devices:
        context = DeviceContext(clock, transcript)
        stage: Stage = _opened("stage", spec.stage.z, context, open_devices)
        feed: Feed | None = _opened("feed", spec.microtome, context, open_devices)
        glasses: Eyewear | None = _opened("glasses", spec.glasses, context, open_devices)
        seeing = DeviceContext(clock, transcript, stage.position_um)
        open_camera = partial(factory(spec.camera.driver, "camera"), spec.camera, seeing)
        rig = Rig(spec, stage, open_camera(), feed, glasses, open_camera=open_camera)
        open_devices.callback(_close_camera, rig)
        yield rig


def _close_camera(rig: Rig) -> None:
    """Close the camera there is by then; one that went away cannot be asked to."""
    with suppress(LinkLost):
        rig.camera.close()


def _opened(
    kind: Kind,
    table: AxisSpec | CameraSpec | FeedSpec | GlassesSpec | None,
    context: DeviceContext,
    open_devices: ExitStack,
) -> Any:
    """Open what a table names, None without one."""
    if table is None:
        return None
    device = factory(table.driver, kind)(table, context)
    open_devices.callback(device.close)
    return device
