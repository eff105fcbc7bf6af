"""Specimens of known volume, surface and topology, as a volume of grey values with smooth edges.

Each is described by its signed distance, negative inside, in µm; so it can be made at any size of voxels. The truth
that comes with it is computed from formulae, not from voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Spacing = tuple[float, float, float]
    Distance = Callable[[Array], Array]

MIDDLE, SLOPE, RAMP = 127.5, 110.0, 1.5  # grey level at the surface; levels that are reached at so many voxels from it


@dataclass(frozen=True)
class Shape:
    """A solid.

    Attributes
    ----------
    distance : callable
        Of points (..., 3) as (x, y, z) in µm around the middle: signed distance, negative inside.
    size_um : float
        Side of a cube around the middle that holds it.
    truth : dict of float
        Such as volume_um3, surface_um2, euler, features.
    """

    distance: Distance
    size_um: float
    truth: dict[str, float]


def ball(radius: float) -> Shape:
    """Return a ball."""
    truth = {"volume_um3": 4 / 3 * np.pi * radius**3, "surface_um2": 4 * np.pi * radius**2, "euler": 1, "features": 1}
    return Shape(lambda p: np.linalg.norm(p, axis=-1) - radius, 2 * radius, truth)


def shell(radius: float, thickness: float) -> Shape:
    """Return a hollow ball."""
    inner = radius - thickness
    volume, surface = 4 / 3 * np.pi * (radius**3 - inner**3), 4 * np.pi * (radius**2 + inner**2)
    middle = (radius + inner) / 2
    truth = {"volume_um3": volume, "surface_um2": surface, "euler": 2, "features": 1, "cavities": 1}
    return Shape(lambda p: np.abs(np.linalg.norm(p, axis=-1) - middle) - thickness / 2, 2 * radius, truth)


def box(sides: tuple[float, float, float]) -> Shape:
    """Return a box."""
    half = np.array(sides) / 2

    def distance(points: Array) -> Array:
        beyond = np.abs(points) - half
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0))

    a, b, c = sides
    truth = {"volume_um3": a * b * c, "surface_um2": 2 * (a * b + b * c + c * a), "euler": 1, "features": 1}
    return Shape(distance, float(np.linalg.norm(sides)), truth)


def torus(ring: float, tube: float) -> Shape:
    """Return a ring around z."""

    def distance(points: Array) -> Array:
        around = np.hypot(points[..., 0], points[..., 1]) - ring
        return np.asarray(np.hypot(around, points[..., 2]) - tube)

    truth = {"volume_um3": 2 * np.pi**2 * ring * tube**2, "surface_um2": 4 * np.pi**2 * ring * tube}
    return Shape(distance, 2 * (ring + tube), truth | {"euler": 0, "features": 1, "loops": 1})


def rod(radius: float, length: float) -> Shape:
    """Return a cylinder along z with flat ends."""

    def distance(points: Array) -> Array:
        beyond = np.stack([np.hypot(points[..., 0], points[..., 1]) - radius, np.abs(points[..., 2]) - length / 2], -1)
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0))

    surface = 2 * np.pi * radius * (radius + length)
    truth = {"volume_um3": np.pi * radius**2 * length, "surface_um2": surface, "euler": 1, "features": 1}
    return Shape(distance, float(np.hypot(2 * radius, length)), truth)


def turned(shape: Shape, seed: int) -> Shape:
    """Return it turned at random."""
    matrix = Rotation.random(random_state=seed).as_matrix()
    return Shape(lambda p: shape.distance(p @ matrix), shape.size_um, shape.truth)


def tube(curve: Array, radius: float, *, closed: bool) -> Shape:
    """Return a round tube along a curve (n, 3); what it holds is πr² times its length (Pappus), with round ends."""
    steps = np.diff(curve, axis=0, append=curve[:1] if closed else curve[-1:])
    length = float(np.linalg.norm(steps, axis=1).sum())
    ends = 0.0 if closed else 1.0
    truth = {
        "volume_um3": np.pi * radius**2 * length + ends * 4 / 3 * np.pi * radius**3,
        "surface_um2": 2 * np.pi * radius * length + ends * 4 * np.pi * radius**2,
        "euler": ends,
        "features": 1,
        "length_um": length,
    }
    return Shape(_near(curve, np.full(len(curve), radius)), 2 * float(np.abs(curve).max() + radius), truth)


def _near(points: Array, radii: Array) -> Distance:
    """Return the distance to the nearest of balls of slowly changing size; far away any large number."""
    tree = cKDTree(points)
    widest = float(radii.max())

    def distance(at: Array) -> Array:
        away, index = tree.query(at, distance_upper_bound=3 * widest + 1)
        known = np.isfinite(away)
        near = np.where(known, away, 0) - radii[np.where(known, index, 0)]
        return np.asarray(np.where(known, near, 2 * widest + 1))

    return distance


def together(shapes: Sequence[Shape]) -> Shape:
    """Return several that do not touch as one; what can be added is added."""
    names = set.intersection(*(set(shape.truth) for shape in shapes))
    truth = {name: float(sum(shape.truth[name] for shape in shapes)) for name in sorted(names)}

    def distance(points: Array) -> Array:
        return np.asarray(np.min([shape.distance(points) for shape in shapes], axis=0))

    return Shape(distance, max(shape.size_um for shape in shapes), truth)


def moved(shape: Shape, to: Sequence[float]) -> Shape:
    """Return it at another place, (x, y, z) in µm."""
    return Shape(lambda p: shape.distance(p - np.array(to)), shape.size_um + 2 * float(np.abs(to).max()), shape.truth)


def drawn(
    shape: Shape,
    spacing_um: Spacing = (1.0, 1.0, 1.0),
    *,
    size_um: float | None = None,
    offset: Sequence[float] = (0.31, 0.12, -0.23),
    noise: float = 0.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """Return grey values, (z, y, x): 127.5 at the surface, brighter inside.

    Parameters
    ----------
    spacing_um : tuple of float
        Distance of voxels along (z, y, x).
    size_um : float, optional
        Side of the cube that is shown; the shape with some voxels around it when left out.
    offset : sequence of float
        Where the middle lies between voxels, along (z, y, x).
    noise : float
        Rms, grey levels.
    """
    side = shape.size_um + 8 * max(spacing_um) if size_um is None else size_um
    counts = [max(1, round(side / step)) for step in spacing_um]
    axes = [(np.arange(n) - (n - 1) / 2 - o) * s for n, o, s in zip(counts, offset, spacing_um, strict=True)]
    slope = SLOPE / (RAMP * max(spacing_um))
    planes = np.empty(counts, np.float32)
    for k, z in enumerate(axes[0]):
        points = np.stack(np.broadcast_arrays(axes[2][None, :], axes[1][:, None], z), axis=-1)
        planes[k] = MIDDLE - slope * shape.distance(points)
    if noise:
        planes += np.random.default_rng(seed).normal(0, noise, planes.shape).astype(np.float32)
    return np.asarray(np.rint(np.clip(planes, 0, 255)), np.uint8)
