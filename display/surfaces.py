"""Surfaces of features as they are drawn: facets, colours, opacity, order. Plain values and pure functions."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError
from display.light import linear_of
from display.scene import Light
from processing.facets import point_normals

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from display.resolve import Camera

    Array = NDArray[Any]
    Colour = tuple[float, float, float]

GOLDEN = 0.381966  # of a turn: hues that stay apart however many there are
SATURATIONS, VALUES = (0.55, 0.85), (0.75, 1.0)
DIM_GREY = 0.35
LEAST_SHADE = 0.45  # of a feature that lies in the planes' direction
OPAQUE = 0.999


@dataclass(frozen=True, eq=False)
class Mesh:
    """One surface.

    Attributes
    ----------
    points : array (n, 3)
        In (x, y, z), z away from the viewer of the planes.
    triangles : array (m, 3) int
        Corners; may be none, of a feature that is all lines.
    colour : (float, float, float)
        sRGB, 0 to 1.
    opacity : float
        0 to 1.
    name : str
    lines : array (k, 2) int
        Ends of lines, such as outlines of sections.
    normals : array (n, 3), optional
        Of length 1, where they are known better than from the triangles.
    """

    points: Array
    triangles: Array
    colour: Colour = (0.8, 0.8, 0.8)
    opacity: float = 1.0
    name: str = ""
    lines: Array = field(default_factory=lambda: np.empty((0, 2), np.uint32))
    normals: Array | None = None

    def __post_init__(self) -> None:
        points, count = np.asarray(self.points), len(self.points)
        corners = np.concatenate([np.ravel(self.triangles), np.ravel(self.lines)])
        fits = points.ndim == 2 and points.shape[1:] == (3,) and np.isfinite(points).all()
        if not fits or (len(corners) and not 0 <= corners.min() <= corners.max() < count):
            raise DisplayError(f"the surface {self.name or 'given'} has corners that are no points.", code="surface")
        if not 0 <= self.opacity <= 1:
            raise DisplayError(
                f"the surface {self.name or 'given'} has an opacity of {self.opacity:g}.", code="surface"
            )


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Several surfaces in one space, moved so that their middle is the origin.

    Attributes
    ----------
    meshes : tuple of Mesh
    unit : str
        Of lengths.
    """

    meshes: tuple[Mesh, ...]
    unit: str = "µm"
    depth: str = "z"
    low: Array = field(init=False)
    high: Array = field(init=False)

    def __post_init__(self) -> None:
        points = [mesh.points for mesh in self.meshes if len(mesh.points)]
        if not points:
            raise DisplayError("there is no surface to draw.", fix="lower the threshold, or give a file with one.")
        object.__setattr__(self, "low", np.min([p.min(axis=0) for p in points], axis=0))
        object.__setattr__(self, "high", np.max([p.max(axis=0) for p in points], axis=0))

    @property
    def size_um(self) -> Array:
        """Size along (x, y, z)."""
        return np.asarray(np.maximum(self.high - self.low, 1e-9))


@dataclass(frozen=True)
class SurfaceLook:
    """How surfaces are drawn.

    Attributes
    ----------
    shading : {"phong", "gouraud", "flat"}
    opacity : float
        Multiplies each surface's own.
    bright : tuple of str
        Names of the surfaces that matter; the others are dimmed. None: all.
    dimmed : float
        Opacity the others are multiplied by, and how far they turn grey.
    light : Light
    """

    shading: str = "phong"
    opacity: float = 1.0
    bright: tuple[str, ...] = ()
    dimmed: float = 0.25
    light: Light = field(default_factory=Light)


def palette(count: int) -> list[Colour]:
    """Return colours, sRGB, that differ as much as so many can: hues by the golden section, two tones each."""
    tones = [(s, v) for v in VALUES[::-1] for s in SATURATIONS[::-1]]
    return [colorsys.hsv_to_rgb((k * GOLDEN) % 1.0, *tones[k % len(tones)]) for k in range(count)]


def shaded_by_direction(colour: Colour, points: Array) -> Colour:
    """Return a darker shade of a colour the more a feature's longest axis lies in the plane of the picture (x, y)."""
    centred = np.asarray(points, np.float64) - np.mean(points, axis=0)
    axis = np.linalg.svd(centred.T @ centred)[0][:, 0] if len(points) > 1 else np.array([0.0, 0.0, 1.0])
    shade = LEAST_SHADE + (1 - LEAST_SHADE) * abs(float(axis[2]))
    red, green, blue = (shade * part for part in colour)
    return red, green, blue


@dataclass(frozen=True, eq=False)
class Joined:
    """All surfaces as one list of points.

    Attributes
    ----------
    position, normal : array (n, 3) float32
    tone : array (n, 4) float32
        Linear light and opacity.
    triangles, lines : array uint32
    """

    position: Array
    normal: Array
    tone: Array
    triangles: Array
    lines: Array


def joined(surfaces: Surfaces, look: SurfaceLook) -> Joined:
    """Put all surfaces into one list, dimmed where they should be."""
    middle = (surfaces.low + surfaces.high) / 2
    starts = np.cumsum([0, *(len(mesh.points) for mesh in surfaces.meshes)])
    moved = zip(surfaces.meshes, starts, strict=False)
    numbers = [(mesh.triangles + start, mesh.lines + start) for mesh, start in moved]
    return Joined(
        np.concatenate([mesh.points - middle for mesh in surfaces.meshes]).astype(np.float32),
        np.concatenate([_normals(mesh) for mesh in surfaces.meshes]).astype(np.float32),
        np.concatenate([np.tile(_tone(mesh, look), (len(mesh.points), 1)) for mesh in surfaces.meshes]).astype(
            np.float32
        ),
        np.concatenate([triangles for triangles, _ in numbers]).astype(np.uint32).reshape(-1, 3),
        np.concatenate([lines for _, lines in numbers]).astype(np.uint32).reshape(-1, 2),
    )


def _normals(mesh: Mesh) -> Array:
    return point_normals(mesh.points, mesh.triangles) if mesh.normals is None else mesh.normals


def _tone(mesh: Mesh, look: SurfaceLook) -> Array:
    colour, opacity = linear_of(np.array(mesh.colour)), mesh.opacity * look.opacity
    if look.bright and mesh.name not in look.bright:
        colour = look.dimmed * colour + (1 - look.dimmed) * DIM_GREY
        opacity *= look.dimmed
    return np.append(colour, opacity)


def in_order(whole: Joined, camera: Camera) -> tuple[Array, Array]:
    """Return the opaque facets, and the others from the farthest to the nearest for this camera."""
    opaque = (whole.tone[whole.triangles, 3] >= OPAQUE).all(axis=1)
    others = whole.triangles[~opaque]
    centres = whole.position[others].mean(axis=1)
    if camera.eye is None:
        away = centres @ (camera.axis / np.linalg.norm(camera.axis))
    else:
        away = np.linalg.norm(centres - camera.eye, axis=1)
    return whole.triangles[opaque], np.ascontiguousarray(others[np.argsort(-away, kind="stable")])


def chosen(surfaces: Surfaces, names: Iterable[str]) -> Sequence[str]:
    """Return the names that are there; raises `DisplayError` for one that is not."""
    known = {mesh.name for mesh in surfaces.meshes}
    names = tuple(names)
    if missing := [name for name in names if name not in known]:
        raise DisplayError(
            f"no surface is called {', '.join(missing)}.",
            fix=f"there are {', '.join(sorted(known)[:20])}",
            code="surface",
        )
    return names
