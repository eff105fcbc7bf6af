"""Surfaces from files: meshes as they are, and labelled volumes, one surface and its outlines for each label."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from scipy import ndimage
from skimage import measure as typed_measure

from acquire.progress import progress
from devices.errors import InputError
from display.load import load_volume
from display.surfaces import Mesh, Surfaces, palette, shaded_by_direction
from processing.readers import reading

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from display.scene import Volume

    Array = NDArray[Any]

measure: Any = typed_measure  # half of it has type hints
MESHES = (".stl", ".ply", ".obj", ".off", ".glb", ".gltf")
MOST_LABELS = 5000


def load_surfaces(path: Path, *, step_um: float | None = None, shaded: bool = True, quiet: bool = False) -> Surfaces:
    """Read meshes, in µm, or a volume of labels (0 is nothing).

    Parameters
    ----------
    shaded : bool
        A feature is the darker the more it lies along the planes.

    Raises
    ------
    InputError
        ``surfaces``: neither, or a volume of grey levels.
    """
    if path.suffix.lower() in MESHES:
        with reading(path):
            return _meshes(path)
    volume = load_volume(path, step_um=step_um, quiet=quiet)
    return of_labels(volume, shaded=shaded, quiet=quiet)


def _meshes(path: Path) -> Surfaces:
    found: Any = trimesh.load(path, force="scene")
    parts = [(name, part) for name, part in found.geometry.items() if hasattr(part, "faces") and len(part.faces)]
    if not parts:
        raise InputError(f"{path}: holds no surface.", fix="give STL, PLY, OBJ, OFF or glTF.", code="surfaces")
    colours = palette(len(parts)) if len(parts) > 1 else [(0.8, 0.8, 0.8)]
    meshes = (
        Mesh(np.asarray(part.vertices), np.asarray(part.faces), colour, 1.0, str(name))
        for (name, part), colour in zip(parts, colours, strict=True)
    )
    return Surfaces(tuple(meshes))


def of_labels(volume: Volume, *, shaded: bool = True, quiet: bool = True) -> Surfaces:
    """Return a surface, with the outlines of its sections, for each value of a volume above 0.

    A surface lies midway between voxels of a label and others; sizes of voxels are honoured.
    """
    values = volume.bands[0].values
    places = ndimage.find_objects(values)
    labels = [k for k, place in enumerate(places, start=1) if place is not None]
    if not labels or len(labels) > MOST_LABELS:
        raise InputError(
            f"{len(labels)} values above 0 are no labels of features.",
            fix="give a volume in which each feature has a number of its own.",
            code="surfaces",
        )
    meshes = []
    with progress("surfaces", len(labels), quiet=quiet) as tell:
        for k, (label, colour) in enumerate(zip(labels, palette(len(labels)), strict=True)):
            mesh = _of_label(values, label, places[label - 1], volume, colour)
            if shaded:
                mesh = Mesh(
                    mesh.points,
                    mesh.triangles,
                    shaded_by_direction(colour, mesh.points),
                    name=mesh.name,
                    lines=mesh.lines,
                )
            meshes.append(mesh)
            tell(k + 1)
    return Surfaces(tuple(meshes), volume.unit)


def _of_label(values: Array, label: int, place: Any, volume: Volume, colour: tuple[float, float, float]) -> Mesh:
    inside = np.pad((values[place] == label).astype(np.float32), 1)
    begin = np.array([part.start for part in place], np.float64) - 1
    corners, faces, _, _ = measure.marching_cubes(inside, 0.5)
    lines = [
        np.column_stack([np.full(len(line), z), line])
        for z in range(1, inside.shape[0] - 1)
        for line in measure.find_contours(inside[z], 0.5)
    ]
    starts = np.cumsum([len(corners), *map(len, lines)])
    ends = [np.column_stack([np.arange(a, b - 1), np.arange(a + 1, b)]) for a, b in pairwise(starts)]
    points = np.concatenate([corners, *lines]) + begin
    um = points[:, ::-1] * volume.voxel_um
    pieces = np.concatenate(ends) if ends else np.empty((0, 2), np.uint32)
    return Mesh(um, faces, colour, name=str(label), lines=pieces)
