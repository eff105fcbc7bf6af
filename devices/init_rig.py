"""``stereotome devices init``: a short dialogue that writes an instrument file and tries it."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.errors import DeviceError, InputError, RigError
from devices.probe import BAUDS, probe_port, words
from devices.registry import DeviceContext, drivers, factory
from devices.rig import load_rig, open_rig
from devices.toml_write import toml_value
from devices.transport.ports import ports_present

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.probe import Found

UNITS_PER_UM = {"asi-ms2000": 10.0, "asi-tiger": 10.0, "pi-gcs2": 1.0, "prior-proscan": 10.0}
LIMITS_UM = {"pi-gcs2": (0.0, 100.0)}
USUAL_LIMITS_UM = (-100.0, 100.0)
USUAL_BAUD = 9600
NOBODY_KNOWN = "no controller that is known answered here when this file was written"
SOURCES = {
    "sim": ("Address of the simulated camera", "127.0.0.1:0"),
    "folder": ("Folder of the images", "images"),
    "opencv": ("Index or device of the camera", "0"),
}
NO_DEPTH = (
    "# bit_depth = 12           # bits of a pixel that mean something: the camera did not answer when this was written"
)
RIG = """\
# Written by `stereotome devices init`. What every key means: docs/instrument.md
# See whether it is well: stereotome config check FILE; where the stage is: stereotome stage show -i FILE
schema = 1
name = {name}

[camera]
driver = {camera}          # sim, folder, opencv, or another installed driver
{camera_keys}exposure_ms = 10.0
{depth}
# pixel_um = 3.45          # pitch of the pixels at the sensor: without it pictures have no scale

[optics]
magnification = {magnification}
na = {na}

[stage.z]
# {found}
driver = {driver}
port = {port}
baud = {baud}
units_per_um = {units_per_um}      # what the controller counts in a µm
# Soft limits, checked before any byte is sent. Drive to both ends by hand first, with the objective in mind.
limits = {{ min_um = {min_um}, max_um = {max_um} }}
# park_um = 0.0            # a safe place
settle_ms = 20.0           # rest after each arrival
backlash_um = 1.0          # planes are approached from one side, from further off than this
"""


@dataclass(frozen=True)
class Answers:
    """What was given as options; None is asked for."""

    port: str | None
    camera: str | None
    source: str | None
    magnification: float | None
    na: float | None
    min_um: float | None
    max_um: float | None


@dataclass(frozen=True)
class Bench:
    """What an instrument file is made of; ``seen`` is a remark on who answered at the port."""

    name: str
    camera: str
    source: str
    magnification: float
    na: float
    seen: str
    driver: str
    port: str
    baud: int
    min_um: float
    max_um: float


def init(
    file: Path,
    /,
    *,
    port: str | None = None,
    camera: str | None = None,
    source: str | None = None,
    magnification: float | None = None,
    na: float | None = None,
    min_um: float | None = None,
    max_um: float | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
) -> None:
    """Ask a few questions, write an instrument file from the answers, and try it; nothing moves.

    Answers may come through a pipe, a line each; an empty one takes what stands in brackets. What is given as an
    option is not asked.

    Parameters
    ----------
    file
        The instrument file to write.
    port
        Serial port of the z stage.
    camera
        Driver of the camera.
    source
        What the camera's driver opens: a folder, an index, a device, or the address of a simulated camera.
    magnification
        Of the objective.
    na
        Numerical aperture of the objective.
    min_um
        Lower soft limit of z.
    max_um
        Upper soft limit of z.
    overwrite
        Replace a file that exists.
    """
    if file.exists() and not overwrite:
        raise InputError(f"{file} exists already.", fix="choose another name, or add --overwrite", code="output-exists")
    text = _dialogue(file.stem, Answers(port, camera, source, magnification, na, min_um, max_um))
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as cause:
        raise InputError(f"{file}: {cause.strerror}.", fix="name a file that can be written") from cause
    _say(f"\nWrote {file}.")
    _try(file)


def _dialogue(name: str, given: Answers) -> str:
    """Ask for what is missing and return the text of the file."""
    port = given.port or _ask_port()
    found, seen = _probed(port)
    driver = found.driver if found else _choice("Driver of the z stage", list(drivers("stage")), "asi-ms2000")
    low_um, high_um = LIMITS_UM.get(driver, USUAL_LIMITS_UM)
    camera = given.camera or _choice("Driver of the camera", list(drivers("camera")), "opencv")
    source = given.source or (_ask(*SOURCES[camera]) if camera in SOURCES else "")
    return rig_text(
        Bench(
            name=name,
            camera=camera,
            source=source,
            magnification=given.magnification or _number("Magnification of the objective", 20.0, _positive),
            na=given.na or _number("Its numerical aperture", 0.45, _positive),
            seen=seen,
            driver=driver,
            port=port,
            baud=found.baud if found else round(_number("Its baud", USUAL_BAUD, _positive)),
            min_um=_given(given.min_um, lambda: _number("Lower soft limit of z in µm", low_um)),
            max_um=_given(given.max_um, lambda: _number("Upper soft limit of z in µm", high_um)),
        )
    )


def rig_text(bench: Bench) -> str:
    """Return the text of an instrument file."""
    return RIG.format(
        name=toml_value(bench.name),
        camera=toml_value(bench.camera),
        camera_keys=_camera_keys(bench.camera, bench.source),
        depth=NO_DEPTH,
        magnification=bench.magnification,
        na=bench.na,
        found=bench.seen,
        driver=toml_value(bench.driver),
        port=toml_value(bench.port),
        baud=bench.baud,
        units_per_um=UNITS_PER_UM.get(bench.driver, 10.0),
        min_um=bench.min_um,
        max_um=bench.max_um,
    )


def _given(value: float | None, ask: Callable[[], float]) -> float:
    return ask() if value is None else value


def _ask_port() -> str:
    names = [port.name for port in ports_present()]
    for number, name in enumerate(names, 1):
        _say(f"  {number}: {name}")
    answer = _ask("Serial port of the z stage", names[0] if names else "")
    if answer.isdigit() and 0 < int(answer) <= len(names):
        return names[int(answer) - 1]
    if not answer:
        raise DeviceError(
            "there is no serial port on this machine now, and none was named.",
            fix="connect the controller, or name a port: --port socket://HOST:PORT",
            code="device-missing",
        )
    return answer


def _probed(port: str) -> tuple[Found | None, str]:
    """Ask who is there; say it, and return it with a remark for the file."""
    _say(f"Asking who is at {port} …")
    report = probe_port(port, BAUDS, SystemClock())
    found = report.found
    if found is None or found.driver not in drivers("stage"):
        for line in words(report, port):
            _say(line)
        return None, NOBODY_KNOWN
    _say(f"  {found.name}, {found.baud} baud: driver {found.driver}")
    return found, remark(found)


def remark(found: Found) -> str:
    """Return what the file says of the controller that answered."""
    return f"answered as: {json.dumps(found.name)[1:-1]}"


def _camera_keys(camera: str, source: str) -> str:
    """Return the lines that this driver cannot do without."""
    if camera == "sim":
        return f"address = {toml_value(source)}\n"
    if camera == "folder":
        return f"source = {toml_value(source)}\nstep_um = 1.0\n"
    return f"source = {toml_value(source)}\n" if source else ""


def _try(file: Path) -> None:
    """Open what the file names and say what answers; a camera that does not is not the stage's fault."""
    spec = load_rig(file)
    with closing(factory(spec.stage.z.driver, "stage")(spec.stage.z, DeviceContext(SystemClock()))) as stage:
        z_um = stage.position_um()
    _say(f"z stage: it is at {z_um:+.2f} µm.")
    if not stage.limits.min_um <= z_um <= stage.limits.max_um:
        _say("  warning: that is outside the limits; correct them in the file before the first move.")
    with open_rig(spec, clock=SystemClock()) as rig:
        caps = rig.camera.caps()
    note_bit_depth(file, caps.bit_depth)
    _say(f"camera: {caps.name}, {caps.width} x {caps.height} pixels, {caps.bit_depth} bit.")
    _say("Both answer. Next: stereotome run RECIPE.toml -i " + str(file))


def note_bit_depth(file: Path, bits: int) -> None:
    """Put into a file that `rig_text` made how many bits its camera's pixels have, now that it answered."""
    file.write_text(file.read_text(encoding="utf-8").replace(NO_DEPTH, f"bit_depth = {bits}"), encoding="utf-8")


# -- the terminal ----------------------------------------------------------------------------------------------------


def _ask(question: str, usual: str) -> str:
    """Ask and return the answer, the usual one for an empty line or the end of a pipe."""
    sys.stderr.write(f"{question} [{usual}]: ")
    sys.stderr.flush()
    return sys.stdin.readline().strip() or usual


def _choice(question: str, known: list[str], usual: str) -> str:
    answer = _ask(f"{question} ({', '.join(sorted(known))})", usual)
    if answer not in known:
        raise RigError(f"'{answer}' is none of {', '.join(sorted(known))}.", fix="start again, and choose one of these")
    return answer


def _number(question: str, usual: float, check: Callable[[float], bool] = lambda _: True) -> float:
    answer = _ask(question, f"{usual:g}")
    try:
        value = float(answer.replace(",", "."))
    except ValueError:
        raise RigError(f"{question}: '{answer}' is no number.", fix="start again, and write one such as 20") from None
    if not check(value):
        raise RigError(f"{question}: {value:g} cannot be.", fix="start again, and give a number above 0")
    return value


def _positive(value: float) -> bool:
    return value > 0


def _say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
