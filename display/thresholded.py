"""Surfaces of a threshold, for drawing and for files: triangles between voxels, or between outlines of sections."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.store import is_run
from display.surfaces import Mesh, Surfaces
from processing.facets import Facets, between_values, check_some, rounded, smoothed, threshold_surface
from processing.grey_volume import read_volume
from processing.outlines import Outline, outlines
from processing.result_folder import csv_bytes
from processing.thresholds import values_of
from processing.tiling import tile
from processing.volume_filters import checked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.grey_volume import GreyVolume

    Array = NDArray[Any]

Way = Literal["voxels", "divided", "whole"]
COLOUR = (0.85, 0.72, 0.55)
COLUMNS = ("section", "z", "area", "x", "y", "length")


@dataclass(frozen=True, eq=False)
class Thresholded:
    """A surface, its outlines, and what must be said.

    Attributes
    ----------
    facets : Facets
    outlines : list of Outline
    unit : str
        Of lengths.
    notes : tuple of str
    flipped : bool
        High z is nearer to the viewer.
    """

    facets: Facets
    outlines: list[Outline]
    unit: str
    notes: tuple[str, ...] = field(default=())
    flipped: bool = False

    def surfaces(self) -> Surfaces:
        """Return it as what a scene holds, with its outlines as lines."""
        lines = [np.column_stack([o.points, np.full(len(o.points), o.z_um)]) for o in self.outlines]
        starts = np.cumsum([len(self.facets.points), *map(len, lines)])
        around = [np.column_stack([np.arange(n), np.roll(np.arange(n), -1)]) for n in map(len, lines)]
        ends = [pairs + start for pairs, start in zip(around, starts, strict=False)]
        points, triangles = np.concatenate([self.facets.points, *lines]), self.facets.triangles
        normals = np.concatenate([self.facets.normals, np.zeros((len(points) - len(self.facets.points), 3))])
        if self.flipped:
            points, normals, triangles = points * (1, 1, -1), normals * (1, 1, -1), triangles[:, ::-1]
        pieces = np.concatenate(ends) if ends else np.empty((0, 2), np.int64)
        mesh = Mesh(points, triangles, COLOUR, name="surface", lines=pieces, normals=normals)
        return Surfaces((mesh,), self.unit)

    def table(self) -> bytes:
        """Return the outlines as CSV: a line for each, holes with areas below zero."""
        unit = self.unit.replace("µ", "u")
        names = [COLUMNS[0], *(f"{name}_{unit}{'2' if name == 'area' else ''}" for name in COLUMNS[1:])]
        rows = [[o.section, o.z_um, o.area_um2, *o.centroid_um, o.length_um] for o in self.outlines]
        return csv_bytes(names, rows)


def thresholded(
    data: Path,
    threshold: str,
    *,
    way: Way = "voxels",
    smooth: int = 0,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
) -> Thresholded:
    """Read a volume and make the surface of what is brighter than a threshold.

    Parameters
    ----------
    threshold : str
        A number, or a method such as otsu.
    way : {"voxels", "divided", "whole"}
        Triangles between voxels, or between outlines of sections, one that faces several divided among them or joined
        to each as a whole.
    smooth : int
        Rounds of smoothing; what they change is told.

    Raises
    ------
    InputError
        As `read_volume`; ``mask-empty``, ``mask-full``, ``threshold``.
    """
    volume = read_volume(data, pixel_um=pixel_um, step_um=step_um, channel=channel)
    grey, level = _grey(volume, threshold)
    check_some(grey, level)
    rings = outlines(grey, level, volume.spacing, start_um=volume.start_um)
    notes = list(volume.notes)
    if way == "voxels":
        facets = threshold_surface(grey, level, volume.spacing, start_um=volume.start_um)
    else:
        tiled = tile(rings, way)
        facets = tiled.facets
        if tiled.splits and way == "whole":
            notes.append(f"{tiled.splits} splits: pieces run into each other; their volume is counted twice there.")
    if smooth:
        done = smoothed(facets, smooth)
        facets = done.facets
        notes.append(f"smoothing changed volume by {done.volume_change:+.2%}, surface by {done.area_change:+.2%}.")
    unit = volume.unit
    closed = "closed" if facets.is_closed else "not closed"
    notes.append(f"surface {closed}: {facets.area_um2:.5g} {unit}², volume {facets.volume_um3:.5g} {unit}³.")
    return Thresholded(facets, rings, unit, tuple(notes), is_run(data) or volume.reversed)


def _grey(volume: GreyVolume, threshold: str) -> tuple[Array, float]:
    """Return grey values and a level that no voxel has."""
    values = checked(volume.values)
    known = values_of(values)
    level = between_values(values, known.level(threshold))
    if known.two:
        return rounded(values > level), 0.5
    return values, level


def with_lines(found: Surfaces, *, lines: bool) -> Surfaces:
    """Leave the outlines out unless they are asked for."""
    if lines:
        return found
    return replace(found, meshes=tuple(replace(mesh, lines=mesh.lines[:0]) for mesh in found.meshes))
