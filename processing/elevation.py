"""Elevation from a stereo pair: matching, geometry and errors put together."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from devices.errors import InputError
from processing.stereo_geometry import fitted_plane, locate
from processing.stereo_match import match_area
from processing.stereo_points import (
    facet_raster,
    facets_between,
    match_markers,
    match_points,
    misfit_to_neighbours,
    shortest_network,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from processing.stereo_geometry import Located, Plane, View
    from processing.stereo_interest import Interest
    from processing.stereo_points import Matches

    Array = NDArray[Any]

Method = Literal["area", "points", "markers"]

PIXEL_UM = (1e-6, 1e5)
GRID_STEP_PX = 16  # of the points table of an area match
CLIPPED_SHARE = 0.05
INTERPOLATED = 1.0  # error of a facet over how far its corners lie off the planes of their neighbours
NO_FACETS = np.empty((0, 3), int)


@dataclass(frozen=True)
class Geometry:
    """How a pair was taken.

    Attributes
    ----------
    views : tuple of View
        Of the left and the right picture, and of further ones.
    pixel_um : float
        Size of a pixel in the specimen.
    axis_px : float, optional
        Column of the tilt axis, where the specimen does not move; the middle of the picture when left out.
    """

    views: tuple[View, ...]
    pixel_um: float
    axis_px: float | None = None

    def __post_init__(self) -> None:
        if not PIXEL_UM[0] <= self.pixel_um <= PIXEL_UM[1]:
            raise InputError(
                f"a pixel of {self.pixel_um:g} µm cannot be.",
                fix="give the size of a pixel in the specimen, in µm: --pixel-um 0.2",
                code="stereo-pixel",
            )

    def from_axis_um(self, x_px: Array, width: int) -> Array:
        """Return places along x in µm from the tilt axis."""
        axis = (width - 1) / 2 if self.axis_px is None else self.axis_px
        return np.asarray((x_px - axis) * self.pixel_um)

    def band_px(self, relief_um: float, width: int, other: int = 1) -> tuple[int, int]:
        """Return the parallax that heights within ± ``relief_um`` can have anywhere, from the left to another view.

        Raises
        ------
        InputError
            ``stereo-relief``: the relief is no positive number.
        """
        if not 0 < relief_um < math.inf:
            raise InputError(f"a relief of {relief_um:g} µm cannot be.", fix="--relief-um 50", code="stereo-relief")
        x = self.from_axis_um(np.array([0.0, width - 1.0, 0.0, width - 1.0]), width)
        z = np.array([relief_um, relief_um, -relief_um, -relief_um])
        parallax = (self.views[0].project(x, z) - self.views[other].project(x, z)) / self.pixel_um
        return math.floor(parallax.min()) - 1, math.ceil(parallax.max()) + 1


@dataclass(frozen=True)
class Points:
    """Points of the specimen seen in both views; arrays (points,) unless said.

    Attributes
    ----------
    left, right : array (points, 2)
        x, y in the views, in pixels.
    xyz_um : array (points, 3)
        Position: x from the tilt axis, y down from the first row, z up.
    sigma_um : array
        Standard error of z; NaN where it is not known.
    ambiguous : array of bool
        Another partner would have done nearly as well.
    facets : array (facets, 3)
        Triangles between points; none for an area match or markers.
    network : array (links, 2)
        The shortest network of markers; none otherwise.
    """

    left: Array
    right: Array
    xyz_um: Array
    sigma_um: Array
    ambiguous: Array
    facets: Array
    network: Array


@dataclass(frozen=True)
class Elevation:
    """What a pair says about height; maps (height, width) on the pixels of the left view, NaN where nothing is known.

    Attributes
    ----------
    elevation_um : array float32
        Height, up positive, from the level of the tilt axis, or from ``plane`` when ``levelled``.
    sigma_um : array float32
        Its standard error from the matching, and on facets from how far their corners lie off the planes of their
        neighbours; errors of tilt and pixel size come on top.
    parallax_px : array float32
        x_left - x_right.
    points : Points
        The points behind it; nodes of a grid for an area match.
    plane : Plane
        The mean plane of what was found.
    levelled : bool
        True when the plane was taken away.
    band_px : (int, int), optional
        Lowest and highest parallax that were tried.
    notes : tuple of str
        What to bear in mind, in words.
    """

    elevation_um: NDArray[np.float32]
    sigma_um: NDArray[np.float32]
    parallax_px: NDArray[np.float32]
    points: Points
    plane: Plane
    levelled: bool
    band_px: tuple[int, int] | None
    notes: tuple[str, ...]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the height is known."""
        return np.isfinite(self.elevation_um)


def elevation(
    left: Array,
    right: Array,
    geometry: Geometry,
    *,
    method: Method = "area",
    band_px: tuple[int, int] | None = None,
    relief_um: float | None = None,
    more: Sequence[Array] = (),
    interest: Interest = "zuniga-haralick",
    matches: Matches | None = None,
    progress: Callable[[float], None] | None = None,
) -> Elevation:
    """Measure the height of a surface, or of markers, from two views.

    Parameters
    ----------
    left, right : array (height, width) or (height, width, 3), uint8, uint16 or float
        The views; the tilt axis runs along y.
    geometry : Geometry
        How they were taken.
    method : {"area", "points", "markers"}
        Every pixel by its surroundings; interesting points in order and facets between them; dark markers in a
        transparent volume.
    band_px : (int, int), optional
        Lowest and highest parallax; found from the pictures when left out, but for markers ± an eighth of the width.
    relief_um : float, optional
        Largest height above and below the axis, from which the bands follow, in place of ``band_px``.
    more : sequence of arrays
        Further views, for the area method: ``geometry`` has theirs, too.
    interest : str
        Operator that finds the points.
    matches : Matches, optional
        Points matched already, for example by hand, in place of finding them.
    progress : callable, optional
        Is told the share of the work done.

    Raises
    ------
    InputError
        Views that cannot be matched, or numbers that make no sense.
    """
    if more and (method != "area" or matches is not None):
        raise InputError(
            "further views are of use to the area method only.",
            fix="leave --method and --matches out.",
            code="stereo-more",
        )
    bands: list[tuple[int, int] | None] = [band_px, *[None] * len(more)]
    if band_px is None and relief_um is not None:
        bands = [geometry.band_px(relief_um, left.shape[1], k) for k in range(1, len(geometry.views))]
    if method == "area" and matches is None:
        found = from_area((left, right, *more), geometry, bands, progress)
    else:
        found = from_matches(
            _matched(left, right, method, bands[0], interest) if matches is None else matches,
            left.shape[:2],
            geometry,
            joined=method != "markers",
        )
    return replace(found, notes=(*clipping(left, "left"), *clipping(right, "right"), *found.notes))


def _matched(left: Array, right: Array, method: Method, band_px: tuple[int, int] | None, interest: Interest) -> Matches:
    if method == "points":
        return match_points(left, right, band_px=band_px, interest=interest)
    eighth = left.shape[1] // 8
    return match_markers(left, right, band_px=band_px or (-eighth, eighth))


def from_area(
    pictures: Sequence[Array],
    geometry: Geometry,
    bands_px: Sequence[tuple[int, int] | None],
    progress: Callable[[float], None] | None = None,
) -> Elevation:
    """Return the elevation of every pixel of the first picture that finds a partner in another, or in several."""
    others = len(pictures) - 1
    matched = []
    for k, (picture, band) in enumerate(zip(pictures[1:], bands_px, strict=True)):
        tell = None if progress is None else partial(_part_done, progress, k, others)
        matched.append(match_area(pictures[0], picture, band_px=band, progress=tell))
    found = matched[0]
    height, width = found.parallax_px.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    located = _located([x, *(x - m.parallax_px for m in matched)], width, geometry)
    x_um, z_um = located.x_um, located.z_um
    sigma = _error(located, [m.sigma_px for m in matched], geometry)
    grid = (slice(GRID_STEP_PX // 2, None, GRID_STEP_PX),) * 2
    known = found.valid[grid]
    place = np.stack([x[grid][known], y[grid][known]], axis=1)
    partner = place - np.stack([found.parallax_px[grid][known], np.zeros(len(place))], axis=1)
    xyz = np.stack([x_um[grid][known], place[:, 1] * geometry.pixel_um, z_um[grid][known]], axis=1)
    certain = np.zeros(len(place), bool)
    points = Points(place, partner, xyz, sigma[grid][known], certain, NO_FACETS, NO_FACETS[:, :2])
    plane = fitted_plane(x_um, y * geometry.pixel_um, z_um)
    maps = (z_um.astype(np.float32), sigma.astype(np.float32), found.parallax_px)
    notes = _disagreement(located, others)
    return Elevation(*maps, points, plane, levelled=False, band_px=found.band_px, notes=notes)


def _part_done(progress: Callable[[float], None], part: int, parts: int, share: float) -> None:
    progress((part + share) / parts)


def _error(located: Located, sigmas_px: Sequence[Array], geometry: Geometry) -> Array:
    """Return the error of z from those of the places in all views but the first, where the points are asked for."""
    parts = [
        np.where(np.isfinite(sigma), each * sigma * geometry.pixel_um, 0.0)
        for each, sigma in zip(located.each_z_per_um[1:], sigmas_px, strict=True)
    ]
    return np.where(np.isfinite(located.z_um), np.sqrt(sum(part**2 for part in parts)), np.nan)


def _disagreement(located: Located, others: int) -> tuple[str, ...]:
    if others < 2:
        return ()
    misfit = float(np.nanmedian(located.misfit_um))
    return (f"{others + 1} views disagree by {misfit:.3g} µm in place (median, root mean square).",)


def _located(places_px: Sequence[Array], width: int, geometry: Geometry) -> Located:
    """Return places in µm from where the views show them."""
    return locate(geometry.views[: len(places_px)], [geometry.from_axis_um(x, width) for x in places_px])


def from_matches(matches: Matches, shape: tuple[int, int], geometry: Geometry, *, joined: bool) -> Elevation:
    """Return the elevation on the facets between points, or of single markers and the network that joins them."""
    located = _located([matches.left[:, 0], matches.right[:, 0]], shape[1], geometry)
    x_um, z_um = located.x_um, located.z_um
    xyz = np.stack([x_um, matches.left[:, 1] * geometry.pixel_um, z_um], axis=1)
    sigma = located.z_per_um * geometry.pixel_um * matches.sigma_px
    facets = facets_between(matches.left) if joined else NO_FACETS
    network = NO_FACETS[:, :2] if joined else shortest_network(xyz)
    points = Points(matches.left, matches.right, xyz, sigma, matches.ambiguous, facets, network)

    def spread(values: Array) -> Array:
        return facet_raster(matches.left, facets, values, shape) if joined else dots(matches.left, values, shape)

    between = INTERPOLATED * misfit_to_neighbours(matches.left, facets, z_um) if joined else np.zeros(len(z_um))
    error = np.sqrt(spread(sigma) ** 2 + spread(between) ** 2)
    maps = (spread(z_um), error, spread(matches.parallax_px))
    doubtful = int(matches.ambiguous.sum())
    notes = (f"{doubtful} of {len(matches)} matches have a rival: look at them in points.csv.",) if doubtful else ()
    plane = fitted_plane(x_um, xyz[:, 1], z_um)
    return Elevation(*maps, points, plane, levelled=False, band_px=None, notes=notes)


def dots(points: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Put values on the pixels nearest to points; (height, width) float32, NaN elsewhere."""
    out = np.full(shape, np.nan, np.float32)
    x, y = np.rint(points).astype(int).T
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    out[y[inside], x[inside]] = values[inside]
    return out


def levelled(found: Elevation, geometry: Geometry) -> Elevation:
    """Return the elevation from its own mean plane instead of from the level of the tilt axis."""
    height, width = found.elevation_um.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    left = geometry.views[0]
    a, b, c = left.equation(geometry.from_axis_um(x, width))
    x_um = (c - b * found.elevation_um) / a  # on the left view's ray, at this height
    flat = (found.elevation_um - found.plane.at(x_um, y * geometry.pixel_um)).astype(np.float32)
    xyz = found.points.xyz_um.copy()
    xyz[:, 2] -= found.plane.at(xyz[:, 0], xyz[:, 1])
    return replace(found, elevation_um=flat, points=replace(found.points, xyz_um=xyz), levelled=True)


def clipping(view: Array, name: str) -> tuple[str, ...]:
    """Say how much of a view is at its darkest or brightest value, where it is more than 5 %."""
    for word, value in (("brightest", view.max()), ("darkest", view.min())):
        share = float(np.mean(view == value))
        if share > CLIPPED_SHARE:
            return (f"{share:.0%} of the {name} view is at its {word} value: nothing can be matched there.",)
    return ()
