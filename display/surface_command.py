"""The command ``stereotome surface``: surfaces of features, from meshes or labelled volumes."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import Annotated, Literal

from cyclopts import Parameter

from display.gl.renderer import Renderer
from display.load_surfaces import load_surfaces
from display.render import Moving, Seeing, check_output, numbers, parse_size, share, stereo_of, view_of, write
from display.scene import Layer, Light, Scene
from display.surfaces import SurfaceLook, Surfaces, chosen
from display.thresholded import Way, thresholded, with_lines
from processing.mesh_files import check_mesh_name, mesh_bytes
from processing.outputs import write_durably

Switch = Parameter(negative="")


@Parameter(name="*")
@dataclass(frozen=True)
class Making:
    """How a surface is made of grey values."""

    threshold: str | None = None
    "Surface of what is brighter: a number, or how it is found, such as otsu."
    between: Way = "voxels"
    "Triangles between voxels, or between outlines; where one faces several it is divided, or joined whole to each."
    smooth: int = 0
    "Rounds of smoothing; what they change of volume and surface is told."
    save: Path | None = None
    "File for the surface as well: STL, PLY or GLB, with its unit."
    table: Path | None = None
    "File for the outlines as well: CSV with area, centroid and length of each."
    pixel_um: float | None = None
    "Size of a pixel; goes before what the file says."
    channel: int | None = None
    "Channel to take when there are several; counted from 0."


def surface(
    data: Path,
    /,
    *,
    mode: Literal["surface", "outlines"] = "surface",
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    size: str = "800x600",
    opacity: float = 1.0,
    bright: str = "",
    dimmed: float = 0.25,
    one_colour: Annotated[bool, Switch] = False,
    lines: Annotated[bool, Switch] = False,
    shading: Literal["flat", "gouraud", "phong"] = "phong",
    light: str = "-35,40",
    answer: str = "0.15,0.75,0.25,20",
    step_um: float | None = None,
    making: Making = Making(),
    seeing: Seeing = Seeing(),  # noqa: B008  frozen
    moving: Moving = Moving(),  # noqa: B008
    plain: Annotated[bool, Switch] = False,
    overwrite: Annotated[bool, Switch] = False,
) -> int:
    """Draw surfaces of features, each in its colour.

    Parameters
    ----------
    data
        STL, PLY, OBJ, OFF, glTF (in µm), a volume in which each feature has a number of its own, or, with --threshold,
        a volume of grey values.
    mode
        surface, or the outlines of its sections as lines.
    output
        PNG, MP4 or GIF to write.
    size
        Width and height of one view in pixels.
    opacity
        Of all surfaces.
    bright
        Names of those that matter, separated by commas; the others are dimmed.
    dimmed
        Opacity of the others.
    one_colour
        A feature's colour says nothing about its direction; else it is darker the more it lies along the planes.
    lines
        Draw the outlines of sections as well.
    shading
        Light worked out for each facet, point or pixel.
    light
        Direction the light comes from: to the right and above, degrees.
    answer
        Ambient, diffuse and specular shares, and shininess.
    step_um
        Distance of planes; goes before what the file says.
    plain
        Leave out scale bar, axes and words.
    overwrite
        Replace a file that is there.
    """
    check_output(output, overwrite=overwrite)
    pixels, stereo, view = parse_size(size), stereo_of(seeing), view_of(seeing)
    aside, above = numbers(light, "--light", count=2)
    ambient, diffuse, specular, shininess = numbers(answer, "--answer", count=4)
    found = with_lines(_found(data, step_um, making, shaded=not one_colour), lines=lines or mode == "outlines")
    look = SurfaceLook(
        shading,
        share(opacity, "--opacity"),
        tuple(chosen(found, filter(None, bright.split(",")))),
        share(dimmed, "--dimmed"),
        Light(aside, above, ambient, diffuse, specular, shininess),
    )
    with Renderer() as renderer:
        write(renderer, Scene((Layer(found, mode, look),), view, stereo), pixels, output, moving, plain=plain)
    sys.stderr.writelines(f"note: {note}\n" for note in stereo.warnings)
    sys.stdout.write(f"{output}\n")
    return 0


def _found(data: Path, step_um: float | None, making: Making, *, shaded: bool) -> Surfaces:
    """Return what is to be drawn; a surface of a threshold is written to its files, too."""
    if making.threshold is None:
        return load_surfaces(data, step_um=step_um, shaded=shaded)
    if making.save:
        check_mesh_name(making.save)
    made = thresholded(
        data,
        making.threshold,
        way=making.between,
        smooth=making.smooth,
        pixel_um=making.pixel_um,
        step_um=step_um,
        channel=making.channel,
    )
    sys.stderr.writelines(f"note: {note}\n" for note in made.notes)
    if making.save:
        write_durably(making.save, mesh_bytes(made.facets, making.save.suffix.lower(), made.unit))
    if making.table:
        write_durably(making.table, made.table())
    return made.surfaces()
