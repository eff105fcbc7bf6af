"""One bench: an axis, a specimen, the optics between them, and the two faces of the axis."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from devices.values import Limits
from sim.controllers.asi import Ms2000
from sim.motion import Axis, Ringing
from sim.optics import Optics
from sim.sensor import Sensor
from sim.specimen import make_specimen

if TYPE_CHECKING:
    from devices.protocols import Clock
    from devices.rig import RigSpec
    from sim.specimen import Specimen

DEFAULT_SIZE_PX = (512, 512)
DEFAULT_PIXEL_UM = 3.45
TOP_SPEED_UM_S = 2000.0
REACH_UM = 20.0
SHARE_OF_LIMITS = 0.4
RING_OUTS_PER_SETTLE = 5
IDLE_AXES = Limits(-50_000.0, 50_000.0)

INSTRUMENT = """\
# Written by the simulated bench; it holds as long as this bench runs.
schema = 1
name = {name}
notes = {notes}

[camera]
driver = "sim"
address = {camera}
size_px = [{width}, {height}]
bit_depth = {bit_depth}
pixel_um = {pixel_um}
exposure_ms = {exposure_ms}

[optics]
magnification = {magnification}
na = {na}
medium_index = {medium_index}
wavelength_um = {wavelength_um}

[stage.z]
driver = "asi-ms2000"
port = {stage}
baud = {baud}
limits = {{ min_um = {min_um}, max_um = {max_um} }}
speed_um_s = {speed_um_s}
settle_ms = {settle_ms}
backlash_um = {backlash_um}
{park}
[sim]
seed = {seed}
faults = {faults}
specimen = {specimen}
"""


@dataclass(frozen=True)
class Bench:
    """The simulated instrument, complete but without wires.

    Attributes
    ----------
    axis : Axis
        The truth about z.
    twin : Ms2000
        The controller that moves it.
    specimen : Specimen
        What is seen.
    sensor : Sensor
        What sees it.
    """

    spec: RigSpec
    axis: Axis
    twin: Ms2000
    specimen: Specimen
    sensor: Sensor


def build_bench(spec: RigSpec, clock: Clock) -> Bench:
    """Build what an instrument file describes; what it leaves open is as on the default bench.

    The mechanics ring for as long as ``settle_ms`` says one has to wait. The axis starts at 0 µm, the specimen lies
    around it; in the middle of the limits, if these leave no room there.
    """
    table, limits = spec.stage.z, spec.stage.z.soft_limits
    centre_um = _centre_um(limits)
    axis = Axis(
        clock,
        limits,
        position_um=centre_um,
        speed_um_s=max(TOP_SPEED_UM_S, table.speed_um_s or 0.0),
        backlash_um=table.backlash_um,
        ringing=Ringing(table.settle_ms / 1000 / RING_OUTS_PER_SETTLE),
    )
    optics, size_px = spec.optics, spec.camera.size_px or DEFAULT_SIZE_PX
    pixel_um = spec.object_pixel_um or DEFAULT_PIXEL_UM / optics.magnification
    specimen = make_specimen(
        spec.sim.specimen, size_px, pixel_um, seed=spec.sim.seed, centre_um=centre_um, reach_um=_reach_um(limits)
    )
    sensor = Sensor(
        specimen,
        Optics(optics.na, optics.medium_index, optics.wavelength_um, pixel_um),
        bit_depth=spec.camera.bit_depth,
        exposure_ms=spec.camera.exposure_ms,
        seed=spec.sim.seed,
    )
    twin = Ms2000({"X": Axis(clock, IDLE_AXES), "Y": Axis(clock, IDLE_AXES), "Z": axis})
    return Bench(spec, axis, twin, specimen, sensor)


def instrument_text(bench: Bench, *, camera: str, stage: str) -> str:
    """Return the instrument file of a bench whose camera and stage have these addresses."""
    spec, table, limits = bench.spec, bench.spec.stage.z, bench.spec.stage.z.limits
    height, width = bench.sensor.caps().shape
    park = "" if table.park_um is None else f"park_um = {table.park_um}\n"
    return INSTRUMENT.format(
        **{key: json.dumps(value) for key, value in spec.model_dump(include={"name", "notes"}).items()},
        **spec.optics.model_dump(),
        **limits.model_dump(),
        **table.model_dump(include={"baud", "settle_ms", "backlash_um"}),
        camera=json.dumps(camera),
        stage=json.dumps(stage),
        width=width,
        height=height,
        bit_depth=spec.camera.bit_depth,
        pixel_um=spec.camera.pixel_um or DEFAULT_PIXEL_UM,
        exposure_ms=spec.camera.exposure_ms,
        speed_um_s=bench.axis.speed_um_s,
        park=park,
        seed=spec.sim.seed,
        faults=json.dumps(list(spec.sim.faults)),
        specimen=json.dumps(spec.sim.specimen),
    )


def _centre_um(limits: Limits) -> float:
    around_zero = limits.min_um <= -REACH_UM and limits.max_um >= REACH_UM
    return 0.0 if around_zero else (limits.min_um + limits.max_um) / 2


def _reach_um(limits: Limits) -> float:
    return min(REACH_UM, SHARE_OF_LIMITS * (limits.max_um - limits.min_um))
