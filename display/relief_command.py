"""The command ``stereotome relief``: range images as maps, profiles and surfaces."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import numpy as np
from cyclopts import Parameter

from devices.errors import InputError
from display.gl.renderer import Renderer
from display.relief import Paint, Relief, ReliefLook, Shading
from display.relief_plots import (
    Edges,
    contour_lines,
    contour_map,
    levels,
    nice_increment,
    profile,
    profile_picture,
    stacked_picture,
)
from display.render import Moving, Seeing, check_output, numbers, parse_size, stereo_of, view_of, write
from display.scene import Layer, Light, Scene
from processing.heights import read_heights
from processing.outputs import write_durably
from processing.pictures import png_bytes
from processing.result_folder import csv_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.heights import Heights

Switch = Parameter(negative="")
Kind = Literal["relief", "isometric", "grid", "contour", "profile", "stacked"]
WANTED_SHARE = 0.15  # of the width, for the heights when nobody says how far to stretch them
NICE = (1.0, 2.0, 5.0)
OBLIQUE = "25,-50"


@Parameter(name="*")
@dataclass(frozen=True)
class OnPaper:
    """For contour maps and profiles."""

    line: tuple[str, ...] = ()
    "A profile's ends, x0,y0,x1,y1 in the heights' unit; may be given again. Middle row and column if left out."
    increment: float | None = None
    "Distance of lines of equal height; also drawn on surfaces."
    edges: Edges = "interpolated"
    "Lines through pixels, or along their edges."
    rows: int = 40
    "How many profiles are stacked."


@Parameter(name="*")
@dataclass(frozen=True)
class OnSurface:
    """For surfaces."""

    exaggeration: float | None = None
    "How far heights are stretched; so that they are well seen if left out. Stated on the picture."
    shading: Shading = "phong"
    "Light worked out for each facet (flat), point (gouraud) or pixel (phong)."
    paint: Paint | None = None
    "One grey, a colour table over the heights, the table over and over, or an image. Plain if left out."
    colours: str | None = None
    "Name of the table."
    cycles: float = 8.0
    "How often the table is run through."
    drape: Path | None = None
    "Image that is laid over the relief, such as the extended focus."
    light: str = "-35,40"
    "Direction the light comes from: to the right and above, degrees."
    answer: str = "0.15,0.75,0.25,20"
    "Ambient, diffuse and specular shares, and the exponent of the mirrored lobe: large is narrow."


def relief(
    data: Path,
    /,
    *,
    mode: Kind = "relief",
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    size: str = "800x600",
    pixel: float | None = None,
    unit: str | None = None,
    paper: OnPaper = OnPaper(),
    surface: OnSurface = OnSurface(),
    seeing: Seeing = Seeing(),  # noqa: B008  frozen
    moving: Moving = Moving(),  # noqa: B008
    plain: Annotated[bool, Switch] = False,
    overwrite: Annotated[bool, Switch] = False,
) -> int:
    """Draw a range image: lit surface, coloured surface, grid, contour map, profiles.

    Profiles and contour lines are written as a table (CSV) beside the picture, too.

    Parameters
    ----------
    data
        Heights: range.tif, another TIFF, NPY, NPZ, or a file of an instrument (al3d, di, mi, opd … with the extra
        heights).
    mode
        relief: lit; isometric: colours alone; grid: lines; contour: a map; profile: along lines; stacked: row by row.
    output
        PNG to write; of surfaces also MP4 or GIF.
    size
        Width and height of one view of a surface in pixels.
    pixel
        Size of a pixel; goes before what the file says.
    unit
        Of heights and pixels; goes before what the file says.
    plain
        Leave out scale bar, axes, colour bar and words.
    overwrite
        Replace a file that is there.
    """
    check_output(output, overwrite=overwrite)
    on_paper = mode in {"contour", "profile", "stacked"}
    if on_paper and output.suffix.lower() != ".png":
        raise InputError(f"{output}: {mode} is no movie.", fix="name a PNG file.", code="output-kind")
    pixels, stereo, view = parse_size(size), stereo_of(seeing), replace(seeing, view=seeing.view or OBLIQUE)
    heights = read_heights(data, pixel=pixel, unit=unit)
    if on_paper:
        drawn, table = paper_of(heights, mode, paper, surface.colours or "viridis")
        write_durably(output, png_bytes(drawn))
        if table is not None:
            write_durably(output.with_suffix(".csv"), table)
            sys.stdout.write(f"{output.with_suffix('.csv')}\n")
    else:
        scene = Scene((surface_of(heights, mode, paper, surface),), view_of(view), stereo)
        with Renderer() as renderer:
            write(renderer, scene, pixels, output, moving, plain=plain)
    sys.stdout.write(f"{output}\n")
    sys.stderr.writelines(f"note: {note}\n" for note in (*heights.notes, *stereo.warnings))
    return 0


def paper_of(heights: Heights, mode: Kind, paper: OnPaper, colours: str) -> tuple[NDArray[np.uint8], bytes | None]:
    """Draw a map or profiles; return the picture and the numbers behind it."""
    if mode == "stacked":
        return stacked_picture(heights, max(paper.rows, 2)), None
    if mode == "contour":
        increment = paper.increment or nice_increment(heights)
        drawn = contour_map(heights, increment, edges=paper.edges, colours=colours)
        found = ((level, contour_lines(heights, level, paper.edges)) for level in levels(heights, increment))
        rows = ((level, k, *point) for level, lines in found for k, line in enumerate(lines) for point in line)
        return drawn, csv_bytes(("level", "line", "x", "y"), rows)
    down, across = heights.pixel
    height, width = heights.values.shape
    right, below = (width - 1) * across, (height - 1) * down
    usual = ((0.0, below / 2, right, below / 2), (right / 2, 0.0, right / 2, below))
    lines = [numbers(text, "--line", count=4) for text in paper.line] or usual
    profiles = [profile(heights, ((x0, y0), (x1, y1))) for x0, y0, x1, y1 in lines]
    points = ((k, *pair) for k, p in enumerate(profiles, 1) for pair in zip(p.distance, p.height, strict=True))
    return profile_picture(heights, profiles, colours), csv_bytes(("line", "distance", "height"), points)


def surface_of(heights: Heights, mode: Kind, paper: OnPaper, surface: OnSurface) -> Layer:
    """Return a surface as the command line wants it."""
    aside, above = numbers(surface.light, "--light", count=2)
    ambient, diffuse, specular, shininess = numbers(surface.answer, "--answer", count=4)
    image = None if surface.drape is None else read_drape(surface.drape)
    usual: Paint = "image" if image is not None else "cycles" if surface.colours == "hsv" else "plain"
    look = ReliefLook(
        surface.shading,
        surface.paint or usual,
        surface.colours or "viridis",
        surface.cycles,
        paper.increment or 0.0,
        Light(aside, above, ambient, diffuse, specular, shininess),
    )
    if look.paint == "image" and image is None:
        raise InputError("--paint image wants an image.", fix="--drape extended_focus.png", code="usage")
    shown = Relief(heights, surface.exaggeration or usual_exaggeration(heights), image)
    return Layer(shown, mode, look)


def usual_exaggeration(heights: Heights) -> float:
    """Return 1, 2, 5, 10 … by which heights have to be stretched to be seen; never less than 1."""
    low, high = heights.limits
    width = max(n * p for n, p in zip(heights.values.shape, heights.pixel, strict=True))
    wanted = max(WANTED_SHARE * width / (high - low), 1.0)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(n for n in NICE if n * power <= wanted * (1 + 1e-9)))


def read_drape(path: Path) -> NDArray[np.uint8]:
    """Return an image as (y, x, 3) uint8; 16 bit is stretched."""
    from processing.pictures import preview  # noqa: PLC0415

    found: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise InputError(f"{path}: no image that can be read.", fix="give a PNG or TIFF.", code="input-missing")
    levels8 = preview(found)
    return np.ascontiguousarray(cv2.cvtColor(levels8, cv2.COLOR_GRAY2RGB) if levels8.ndim == 2 else levels8[..., 2::-1])
