"""Stereo pairs from a picture and its range image by shift of planes. Pure functions.

For a symmetric tilt by ``angle`` a point at height z above the middle plane is seen with the parallax
p = 2 z sin(angle/2) / pixel; half of it is given to each eye, along x, so that the middle plane lies in the screen and
nothing is foreshortened. Points with p > 0 stand before the screen: the left eye sees them further right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError
from display.stereo import COMFORTABLE_SHARE, WIDEST_ANGLE_DEG, angle_warnings, parallax_warnings
from processing.compiled import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

EXTREMES_PERCENT = (1, 99)  # single wild pixels do not move the middle plane
TEAR_PX = 1.0  # neighbours that part by more belong to different surfaces


@dataclass(frozen=True)
class StereoPair:
    """Two views of one picture.

    Attributes
    ----------
    left, right : array like the picture
        What each eye sees.
    filled_left, filled_right : array (height, width) bool
        Pixels that the picture says nothing about: hidden behind something nearer, filled from the farther side.
    parallax_px : (float, float)
        Smallest and largest parallax; positive stands before the screen.
    warnings : tuple of str
        What makes the pair hard to look at.
    """

    left: Array
    right: Array
    filled_left: NDArray[np.bool_]
    filled_right: NDArray[np.bool_]
    parallax_px: tuple[float, float]
    warnings: tuple[str, ...]


def stereo_pair(
    image: Array, range_um: Array, *, pixel_um: float, angle_deg: float = 8.0, depth_scale: float = 1.0
) -> StereoPair:
    """Make the two views of a relief under a symmetric tilt.

    Parameters
    ----------
    image : array (height, width) or (height, width, 3), uint8 or uint16
        What the surface looks like.
    range_um : array (height, width)
        Height of the surface; larger is nearer to the eyes. For a range in planes give ``pixel_um`` in planes, too, or
        see `comfortable_pixel`.
    pixel_um : float
        Size of a pixel, same unit as the range.
    angle_deg : float
        Angle between the two views, 0 to 60.
    depth_scale : float
        Stretches depth; negative makes larger ranges farther.

    Raises
    ------
    DisplayError
        Shapes that do not fit, or numbers that make no sense.
    """
    parallax = tilt_parallax_px(range_um, pixel_um=pixel_um, angle_deg=angle_deg, depth_scale=depth_scale)
    return shifted_views(image, parallax, warnings=angle_warnings(angle_deg))


def tilt_parallax_px(
    range_um: Array, *, pixel_um: float, angle_deg: float, depth_scale: float = 1.0
) -> NDArray[np.float32]:
    """Return p = 2 z sin(angle/2) / pixel for every pixel, z from the plane midway between the extremes."""
    if not (np.isfinite(pixel_um) and pixel_um > 0 and np.isfinite(depth_scale) and 0 <= angle_deg <= WIDEST_ANGLE_DEG):
        raise DisplayError(
            f"no stereo pair with a pixel of {pixel_um:g} µm, {angle_deg:g}° and depth × {depth_scale:g}.",
            fix=f"give a positive pixel size and an angle from 0 to {WIDEST_ANGLE_DEG:g}°.",
        )
    if not np.isfinite(range_um).all():
        raise DisplayError("the range image has pixels that are not numbers.", fix="fill them before making views.")
    per_um = 2 * np.sin(np.radians(angle_deg) / 2) / pixel_um * depth_scale
    return np.asarray((range_um - middle_plane(range_um)) * per_um, np.float32)


def middle_plane(range_um: Array) -> float:
    """Return the height midway between the lowest and highest percent of the surface."""
    return float(np.mean(np.percentile(range_um, EXTREMES_PERCENT)))


def comfortable_pixel(range_: Array, *, angle_deg: float = 8.0) -> float:
    """Return the pixel size that gives the largest comfortable parallax, for ranges without a unit."""
    low, high = np.percentile(range_, EXTREMES_PERCENT)
    widest_px = COMFORTABLE_SHARE * range_.shape[1]
    return float(max(high - low, 1e-6) * np.sin(np.radians(angle_deg) / 2) / widest_px)


def shifted_views(image: Array, parallax_px: NDArray[np.float32], *, warnings: tuple[str, ...] = ()) -> StereoPair:
    """Shift every pixel by half its parallax, to the right for the left eye and to the left for the right eye.

    Near covers far. Pixels between neighbours of one surface are interpolated; where the surface is torn open, the
    farther side is continued, and the pixels are marked.

    Parameters
    ----------
    image : array (height, width) or (height, width, 3)
        uint8 or uint16.
    parallax_px : array (height, width) float32
        Positive for what stands before the screen.

    Raises
    ------
    DisplayError
        The sizes differ.
    """
    if image.shape[:2] != parallax_px.shape:
        raise DisplayError(
            f"the picture is {image.shape[:2]}, the range image {parallax_px.shape}.", fix="give a pair."
        )
    left, filled_left = _view(image, parallax_px, 0.5)
    right, filled_right = _view(image, parallax_px, -0.5)
    extremes = (float(parallax_px.min()), float(parallax_px.max()))
    widest_px = float(np.abs(np.percentile(parallax_px, EXTREMES_PERCENT)).max())
    told = warnings + parallax_warnings(widest_px, parallax_px.shape[1])
    return StereoPair(left, right, filled_left, filled_right, extremes, told)


def _view(image: Array, parallax_px: NDArray[np.float32], share: float) -> tuple[Array, NDArray[np.bool_]]:
    height, width = parallax_px.shape
    bands = np.ascontiguousarray(image).reshape(height, width, -1)
    seen = np.zeros_like(bands)
    filled = np.zeros((height, width), np.bool_)
    nearness = np.empty(width, np.float32)
    for row in range(height):
        nearness[:] = -np.inf
        paint_row(bands[row], parallax_px[row], share, seen[row], nearness)
        fill_row(seen[row], nearness, filled[row])
    return seen.reshape(image.shape), filled


@compiled
def paint_row(colours: Array, parallax: Array, share: float, seen: Array, nearness: Array) -> None:
    """Draw one row of the surface as line segments between neighbours; where it is torn, each keeps its half pixel."""
    last = parallax.size - 1
    for x in range(-1, last + 1):
        a, b = max(x, 0), min(x + 1, last)
        start, end = a + share * parallax[a], b + share * parallax[b]
        if a < b and 0 < end - start <= 1 + TEAR_PX:
            paint_segment(colours, parallax, a, b, start, end, seen, nearness)
        else:
            paint_segment(colours, parallax, a, a, start, start + 0.5 * (x >= 0), seen, nearness)
            paint_segment(colours, parallax, b, b, end - 0.5 * (x < last), end, seen, nearness)


@compiled
def paint_segment(
    colours: Array, parallax: Array, a: int, b: int, start: float, end: float, seen: Array, nearness: Array
) -> None:
    """Draw from pixel ``a`` at ``start`` to pixel ``b`` at ``end`` wherever nothing nearer is; the later wins a tie."""
    for t in range(max(int(np.ceil(start)), 0), min(int(np.floor(end)), parallax.size - 1) + 1):
        part = (t - start) / (end - start) if b > a else 0.0
        near = parallax[a] + part * (parallax[b] - parallax[a])
        if near >= nearness[t]:
            nearness[t] = near
            for band in range(colours.shape[1]):
                value = colours[a, band] + part * (float(colours[b, band]) - float(colours[a, band]))
                seen[t, band] = int(value + 0.5)


@compiled
def fill_row(seen: Array, nearness: Array, filled: Array) -> None:
    """Continue the farther neighbour into every gap of a row; at the border there is but one."""
    width, t = nearness.size, 0
    while t < width:
        if nearness[t] > -np.inf:
            t += 1
            continue
        end = t
        while end < width and nearness[end] == -np.inf:
            end += 1
        from_left = end == width or (t > 0 and nearness[t - 1] <= nearness[end])
        seen[t:end] = seen[t - 1] if from_left else seen[end]
        filled[t:end] = True
        t = end
