"""The command ``stereotome render``: pictures and movies of stacks and volumes, without a window."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import numpy as np
from cyclopts import Parameter

from acquire.progress import progress
from devices.errors import InputError
from display.annotate import over, overlay
from display.compose import compose
from display.gl.renderer import Renderer
from display.light import encoded
from display.load import load_volume, read_transfer
from display.modes import all_modes, find_mode, summary
from display.movie import KINDS, Sweep, frames_of, write_movie
from display.resolve import camera, fitting_pixel_um
from display.scene import Interpolation, Layer, Light, Scene, SliceLook, Transfer, View, VolumeLook
from display.stereo import Mode, Stereo, Views, vergence_deg
from processing.outputs import write_durably
from processing.pictures import png_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from devices.glasses_timing import Eye
    from display.resolve import Size
    from display.scene import Volume

    Picture = NDArray[np.uint8]

Switch = Parameter(negative="")
ALONG = {"z": View(), "y": View(elevation_deg=-90), "x": View(azimuth_deg=90)}


@Parameter(name="*")
@dataclass(frozen=True)
class Reading:
    """What is taken from the file."""

    step_um: float | None = None
    "Distance of planes; goes before what the file says."
    channels: str | None = None
    "Channels to take as bands, such as 0,2."
    planes_are_bands: Annotated[bool, Switch] = False
    "Every plane is a band."
    ratio: str | None = None
    "Show the ratio of two bands, such as 0/1."
    limits: str | None = None
    "Values shown as nothing and as full, such as 100,4000."
    colours: str | None = None
    "A colour table of matplotlib's, or a colour of full; one for each band: #ff0000,#00ff00"
    opacity: Path | None = None
    "Table (CSV) with a line of names: value, opacity 0 to 1 over the smallest side of a voxel, and red, green, blue."


@Parameter(name="*")
@dataclass(frozen=True)
class Seeing:
    """From where, and in what stereo."""

    view: str = ""
    "Azimuth, elevation and roll in degrees; 0,0,0 looks along the planes' axis."
    axis: Literal["x", "y", "z"] = "z"
    "Look along this axis; --view goes before it."
    zoom: float = 1.0
    "1 fits the whole."
    perspective: float = 0.0
    "Angle of view in degrees; 0 is a parallel view."
    stereo: Mode = "mono"
    "How two views are shown."
    eyes: Views = "shift"
    "Eyes are shifted (planes, off-axis frusta), or the specimen turns."
    vergence: float | None = None
    "Angle between the views in degrees."
    interocular_mm: float = 75.0
    "Distance of the eyes, for the angle."
    distance_mm: float = 1000.0
    "Distance of the screen, for the angle."
    depth: float = 1.0
    "Stretches depth as the eyes see it."


@Parameter(name="*")
@dataclass(frozen=True)
class Looking:
    """What the mode needs; others pass it over."""

    rule: Interpolation = "trilinear"
    "Between voxels, or each voxel as thick as it is."
    sampling: float = 1.0
    "Distance of samples along a ray, in smallest sides of a voxel."
    threshold: float | None = None
    "Value of a surface; below it slices are transparent."
    contrast: float | None = None
    "Absorption per µm of a full value, or gain of an emission."
    fade: float = 0.0
    "Share of light lost from front to back."
    surface: float = 0.0
    "Opacity of a lit surface within a translucent volume."
    shadow: Literal["none", "rear", "self", "both"] = "none"
    "Shadow on a plane behind, or of features on each other."
    light: str = "-35,40"
    "Direction the light comes from: to the right and above, degrees."
    answer: str = "0.15,0.75,0.25,20"
    "Ambient, diffuse and specular shares, and shininess."
    cut: str = ""
    "What is shown, in shares of the whole: x=0.2:0.8,z=:0.5"
    at: str = "0.5,0.5,0.5"
    "Place of planes along x, y, z, as shares of the whole."
    plane: str = "30,20"
    "Direction of an oblique plane: how far a viewer of it moved to the right, and up."
    tint: Annotated[bool, Switch] = False
    "Tint planes by their orientation."
    gap: float = 2.0
    "How far planes are pulled apart."
    planes: int = 6
    "How many planes are pulled apart."


@Parameter(name="*")
@dataclass(frozen=True)
class Moving:
    """For movies (MP4, GIF)."""

    movie: Sweep = "rotation"
    "What changes: rotation, opacity, planes, light, or tilt to and fro."
    frames: int = 72
    "How many pictures."
    fps: float = 24.0
    "Pictures a second."
    bounce: Annotated[bool, Switch] = False
    "Run back again at the end."


def render(
    data: Path | None = None,
    *,
    mode: str = "mip",
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    size: str = "800x600",
    reading: Reading = Reading(),
    seeing: Seeing = Seeing(),
    looking: Looking = Looking(),
    moving: Moving = Moving(),
    plain: Annotated[bool, Switch] = False,
    overwrite: Annotated[bool, Switch] = False,
    list_: Annotated[bool, Parameter(name="--list", negative="")] = False,
) -> int:
    """Make a picture or a movie of a stack or volume.

    Parameters
    ----------
    data
        A run, OME-Zarr, TIFF, folder of images, NPY, NPZ or NIfTI.
    mode
        What kind of picture; --list says which there are.
    output
        File to write: PNG, or MP4 or GIF for a movie.
    size
        Width and height of one view in pixels.
    plain
        Leave out scale bar, axes, colour bar and words.
    overwrite
        Replace a file that is there.
    list_
        List the modes and end.
    """
    if list_:
        sys.stdout.write("".join(f"{name:14s} {summary(each)}\n" for name, each in all_modes().items()))
        return 0
    if data is None or output is None:
        raise InputError("render needs data and a file to write.", fix="stereotome render DATA --mode mip -o x.png")
    check_output(output, overwrite=overwrite)
    chosen, pixels, stereo, view = find_mode(mode), parse_size(size), stereo_of(seeing), view_of(seeing)
    transfer, colours = read_transfer(reading.opacity) if reading.opacity else (Transfer(), None)
    look = look_of(looking, transfer, chosen.look)
    volume = volume_of(data, reading, colours)
    scene = Scene((Layer(volume, mode, look),), view, stereo)
    with Renderer() as renderer:
        write(renderer, scene, pixels, output, moving, plain=plain)
    for note in (*volume.notes, *stereo.warnings):
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(f"{output}\n")
    return 0


def write(renderer: Renderer, scene: Scene, size: Size, output: Path, moving: Moving, *, plain: bool) -> None:
    """Draw a scene and write the file."""
    if output.suffix.lower() == ".png":
        write_durably(output, png_bytes(picture(renderer, scene, size, plain=plain)))
        return
    scenes = frames_of(scene, size, moving.movie, moving.frames, bounce=moving.bounce)
    with progress("drawing", len(scenes)) as tell:

        def drawn(k: int) -> Picture:
            tell(k + 1)
            return picture(renderer, scenes[k], size, plain=plain)

        write_movie(output, (drawn(k) for k in range(len(scenes))), moving.fps)


def picture(renderer: Renderer, scene: Scene, size: Size, *, plain: bool = False, coarse: int = 1) -> Picture:
    """Draw a scene with all that has to be said on it, in its stereo; returns sRGB levels, (height, width, 3) uint8."""
    lights = views(renderer, scene, size, plain=plain, coarse=coarse)
    if len(lights) == 1:
        return encoded(lights[0])
    return encoded(compose(lights[0], lights[1], scene.stereo.mode, swap=scene.stereo.swap))


def views(
    renderer: Renderer, scene: Scene, size: Size, *, plain: bool = False, coarse: int = 1
) -> list[NDArray[np.float32]]:
    """Draw each eye's view of a scene with all that has to be said on it; returns linear light, (height, width, 3).

    ``coarse`` pixels a side are drawn as one; what is said stays sharp.
    """
    lights = [_drawn(renderer, scene, size, eye, coarse) for eye in scene.stereo.eyes]
    if not plain:
        data = scene.layers[0].data
        sheet = overlay(renderer.legend(scene, size), camera(scene, size), unit=data.unit, depth=data.depth)
        lights = [over(light, sheet) for light in lights]
    renderer.end_frame()
    return lights


def _drawn(renderer: Renderer, scene: Scene, size: Size, eye: Eye | None, coarse: int) -> NDArray[np.float32]:
    """Draw one eye's view with fewer pixels and enlarge it."""
    if coarse == 1:
        return renderer.draw(scene, size, eye)
    part = (max(size[0] // coarse, 1), max(size[1] // coarse, 1))
    pixel_um = (scene.view.pixel_um or fitting_pixel_um(scene, size)) * size[0] / part[0]
    light = renderer.draw(replace(scene, view=replace(scene.view, pixel_um=pixel_um)), part, eye)
    return np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_LINEAR), np.float32)


def volume_of(data: Path, reading: Reading, colours: Any) -> Volume:
    """Read the data as the command line has it."""
    chosen = None if reading.channels is None else numbers(reading.channels, "--channels", whole=True)
    volume = load_volume(
        data,
        step_um=reading.step_um,
        channels=None if chosen is None else [int(k) for k in chosen],
        planes_are_bands=reading.planes_are_bands,
        ratio=None if reading.ratio is None else _ratio(reading.ratio),
        quiet=False,
    )
    bands = volume.bands
    if reading.limits is not None:
        low, high = numbers(reading.limits, "--limits", count=2)
        if not low < high:
            raise InputError(f"--limits {reading.limits} is no range.", fix="the smaller value first", code="usage")
        bands = tuple(replace(band, limits=(low, high)) for band in bands)
    if reading.colours is not None:
        names = reading.colours.split(",")
        bands = tuple(replace(band, colour=names[min(k, len(names) - 1)]) for k, band in enumerate(bands))
    if colours:
        bands = tuple(replace(band, colour=colours) for band in bands)
    return replace(volume, bands=bands)


def look_of(looking: Looking, transfer: Transfer, kind: type) -> Any:
    """Return the options of a mode's kind."""
    aside, above = numbers(looking.light, "--light", count=2)
    ambient, diffuse, specular, shininess = numbers(looking.answer, "--answer", count=4)
    light = Light(aside, above, ambient, diffuse, specular, shininess)
    if kind is SliceLook:
        x, y, z = numbers(looking.at, "--at", count=3)
        turn, tilt = numbers(looking.plane, "--plane", count=2)
        place = (x, y, z)
        return SliceLook(
            looking.rule, place, turn, tilt, looking.threshold, looking.tint, looking.gap, looking.planes, light
        )
    return VolumeLook(
        interpolation=looking.rule,
        step=positive(looking.sampling, "--sampling"),
        threshold=looking.threshold,
        contrast=looking.contrast,
        fade=share(looking.fade, "--fade"),
        transfer=transfer,
        light=light,
        surface=share(looking.surface, "--surface"),
        shadow=looking.shadow,
        cut=parse_cut(looking.cut),
    )


def view_of(seeing: Seeing) -> View:
    """Return the view the command line asks for."""
    view = parse_view(seeing.view) if seeing.view else ALONG[seeing.axis]
    return replace(view, zoom=seeing.zoom, perspective_deg=seeing.perspective)


def stereo_of(seeing: Seeing) -> Stereo:
    """Return the stereo the command line asks for."""
    if seeing.stereo == "page-flip":
        raise InputError("a file shows no page flip.", fix="see it with: stereotome view", code="usage")
    angle = seeing.vergence if seeing.vergence is not None else vergence_deg(seeing.interocular_mm, seeing.distance_mm)
    return Stereo(seeing.stereo, seeing.eyes, angle, seeing.depth)


def check_output(path: Path, *, overwrite: bool) -> None:
    """Refuse a file that is there, or whose kind we do not write; asked before the work."""
    if path.suffix.lower() not in {".png", *KINDS}:
        raise InputError(
            f"{path} is of no kind that can be written.", fix="name a PNG, MP4 or GIF file.", code="output-kind"
        )
    if path.exists() and not overwrite:
        raise InputError(
            f"{path} exists already. Nothing was started.",
            fix=("choose another name: -o FILE", "replace it: --overwrite"),
            code="output-exists",
        )


def parse_size(text: str) -> Size:
    """Return width and height of ``"800x600"``."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.isdigit() and 0 < int(part) <= 16384 for part in parts):
        raise InputError(f"--size {text} is no size.", fix="width and height in pixels: --size 800x600", code="usage")
    return int(parts[0]), int(parts[1])


def parse_view(text: str) -> View:
    """Return the view of ``"azimuth,elevation,roll"``; what is left out is 0."""
    azimuth, elevation, roll = [*numbers(text, "--view"), 0.0, 0.0][:3]
    return View(azimuth, elevation, roll)


def parse_cut(text: str) -> tuple[tuple[float, float], ...]:
    """Return the shares that are shown along x, y and z of ``"x=0.2:0.8,z=:0.5"``."""
    ends = {"x": (0.0, 1.0), "y": (0.0, 1.0), "z": (0.0, 1.0)}
    for part in filter(None, text.split(",")):
        name, _, span = part.partition("=")
        low, colon, high = span.partition(":")
        try:
            ends[name.strip()] = (float(low or 0), float(high or 1)) if colon else (float("nan"),) * 2
        except ValueError:
            ends["?"] = (0.0, 0.0)
    if set(ends) != set("xyz") or not all(0 <= low < high <= 1 for low, high in ends.values()):
        raise InputError(f"--cut {text} is no part of the whole.", fix="--cut x=0.2:0.8,z=:0.5", code="usage")
    return ends["x"], ends["y"], ends["z"]


def numbers(text: str, option: str, *, count: int | None = None, whole: bool = False) -> list[float]:
    """Return the numbers of an option, separated by commas."""
    try:
        found = [float(int(part)) if whole else float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or count not in {None, len(found)} or any(abs(number) == float("inf") for number in found):
        wanted = f"{count} numbers" if count else "numbers"
        raise InputError(f"{option} {text} makes no sense.", fix=f"give {wanted}, separated by commas.", code="usage")
    return found


def share(value: float, option: str) -> float:
    """Return a number from 0 to 1."""
    if not 0 <= value <= 1:
        raise InputError(f"{option} {value:g} is no share.", fix="a number from 0 to 1", code="usage")
    return value


def positive(value: float, option: str) -> float:
    """Return a number that is positive and not tiny."""
    if not 0.01 <= value <= 100:
        raise InputError(f"{option} {value:g} makes no sense.", fix="a number from 0.01 to 100", code="usage")
    return value


def _ratio(text: str) -> tuple[int, int]:
    first, _, second = text.partition("/")
    if not (first.isdigit() and second.isdigit()):
        raise InputError(f"--ratio {text} is no ratio of bands.", fix="two numbers of bands: --ratio 0/1", code="usage")
    return int(first), int(second)
