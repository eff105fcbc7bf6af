"""Surfaces made of triangles where a volume crosses a value: their area, and meshes with smooth normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage, sparse
from skimage import measure as typed_measure

from devices.errors import InputError
from processing.neighbours import CUBIC, Spacing, checked_spacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.planes import Planes

    Array = NDArray[Any]

measure: Any = typed_measure  # half of it has type hints
STEP_BLUR = 1.0  # voxels: stairs of a mask are 8 % larger than the surface they stand for
PASS_BAND = (0.5, -0.53)  # Taubin's steps forth and back: shrinking and swelling cancel for what is smooth


@dataclass(frozen=True, eq=False)
class Facets:
    """A surface of triangles.

    Attributes
    ----------
    points : array (n, 3) float64
        In (x, y, z), µm, z upwards through the planes.
    triangles : array (m, 3) int64
        Corners, counterclockwise seen from outside.
    normals : array (n, 3) float64
        Of length 1, outwards: those of the grey values, smoother than the triangles.
    """

    points: Array
    triangles: Array
    normals: Array

    @property
    def area_um2(self) -> float:
        """Sum of the triangles."""
        return float(triangle_areas(self.points, self.triangles).sum())

    @property
    def volume_um3(self) -> float:
        """What is inside, of a closed surface: the sum of signed pyramids to the origin (Gauss)."""
        a, b, c = (self.points[self.triangles[:, k]] - self.points.mean(axis=0) for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    @property
    def is_closed(self) -> bool:
        """True when every edge has one triangle on each side, and all are turned alike."""
        edges = np.concatenate([self.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        there = np.unique(edges, axis=0, return_counts=True)
        back = np.unique(edges[:, ::-1], axis=0)
        return bool((there[1] == 1).all() and np.array_equal(there[0], back))


def triangle_areas(points: Array, triangles: Array) -> Array:
    """Return the area of each triangle."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def between_values(volume: Planes, threshold: float) -> float:
    """Return the level of the surface: of whole numbers, midway to the next that is inside."""
    return float(np.floor(threshold) + 0.5) if volume.dtype.kind in "iub" else float(threshold)


def rounded(mask: Array) -> NDArray[np.float32]:
    """Return a mask whose stairs are smoothed, 0 … 1 with the surface at 0.5."""
    return np.asarray(ndimage.gaussian_filter((mask > 0).astype(np.float32), STEP_BLUR, mode="nearest"), np.float32)


def threshold_surface(
    volume: Array, threshold: float, spacing_um: Spacing | None = None, *, closed: bool = True, start_um: float = 0.0
) -> Facets:
    """Make the surface of what is brighter than a threshold.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values, or a mask (then smooth it first: `rounded`).
    threshold : float
        Inside is what is greater.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    closed : bool
        Close it where it meets the border of the volume.
    start_um : float
        Where the first plane is.

    Returns
    -------
    Facets
        Linear between voxels (Lorensen and Cline 1987, without their ambiguities: Lewiner et al. 2003).

    Raises
    ------
    InputError
        ``mask-empty`` or ``mask-full``: no value, or every value, is greater.
    """
    spacing = np.array(checked_spacing(spacing_um or CUBIC))
    level = between_values(volume, threshold)
    check_some(volume, level)
    grey = np.asarray(volume, np.float32)
    if closed:
        grey = np.pad(grey, 1, constant_values=min(float(grey.min()), level - 1))
    points, triangles, normals, _ = measure.marching_cubes(
        grey, level, spacing=tuple(spacing), gradient_direction="descent", allow_degenerate=False
    )
    points = points - closed * spacing + (start_um, 0, 0)
    upright = normals / spacing  # the library's are those of cubes
    upright /= np.maximum(np.linalg.norm(upright, axis=1, keepdims=True), 1e-30)
    return _outwards(Facets(points[:, ::-1].astype(np.float64), triangles.astype(np.int64), upright[:, ::-1]))


def check_some(volume: Array, level: float) -> None:
    """Raise `InputError` where a level is above or below all values."""
    low, high = float(volume.min()), float(volume.max())
    if not low < level < high:
        empty = level >= high
        raise InputError(
            f"{'no' if empty else 'every'} voxel is above {level:g}: values are {low:g} … {high:g}.",
            fix="choose another threshold: --threshold V",
            code="mask-empty" if empty else "mask-full",
        )


def _outwards(facets: Facets) -> Facets:
    """Turn triangles and normals outwards, whatever the library did."""
    turned = facets if facets.volume_um3 > 0 else replace(facets, triangles=facets.triangles[:, ::-1])
    a, b, c = (turned.points[turned.triangles[:, k]] for k in range(3))
    agrees = np.einsum("ij,ij->", np.cross(b - a, c - a), turned.normals[turned.triangles[:, 0]])
    return turned if agrees > 0 else replace(turned, normals=-turned.normals)


@dataclass(frozen=True)
class Smoothed:
    """A smoothed surface, and what that did to it."""

    facets: Facets
    volume_change: float
    area_change: float


def smoothed(facets: Facets, rounds: int = 10) -> Smoothed:
    """Smooth a surface without shrinking it (Taubin 1995), and say by what share volume and area changed."""
    near = _mean_of_neighbours(facets)
    points = facets.points
    for _ in range(rounds):
        for step in PASS_BAND:
            points = points + step * (near @ points - points)
    done = replace(facets, points=points, normals=point_normals(points, facets.triangles))
    return Smoothed(
        done, done.volume_um3 / facets.volume_um3 - 1 if facets.volume_um3 else 0.0, done.area_um2 / facets.area_um2 - 1
    )


def _mean_of_neighbours(facets: Facets) -> Any:
    """Return the matrix that takes points to the means of their neighbours, near ones counting more."""
    sides = np.concatenate([facets.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    a, b = edges.T
    near = 1 / np.maximum(np.linalg.norm(facets.points[a] - facets.points[b], axis=1), 1e-9)
    count = len(facets.points)
    places = np.concatenate([a, b]), np.concatenate([b, a])
    links = sparse.csr_matrix((np.tile(near, 2), places), shape=(count, count))
    return sparse.diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1e-30)) @ links


def point_normals(points: Array, triangles: Array) -> Array:
    """Return normals of length 1, (n, 3): of the triangles around each point, by their areas; 0 where there is none."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(across[:, axis], 3), minlength=len(points)) for axis in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))
