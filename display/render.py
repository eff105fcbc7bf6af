"""The command ``stereotome render``: a picture of a stack or volume, without a window."""

from __future__ import annotations

import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.errors import InputError
from display.annotate import over, overlay
from display.gl.renderer import Renderer
from display.light import encoded
from display.load import load_volume
from display.modes import all_modes, find_mode, summary
from display.resolve import camera
from display.scene import Layer, Scene, View
from processing.outputs import write_durably
from processing.pictures import png_bytes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Switch = Parameter(negative="")


def render(
    data: Path | None = None,
    *,
    mode: str = "mip",
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    size: str = "800x600",
    view: str = "0,0,0",
    step_um: float | None = None,
    plain: Annotated[bool, Switch] = False,
    overwrite: Annotated[bool, Switch] = False,
    list_: Annotated[bool, Parameter(name="--list", negative="")] = False,
) -> int:
    """Make a picture of a stack or volume.

    Parameters
    ----------
    data
        A run, OME-Zarr, TIFF, folder of images, NPY, NPZ or NIfTI.
    mode
        What kind of picture; --list says which there are.
    output
        File to write: PNG.
    size
        Width and height in pixels.
    view
        Azimuth, elevation and roll in degrees; 0,0,0 looks along the planes' axis.
    step_um
        Distance of planes; goes before what the file says.
    plain
        Leave out scale bar, axes, colour bar and words.
    overwrite
        Replace a file that is there.
    list_
        List the modes and end.
    """
    if list_:
        sys.stdout.write("".join(f"{name:20s} {summary(each)}\n" for name, each in all_modes().items()))
        return 0
    if data is None or output is None:
        raise InputError("render needs data and a file to write.", fix="stereotome render DATA --mode mip -o x.png")
    check_output(output, overwrite=overwrite)
    chosen, pixels = find_mode(mode), parse_size(size)
    volume = load_volume(data, step_um=step_um, quiet=False)
    scene = Scene((Layer(volume, mode, chosen.look()),), parse_view(view))
    with Renderer() as renderer:
        write_durably(output, png_bytes(picture(renderer, scene, pixels, plain=plain)))
    for note in volume.notes:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(f"{output}\n")
    return 0


def picture(renderer: Renderer, scene: Scene, size: tuple[int, int], *, plain: bool = False) -> NDArray[np.uint8]:
    """Draw a scene with all that has to be said on it; returns sRGB levels, (height, width, 3) uint8."""
    light = renderer.draw(scene, size)
    if not plain:
        layer = scene.layers[0]
        sheet = overlay(find_mode(layer.mode).legend(layer), camera(scene, size), unit=layer.data.unit)
        light = over(light, sheet)
    return encoded(light)


def check_output(path: Path, *, overwrite: bool) -> None:
    """Refuse a file that is there, or whose kind we do not write; asked before the work."""
    if path.suffix.lower() != ".png":
        raise InputError(f"{path} is of no kind that can be written.", fix="name a PNG file.", code="output-kind")
    if path.exists() and not overwrite:
        raise InputError(
            f"{path} exists already. Nothing was started.",
            fix=("choose another name: -o FILE", "replace it: --overwrite"),
            code="output-exists",
        )


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of ``"800x600"``."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) for part in parts):
        raise InputError(f"--size {text} is no size.", fix="width and height in pixels: --size 800x600", code="usage")
    return int(parts[0]), int(parts[1])


def parse_view(text: str) -> View:
    """Return the view of ``"azimuth,elevation,roll"``; what is left out is 0."""
    try:
        azimuth, elevation, roll = ([float(part) for part in text.split(",")] + [0.0, 0.0])[:3]
    except ValueError:
        words = f"--view {text} is no view."
        raise InputError(words, fix="angles in degrees: --view 30,20,0", code="usage") from None
    return View(azimuth, elevation, roll)
