"""From a scene to what a renderer needs for one eye: rays, or a matrix for meshes. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from devices.glasses_timing import Eye
    from display.scene import Layer, Light, Scene, View

    Array = NDArray[np.float64]
    Size = tuple[int, int]

MARGIN = 1.04  # a little air around the whole
WIDEST_PERSPECTIVE_DEG = 120.0
SIDE = {"left": -1.0, None: 0.0, "right": 1.0}


@dataclass(frozen=True, eq=False)
class Camera:
    """The rays of a picture, all in µm, axes (x, y, z).

    Pixel (row j, column i) looks from ``corner + i·right + j·down``, a point of the screen plane, along ``along``; in
    perspective along what leads from ``eye`` to that point.

    Attributes
    ----------
    corner, right, down : array (3,)
        Centre of pixel (0, 0) and the ways to its neighbours; both as long as a pixel is wide.
    along : array (3,)
        Direction of parallel rays; its part along ``axis`` is 1.
    axis : array (3,)
        Unit vector into the screen.
    eye : array (3,), optional
        Where the rays meet; None in a parallel view.
    size : (int, int)
        Width and height in pixels.
    radius : float
        Everything lies within this distance of the middle of the data.
    """

    corner: Array
    right: Array
    down: Array
    along: Array
    axis: Array
    eye: Array | None
    size: Size
    radius: float

    @property
    def pixel_um(self) -> float:
        """Size of a pixel in the screen plane."""
        return float(np.linalg.norm(self.right))

    @property
    def centre(self) -> Array:
        """Point of the screen plane in the middle of the picture."""
        width, height = self.size
        return self.corner + self.right * (width - 1) / 2 + self.down * (height - 1) / 2

    def project(self, points: Array) -> Array:
        """Return the pixel (x, y) and the depth behind the screen plane, in µm, of points (n, 3)."""
        offset = np.asarray(points, np.float64) - self.corner
        depth = offset @ self.axis
        along = np.broadcast_to(self.along, offset.shape)
        if self.eye is not None:
            before = (self.centre - self.eye) @ self.axis
            along = (points - self.eye) / (depth + before)[:, None]
        flat = offset - depth[:, None] * along
        return np.column_stack([flat @ self.right, flat @ self.down, depth * self.pixel_um**2]) / self.pixel_um**2

    def matrix(self) -> Array:
        """Return the 4 × 4 matrix that takes a column (x, y, z, 1) to clip space; row 0 of a picture is at y = -1.

        Depth is 0 at the middle of the data, -1 and 1 at ``radius`` before and behind it.
        """
        width, height = self.size
        u, v = self.right / self.pixel_um, self.down / self.pixel_um
        half = np.array([width, height]) * self.pixel_um / 2
        rows = np.zeros((4, 4))
        if self.eye is None:
            slant = self.along
            for row, unit, reach in ((0, u, half[0]), (1, v, half[1])):
                flat = unit - (slant @ unit) * self.axis  # takes the shear out again
                rows[row, :3], rows[row, 3] = flat / reach, -(flat @ self.centre) / reach
            rows[2, :3] = self.axis / self.radius
            rows[3, 3] = 1
            return rows
        before = (self.centre - self.eye) @ self.axis
        for row, unit, reach in ((0, u, half[0]), (1, v, half[1])):
            flat = (unit * before + self.axis * ((self.eye - self.centre) @ unit)) / reach
            rows[row, :3], rows[row, 3] = flat, -(flat @ self.eye)
        near = max(before - self.radius, before * 0.01)
        far = before + self.radius
        rows[2, :3] = self.axis * (far + near) / (far - near)
        rows[2, 3] = -(rows[2, :3] @ self.eye) - 2 * far * near / (far - near)
        rows[3, :3], rows[3, 3] = self.axis, -(self.axis @ self.eye)
        return rows


@dataclass(frozen=True, eq=False)
class Drawing:
    """One layer for one eye; the rest of the scene is at hand for lights and shadows."""

    layer: Layer
    camera: Camera
    scene: Scene
    eye: Eye | None = None

    @property
    def data(self) -> Any:
        """What is drawn."""
        return self.layer.data

    @property
    def look(self) -> Any:
        """The options of its mode."""
        return self.layer.look


def resolve(scene: Scene, size: Size, eye: Eye | None = None) -> tuple[Drawing, ...]:
    """Return what to draw for one eye, back layer first.

    Raises
    ------
    DisplayError
        ``picture-size``: a size of nothing. ``view``: angles or zoom that make no picture.
    """
    seen = camera(scene, size, eye)
    return tuple(Drawing(layer, seen, scene, eye) for layer in scene.layers)


def camera(scene: Scene, size: Size, eye: Eye | None = None) -> Camera:
    """Return the rays of one eye, None being between the two; the screen plane goes through the view's centre.

    A shifted eye is the shear of `display.stereo.eye_matrix`. Errors as `resolve`.
    """
    view, stereo = _checked(scene.view, size), scene.stereo
    aside = math.tan(math.radians(stereo.vergence_deg) / 2) * stereo.depth * SIDE[eye]
    turned = stereo.views == "rotate"
    right, down, axis = axes(view, turn=math.atan(aside) if turned else 0.0)
    pixel_um = view.pixel_um or fitting_pixel_um(scene, size)
    centre = np.array(view.centre_um, np.float64)
    corner = centre - pixel_um * (right * (size[0] - 1) / 2 + down * (size[1] - 1) / 2)
    along, place = axis - (0.0 if turned else aside) * right, None
    if view.perspective_deg:
        before = pixel_um * min(size) / 2 / math.tan(math.radians(view.perspective_deg) / 2)
        place, along = centre - before * along, axis
    radius = float(np.linalg.norm(scene.size_um) / 2 + np.linalg.norm(centre))
    return Camera(corner, pixel_um * right, pixel_um * down, along, axis, place, size, radius)


def axes(view: View, *, turn: float = 0.0) -> tuple[Array, Array, Array]:
    """Return unit vectors to the right, down and into the picture, (x, y, z); ``turn`` moves an eye right, radians."""
    a, e, r = (math.radians(d) for d in (view.azimuth_deg, view.elevation_deg, view.roll_deg))
    side = np.array([math.cos(a), 0.0, math.sin(a)])
    into = np.array([-math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
    below = np.cross(into, side)
    right = math.cos(r) * side - math.sin(r) * below
    down = math.sin(r) * side + math.cos(r) * below
    return right * math.cos(turn) + into * math.sin(turn), down, into * math.cos(turn) - right * math.sin(turn)


def light_vector(seen: Camera, light: Light) -> Array:
    """Return the unit vector to a light, (x, y, z); it stays with the viewer who moves around the data."""
    a, e = math.radians(light.azimuth_deg), math.radians(light.elevation_deg)
    right, down = seen.right / seen.pixel_um, seen.down / seen.pixel_um
    return math.sin(a) * math.cos(e) * right - math.sin(e) * down - math.cos(a) * math.cos(e) * seen.axis


def fitting_pixel_um(scene: Scene, size: Size) -> float:
    """Return the size of a pixel with which everything fits into the picture, divided by the zoom."""
    right, down, axis = axes(scene.view)
    half = scene.size_um / 2
    reach = [float(np.abs(unit) @ half) for unit in (right, down)]
    if scene.view.perspective_deg:  # what is nearer is larger
        nearest = float(np.abs(axis) @ half)
        opening = math.tan(math.radians(scene.view.perspective_deg) / 2)
        reach = [way + nearest * opening for way in reach]
    return MARGIN * 2 * max(way / side for way, side in zip(reach, size, strict=True)) / scene.view.zoom


def _checked(view: View, size: Size) -> View:
    if min(size) < 1:
        raise DisplayError(f"a picture of {size[0]}×{size[1]} px is none.", fix="make it larger.", code="picture-size")
    numbers = (view.azimuth_deg, view.elevation_deg, view.roll_deg, view.zoom, view.perspective_deg, *view.centre_um)
    sane = all(map(math.isfinite, numbers)) and view.zoom > 0 and (view.pixel_um is None or view.pixel_um > 0)
    if not (sane and 0 <= view.perspective_deg <= WIDEST_PERSPECTIVE_DEG):
        raise DisplayError(
            f"nothing can be seen with {view}.",
            fix=f"finite angles, a positive zoom, a perspective from 0 to {WIDEST_PERSPECTIVE_DEG:g}°.",
            code="view",
        )
    return view
