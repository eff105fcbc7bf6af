"""One bench: an axis, a specimen, the optics between them, and the controllers that move and cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from devices.toml_write import toml_text
from sim.block import Block
from sim.face_sensor import BlockSpecimen, FaceSensor
from sim.faults import Faults
from sim.feed import FeedMachine, Knife, Microtome
from sim.lamp import Lamp
from sim.motion import Axis, Ringing
from sim.optics import Optics
from sim.sensor import Sensor
from sim.specimen import make_specimen
from sim.stages import stage_kind

if TYPE_CHECKING:
    from devices.protocols import Clock
    from devices.rig import RigSpec
    from devices.values import Limits
    from sim.camera import FrameMaker
    from sim.feed_line import FeedTwin
    from sim.specimen import Specimen
    from sim.stages import Twin

DEFAULT_SIZE_PX = (512, 512)
DEFAULT_PIXEL_UM = 3.45
TOP_SPEED_UM_S = 2000.0
REACH_UM = 20.0
SHARE_OF_LIMITS = 0.4
RING_OUTS_PER_SETTLE = 5

TITLE = "# Written by the simulated bench; it holds as long as this bench runs.\n"


@dataclass(frozen=True)
class Bench:
    """The simulated instrument, complete but without wires.

    Attributes
    ----------
    axis : Axis
        The truth about z.
    twin : Twin
        The controller that moves it.
    specimen : Specimen or BlockSpecimen
        What is seen.
    sensor : FrameMaker
        What sees it.
    feed : FeedTwin or None
        The drive of the microtome with its knife, if there is one.
    """

    spec: RigSpec
    axis: Axis
    twin: Twin
    specimen: Specimen | BlockSpecimen
    sensor: FrameMaker
    feed: FeedTwin | None = None


def build_bench(spec: RigSpec, clock: Clock, faults: Faults | None = None) -> Bench:
    """Build what an instrument file describes; what it leaves open is as on the default bench.

    The mechanics ring for as long as ``settle_ms`` says one has to wait. The axis starts at 0 µm, the specimen lies
    around it; in the middle of the limits, if these leave no room there.
    """
    faults = Faults((), clock) if faults is None else faults
    table, limits = spec.stage.z, spec.stage.z.soft_limits
    axis = Axis(
        clock,
        limits,
        position_um=_centre_um(limits),
        speed_um_s=max(TOP_SPEED_UM_S, table.speed_um_s or 0.0),
        backlash_um=table.backlash_um,
        ringing=Ringing(table.settle_ms / 1000 / RING_OUTS_PER_SETTLE),
    )
    block = Block(faults, seed=spec.sim.seed)
    feed = _feed(spec, clock, block)
    specimen, sensor = _seen(spec, faults, feed.microtome if feed else _uncut(clock, block))
    return Bench(spec, axis, stage_kind(table.driver).make(axis, table), specimen, sensor, feed)


def _feed(spec: RigSpec, clock: Clock, block: Block) -> FeedTwin | None:
    if spec.microtome is None:
        return None
    from sim.feed_line import build_feed_twin  # noqa: PLC0415  a bench without a microtome does without

    return build_feed_twin(spec.microtome, clock, block)


def _uncut(clock: Clock, block: Block) -> Microtome:
    """Return what holds a block in front of no knife."""
    machine = FeedMachine(clock, block=block)
    return Microtome(machine, Knife(clock, machine))


def _seen(
    spec: RigSpec, faults: Faults, microtome: Microtome
) -> tuple[Specimen, Sensor] | tuple[BlockSpecimen, FaceSensor]:
    """Make the specimen, and the sensor that looks at it."""
    lens, size_px, seed = spec.optics, spec.camera.size_px or DEFAULT_SIZE_PX, spec.sim.seed
    centre_um = _centre_um(spec.stage.z.soft_limits)
    pixel_um = spec.object_pixel_um or DEFAULT_PIXEL_UM / lens.magnification
    optics = Optics(lens.na, lens.medium_index, lens.wavelength_um, pixel_um)
    depth, exposure_ms, lamp = spec.camera.bit_depth, spec.camera.exposure_ms, Lamp(faults, seed=seed)
    if spec.sim.specimen == "block":
        from sim.solid import Solid  # noqa: PLC0415  it is compiled, and only a block needs it

        block = BlockSpecimen(Solid(seed), size_px, pixel_um, centre_um)
        return block, FaceSensor(
            block, microtome, optics, bit_depth=depth, exposure_ms=exposure_ms, seed=seed, lamp=lamp
        )
    reach_um = _reach_um(spec.stage.z.soft_limits)
    specimen = make_specimen(spec.sim.specimen, size_px, pixel_um, seed=seed, centre_um=centre_um, reach_um=reach_um)
    return specimen, Sensor(specimen, optics, bit_depth=depth, exposure_ms=exposure_ms, seed=seed, lamp=lamp)


def instrument_text(bench: Bench, ports: dict[str, str]) -> str:
    """Return the instrument file of a bench.

    Parameters
    ----------
    bench : Bench
        What it describes; what the file of the instrument left open is told as it is here.
    ports : dict of str to str
        Where the devices are: ``camera``, ``z``, ``feed``, ``glasses``; what has no port is left out.
    """
    height, width = bench.sensor.caps().shape
    told = bench.spec.model_dump(mode="json", by_alias=True, exclude_none=True)
    kept = {key: told["camera"][key] for key in ("bit_depth", "exposure_ms")}
    told["camera"] = {
        "driver": "sim",
        "address": ports["camera"],
        "size_px": [width, height],
        "pixel_um": bench.spec.camera.pixel_um or DEFAULT_PIXEL_UM,
        **kept,
    }
    told["stage"]["z"].update(port=ports["z"], speed_um_s=bench.axis.speed_um_s)
    for table, device in (("microtome", "feed"), ("glasses", "glasses")):
        told.pop(table, None)
        if device in ports:
            given = getattr(bench.spec, table).model_dump(mode="json", exclude_unset=True)
            told[table] = {**given, "port": ports[device]}
    return TITLE + toml_text(told)


def _centre_um(limits: Limits) -> float:
    around_zero = limits.min_um <= -REACH_UM and limits.max_um >= REACH_UM
    return 0.0 if around_zero else (limits.min_um + limits.max_um) / 2


def _reach_um(limits: Limits) -> float:
    return min(REACH_UM, SHARE_OF_LIMITS * (limits.max_um - limits.min_um))
