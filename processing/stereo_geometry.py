"""How a point in space comes to lie where it does in a view, and back: tilt, shift, perspective, any number of views.

X runs along the lines of the picture, Z up towards the viewer, both from the tilt axis, in µm. A view tilts the
specimen by ``tilt_deg`` about y, moves it by ``shift_um`` along x and sees it from ``distance_um`` above the axis.
With u = X cos t + Z sin t + shift and w = -X sin t + Z cos t the point is seen at x = u / (1 - w / distance). That is
linear in X and Z: X (cos t - x sin t / distance) + Z (sin t + x cos t / distance) = x - shift. Two views give both;
more give them by least squares. Parallel views tilted by ±t/2 leave Z = (x_left - x_right) / (2 sin(t/2)); a left one
untilted Z = (x_left cos t - x_right) / sin t; a stage shifted by S and seen from D: Z = D (p - S) / p.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

WIDEST_TILT_DEG = 90.0
SMALLEST_TILT_DEG = 0.01
SMALLEST_DETERMINANT = 1e-5
PLANE_ROUNDS = 10
TUKEY = 4.685 * 1.4826  # times the median deviation: 95 % efficiency for normal errors (Holland and Welsch 1977)


@dataclass(frozen=True)
class View:
    """How the specimen stands in one view.

    Attributes
    ----------
    tilt_deg : float
        Tilt about y; positive brings what is high to the right.
    shift_um : float
        Where the stage moved it along x.
    distance_um : float
        From the axis to the eye point of the perspective; infinite for parallel rays.
    """

    tilt_deg: float = 0.0
    shift_um: float = 0.0
    distance_um: float = math.inf

    def project(self, x_um: Array, z_um: Array) -> Array:
        """Return where points are seen along x, in µm of the specimen at the height of the axis."""
        sine, cosine = self._turn()
        across, towards = x_um * cosine + z_um * sine + self.shift_um, z_um * cosine - x_um * sine
        return np.asarray(across / (1 - towards / self.distance_um))

    def equation(self, seen_um: Array) -> tuple[Array, Array, Array]:
        """Return a, b and c of aX + bZ = c for points seen at ``seen_um``."""
        sine, cosine = self._turn()
        bent = np.asarray(seen_um) / self.distance_um
        return cosine - bent * sine, sine + bent * cosine, np.asarray(seen_um) - self.shift_um

    def _turn(self) -> tuple[float, float]:
        return math.sin(math.radians(self.tilt_deg)), math.cos(math.radians(self.tilt_deg))


@dataclass(frozen=True)
class Located:
    """Points found from their places in several views; arrays of the shape of these.

    Attributes
    ----------
    x_um, z_um : array
        Position from the tilt axis.
    each_z_per_um : array (views, …)
        Standard error of ``z_um`` for an error of 1 µm in the place in one view, the others being exact.
    misfit_um : array
        Root mean square of what the views disagree by; 0 with two views.
    """

    x_um: Array
    z_um: Array
    each_z_per_um: Array
    misfit_um: Array

    @property
    def z_per_um(self) -> Array:
        """That of the last view."""
        return np.asarray(self.each_z_per_um[-1])


def tilted_pair(tilt_deg: float, *, left_deg: float | None = None, distance_um: float = math.inf) -> tuple[View, View]:
    """Return left and right view of a pair whose views differ by ``tilt_deg``.

    Parameters
    ----------
    tilt_deg : float
        Whole angle between the views. Below zero, which says that the left view is the less tilted one, only beside
        ``left_deg``: else a sign would turn hills into pits unasked.
    left_deg : float, optional
        Tilt of the left view; half of the angle when left out, 0 for a left view taken flat.
    distance_um : float
        Projection distance; infinite for parallel rays.

    Raises
    ------
    InputError
        ``stereo-tilt``: the angle is zero, below it without ``left_deg``, not a number or beyond 90°.
        ``stereo-distance``: no positive distance.
    """
    if not SMALLEST_TILT_DEG <= abs(tilt_deg) <= WIDEST_TILT_DEG:
        raise InputError(
            f"a tilt of {tilt_deg:g}° between the views gives no elevation.",
            why="Both views would show the same, or nothing in common.",
            fix=f"give the whole angle between the views, {SMALLEST_TILT_DEG:g} to {WIDEST_TILT_DEG:g}: --tilt-deg 8",
            code="stereo-tilt",
        )
    if left_deg is None and tilt_deg < 0:
        raise InputError(
            f"an angle of {tilt_deg:g}° between the views.",
            why="Less than nothing would mean that left and right are exchanged, and turn hills into pits.",
            fix=(
                f"give the views the other way round and --tilt-deg {-tilt_deg:g}",
                f"say how the left view was tilted: --tilt-deg {tilt_deg:g} --left-deg 0",
            ),
            code="stereo-tilt",
        )
    left = tilt_deg / 2 if left_deg is None else left_deg
    if not abs(left) <= WIDEST_TILT_DEG:
        raise InputError(f"a left view tilted by {left:g}° cannot be.", fix="--left-deg 4", code="stereo-tilt")
    return View(left, 0.0, _distance(distance_um)), View(left - tilt_deg, 0.0, _distance(distance_um))


def further_view(tilt_deg: float, distance_um: float = math.inf) -> View:
    """Return one more view of a tilt series.

    Raises
    ------
    InputError
        ``stereo-tilt``: no number, or beyond 90°.
    """
    if not abs(tilt_deg) <= WIDEST_TILT_DEG:
        raise InputError(f"a view tilted by {tilt_deg:g}° cannot be.", fix="--more FILE 6", code="stereo-tilt")
    return View(tilt_deg, 0.0, _distance(distance_um))


def shifted_pair(shift_um: float, distance_um: float) -> tuple[View, View]:
    """Return left and right view of a stage moved by ``shift_um`` under a perspective from ``distance_um``.

    Raises
    ------
    InputError
        ``stereo-shift``: the shift is zero or not a number. ``stereo-distance``: no positive, finite distance.
    """
    if not (math.isfinite(shift_um) and shift_um != 0):
        raise InputError(f"a shift of {shift_um:g} µm gives no elevation.", fix="--shift-um 500", code="stereo-shift")
    distance = _distance(distance_um)
    if math.isinf(distance):
        raise InputError(
            "a shifted stage gives elevation only by perspective, and no distance is known.",
            fix="give the working distance: --distance-um 10000",
            code="stereo-distance",
        )
    return View(0.0, shift_um / 2, distance), View(0.0, -shift_um / 2, distance)


def _distance(distance_um: float) -> float:
    if distance_um > 0:
        return distance_um
    raise InputError(
        f"a projection distance of {distance_um:g} µm cannot be.",
        fix="give a positive distance in µm, or none for parallel rays: --distance-um 10000",
        code="stereo-distance",
    )


def locate(views: Sequence[View], seen_um: Sequence[Array]) -> Located:
    """Find points from where two or more views show them.

    Parameters
    ----------
    views : sequence of View
        At least two that differ.
    seen_um : sequence of arrays
        x of the points in each view, µm from the axis; NaN where a view does not show it. What fewer than two views
        show is NaN.

    Raises
    ------
    InputError
        ``stereo-geometry``: the views cannot tell X from Z.
    """
    if len(views) < 2 or len(views) != len(seen_um):
        raise InputError(
            f"{len(views)} views and {len(seen_um)} sets of places give no elevation.",
            fix="give two or more views and the places of the points in each.",
            code="stereo-geometry",
        )
    rows = [_known_only(view.equation(np.asarray(seen, np.float64))) for view, seen in zip(views, seen_um, strict=True)]
    count = np.asarray(sum(np.isfinite(np.asarray(seen, np.float64)).astype(int) for seen in seen_um))
    aa, ab, bb, ac, bc = (_summed(rows, i, j) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
    determinant = np.where(count >= 2, aa * bb - ab * ab, np.nan)
    if not np.nanmax(np.abs(determinant), initial=0.0) > SMALLEST_DETERMINANT**2:
        raise InputError(
            "the views differ too little: height and place cannot be told apart.",
            fix="give views that differ in tilt, or by a shift under perspective.",
            code="stereo-geometry",
        )
    x_um, z_um = (bb * ac - ab * bc) / determinant, (aa * bc - ab * ac) / determinant
    misfit = np.sqrt(sum((a * x_um + b * z_um - c) ** 2 for a, b, c in rows) / np.maximum(count, 1))
    sums = aa, ab, determinant
    each = np.stack([_sensitivity(view, row, sums, x_um, z_um) for view, row in zip(views, rows, strict=True)])
    return Located(x_um, z_um, each, misfit)


def _known_only(row: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Take the say from points a view does not show."""
    known = np.isfinite(row[2])
    a, b, c = (np.where(known, part, 0.0) for part in row)
    return a, b, c


def _summed(rows: Sequence[tuple[Array, Array, Array]], i: int, j: int) -> Array:
    return np.asarray(sum(row[i] * row[j] for row in rows))


def _sensitivity(
    view: View, row: tuple[Array, Array, Array], sums: tuple[Array, Array, Array], x_um: Array, z_um: Array
) -> Array:
    """Return |dZ/dx| of the view's equation; x stands in its coefficients, too, which perspective makes felt."""
    a, b, _ = row
    aa, ab, determinant = sums
    sine, cosine = math.sin(math.radians(view.tilt_deg)), math.cos(math.radians(view.tilt_deg))
    right_side = 1 - (z_um * cosine - x_um * sine) / view.distance_um
    return np.asarray(np.abs((aa * b - ab * a) / determinant * right_side))


@dataclass(frozen=True)
class Plane:
    """The plane z = height + slope_x x + slope_y y that fits an elevation best.

    Attributes
    ----------
    height_um : float
        At x = y = 0.
    slope_x, slope_y : float
        µm per µm.
    rms_um : float
        What is left when the plane is taken away, over the points that had a say.
    """

    height_um: float
    slope_x: float
    slope_y: float
    rms_um: float

    @property
    def tilt_deg(self) -> float:
        """Angle between the plane and the horizontal."""
        return math.degrees(math.atan(math.hypot(self.slope_x, self.slope_y)))

    def at(self, x_um: Array, y_um: Array) -> Array:
        """Return its height at places."""
        return np.asarray(self.height_um + self.slope_x * x_um + self.slope_y * y_um)


def fitted_plane(x_um: Array, y_um: Array, z_um: Array) -> Plane:
    """Fit a plane; points far off it have no say (Tukey's weights).

    Parameters
    ----------
    x_um, y_um, z_um : arrays of one shape
        Points; those with a NaN are left out.

    Raises
    ------
    InputError
        ``stereo-points``: fewer than three points, or all on a line.
    """
    known = np.isfinite(z_um)
    x, y, z = (np.asarray(a, np.float64)[known] for a in (x_um, y_um, z_um))
    terms = np.column_stack([np.ones_like(x), x, y])
    if np.linalg.matrix_rank(terms) < 3:
        raise InputError(
            f"{x.size} points do not span a plane.", fix="give three or more that lie on no line.", code="stereo-points"
        )
    weight = np.ones_like(z)
    for _ in range(PLANE_ROUNDS):
        found = np.linalg.lstsq(terms * weight[:, None], z * weight, rcond=None)[0]
        off = z - terms @ found
        scale = TUKEY * float(np.median(np.abs(off)))
        if scale <= 1e-12 * (np.abs(z).max() + 1e-300):
            break
        weight = np.maximum(1 - (off / scale) ** 2, 0)
    rms = float(np.sqrt(np.sum((weight * off) ** 2) / np.sum(weight**2)))
    return Plane(float(found[0]), float(found[1]), float(found[2]), rms)
