"""The command ``stereotome snap``: pictures without a run, with all that is known about them."""

from __future__ import annotations

import json as json_text
import sys
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from acquire.progress import progress
from acquire.recorder import disk_failed
from acquire.served import found_or_started
from acquire.snapshots import frame_of, write_frames
from devices.errors import InputError

if TYPE_CHECKING:
    from acquire.client import Instrument
    from acquire.frame import Frame

Flag = Annotated[bool, Parameter(negative="")]
Roi = tuple[int, int, int, int]
MOST = 200
SUFFIXES = (".tif", ".tiff")


def snap(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    sim: Flag = False,
    server: str | None = None,
    keys: Path | None = None,
    count: Annotated[int, Parameter(name=["--count", "-n"], validator=Number(gte=1, lte=MOST))] = 1,
    z: float | None = None,
    exposure_ms: float | None = None,
    roi: Annotated[Roi | None, Parameter(negative_iterable=())] = None,
    json: Flag = False,
) -> None:
    """Take a picture, or a few one after the other, without a run.

    The file is a TIFF with the pixels as they came, their size, when, where and how they were taken. Nothing is moved
    unless --z says so.

    Parameters
    ----------
    output
        The TIFF file; must not exist.
    instrument
        The instrument file; without it and --sim, the only instrument that is served here.
    sim
        Take the simulated bench in place of the hardware.
    server
        The process that serves the instrument: its name, its connection file, or tcp://HOST:PORT.
    keys
        Folder with this client's keys, for an instrument on another computer.
    count
        How many, as pages of the file.
    z
        Where the stage is brought before, in µm; it stays there.
    exposure_ms
        Another exposure than the instrument's; it stays set while the instrument is served.
    roi
        Part of the frame: X Y WIDTH HEIGHT in pixels; needs --exposure-ms.
    json
        One JSON object instead of words.
    """
    _check(output, exposure_ms, roi)
    served = found_or_started(instrument, sim=sim, server=server, keys=keys)
    try:
        with served.connect() as client:
            client.command()
            _prepare(client, z, exposure_ms, roi)
            frames = _taken(client, count)
            rig = client.instrument()
    finally:
        served.end()
    try:
        write_frames(output, frames, {"instrument": rig.name, "pixel_um": rig.object_pixel_um})
    except OSError as cause:
        raise disk_failed(cause) from cause
    _tell(output, frames, as_json=json)


def _check(output: Path, exposure_ms: float | None, roi: Roi | None) -> None:
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(f"{output} is no TIFF file by its name.", fix="give a name that ends with .tif", code="usage")
    if output.exists():
        raise InputError(f"{output} exists. Nothing was taken.", fix="choose another name.", code="output-exists")
    if not output.parent.is_dir():
        raise InputError(f"there is no folder {output.parent}.", fix="make it first.", code="output-folder")
    if roi is not None and exposure_ms is None:
        raise InputError("--roi is set together with the exposure.", fix="give --exposure-ms too.", code="usage")


def _prepare(client: Instrument, z_um: float | None, exposure_ms: float | None, roi: Roi | None) -> None:
    if exposure_ms is not None:
        client.set_camera(exposure_ms, roi)
    if z_um is not None:
        client.move(z_um)


def _taken(client: Instrument, count: int) -> list[Frame]:
    frames = []
    with progress("taking pictures", count, quiet=count == 1) as tell:
        for number in range(count):
            frames.append(frame_of(client.picture()))
            tell(number + 1)
    return frames


def _tell(output: Path, frames: list[Frame], *, as_json: bool) -> None:
    first = frames[0]
    told = {
        "file": str(output),
        "pictures": len(frames),
        "z_um": first.header.z_um,
        "exposure_ms": first.header.exposure_ms,
        "shape": first.pixels.shape,
    }
    if as_json:
        sys.stdout.write(json_text.dumps(told) + "\n")
    else:
        sys.stdout.write(f"{output}: {len(frames)} at {first.header.z_um:+.2f} µm, {first.header.exposure_ms:g} ms\n")
