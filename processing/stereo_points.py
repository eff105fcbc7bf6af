"""Point matching of a stereo pair: interesting points in order, markers in any order, and the facets between them."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from devices.errors import InputError
from processing import stereo_kernels as kernels
from processing.compiled import compiled
from processing.stereo_interest import dark_markers, interesting_points
from processing.stereo_match import (
    REACH_PX,
    TEAR_PX,
    checked_band,
    evened,
    found_band,
    prepared_pair,
)

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.stereo_interest import Interest

    Array = NDArray[Any]

ROW_TOLERANCE_PX = 2.0
CANDIDATES = 4  # the short list of each point
LEAST_ALIKE = 0.6  # similarity below which a point is rather left alone
WIDEST_SIGMA_PX = 0.2  # a corner of facets speaks for many pixels and must be surer than one of them
NEIGHBOUR_PX = 3.0  # a parallax this far from the median of its facets' other corners is a mistake
FEWEST_POINTS = 3
MARKER_ROW_PX = 1.0  # rows by which a marker's two places differ, typically
MARKER_LOG_SIZE = 0.3  # and the logarithm of its darkness
UNMATCHED_COST = 9.0  # squared standard deviations at which two markers are no pair
AMBIGUOUS = 2.0
MARKER_SIGMA_PX = 0.2
COLUMNS = ("x_left", "y_left", "x_right", "y_right")


@dataclass(frozen=True)
class Matches:
    """Points seen in both views.

    Attributes
    ----------
    left, right : array (points, 2) float64
        x, y in each view, in pixels.
    sigma_px : array (points,) float64
        Standard error of the parallax; NaN where it is not known.
    ambiguous : array (points,) bool
        Another partner would have done nearly as well: a place to look at by hand.
    """

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    ambiguous: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.left)

    @property
    def parallax_px(self) -> Array:
        """x_left - x_right of every point."""
        return np.asarray(self.left[:, 0] - self.right[:, 0])

    def chosen(self, keep: Array) -> Matches:
        """Return some of the matches."""
        return Matches(self.left[keep], self.right[keep], self.sigma_px[keep], self.ambiguous[keep])


def match_points(
    left: Array, right: Array, *, band_px: tuple[int, int] | None = None, interest: Interest = "zuniga-haralick"
) -> Matches:
    """Match interesting points row by row, keeping their order from left to right.

    The order holds on every surface that hides no part of itself. Dynamic programming finds the pairing of highest
    summed similarity under that rule; a point is left alone rather than paired with one unlike it.

    Parameters
    ----------
    left, right, band_px
        As in `stereo_match.match_area`.
    interest : str
        Name of the operator that finds points.

    Raises
    ------
    InputError
        As `match_area`; ``stereo-points``: fewer than three points match.
    """
    left, right = prepared_pair(left, right)
    band = found_band(left, right) if band_px is None else checked_band(band_px, left.shape[1])
    views = evened(left), evened(right)
    found = [interesting_points(view, interest) for view in (left, right)]
    pairs = [pair for row in rows_of(found[0]) for pair in ordered_pairs(*views, row, found[1], band)]
    matches = refined(*views, pairs)
    return enough(matches.chosen(like_neighbours(matches)))


def rows_of(points: Array) -> list[Array]:
    """Cut points into rows of the height within which partners are looked for, each from left to right."""
    row = (points[:, 1] // ROW_TOLERANCE_PX).astype(int)
    rows = [points[row == k] for k in np.unique(row)]
    return [one[np.argsort(one[:, 0])] for one in rows]


def ordered_pairs(
    left: Array, right: Array, row: Array, others: Array, band: tuple[int, int]
) -> list[tuple[Array, Array]]:
    """Pair the points of one row of the left view with points of the right view near that row."""
    near = others[np.abs(others[:, 1] - row[:, 1].mean()) <= ROW_TOLERANCE_PX]
    near = near[np.argsort(near[:, 0])]
    gain = np.full((len(row), len(near)), -np.inf)
    parallax = row[:, :1] - near[:, 0]
    for a, b in zip(*np.nonzero((parallax >= band[0]) & (parallax <= band[1])), strict=True):
        gain[a, b] = similarity(left, right, row[a], near[b]) - LEAST_ALIKE
    return [(row[a], near[b]) for a, b in best_in_order(short_listed(gain))]


def short_listed(gain: Array) -> Array:
    """Keep the best four candidates of every point and forbid the rest."""
    if gain.shape[1] <= CANDIDATES:
        return gain
    least = np.partition(gain, -CANDIDATES, axis=1)[:, -CANDIDATES][:, np.newaxis]
    return np.where(gain >= least, gain, -np.inf)


def best_in_order(gain: Array) -> list[tuple[int, int]]:
    """Return the pairs (a, b), rising in both, of the highest summed gain; pairs of no gain are not made."""
    best = np.zeros((gain.shape[0] + 1, gain.shape[1] + 1))
    for a in range(gain.shape[0]):
        for b in range(gain.shape[1]):
            best[a + 1, b + 1] = max(best[a, b + 1], best[a + 1, b], best[a, b] + max(gain[a, b], 0.0))
    pairs = []
    a, b = gain.shape
    while a and b:
        if best[a, b] == best[a - 1, b]:
            a -= 1
        elif best[a, b] == best[a, b - 1]:
            b -= 1
        else:
            a, b = a - 1, b - 1
            pairs.append((a, b))
    return pairs[::-1]


def similarity(left: Array, right: Array, a: Array, b: Array) -> float:
    """Return the correlation coefficient of the 11×11 windows around two points; -1 at the border."""
    windows = [_window(view, point) for view, point in ((left, a), (right, b))]
    if windows[0].shape != windows[1].shape or not windows[0].size:
        return -1.0
    first, second = (w - w.mean() for w in windows)
    spread = math.sqrt(float((first * first).sum()) * float((second * second).sum()))
    return float((first * second).sum()) / spread if spread > 0 else -1.0


def _window(view: Array, point: Array) -> Array:
    x, y = round(float(point[0])), round(float(point[1]))
    inside = REACH_PX <= x < view.shape[1] - REACH_PX and REACH_PX <= y < view.shape[0] - REACH_PX
    return view[y - REACH_PX : y + REACH_PX + 1, x - REACH_PX : x + REACH_PX + 1] if inside else view[:0]


def refined(left: Array, right: Array, pairs: list[tuple[Array, Array]]) -> Matches:
    """Place the partner of every left point between pixels; pairs whose windows do not fit are dropped."""
    rows = []
    for a, b in pairs:
        parallax, sigma, alike = _refined_parallax(left, right, a, a[0] - b[0])
        if alike >= LEAST_ALIKE and sigma <= WIDEST_SIGMA_PX:
            rows.append((a[0], a[1], a[0] - parallax, a[1], sigma))
    table = np.array(rows, np.float64).reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4], np.zeros(len(table), bool))


def _refined_parallax(left: Array, right: Array, point: Array, parallax: float) -> tuple[float, float, float]:
    x, y = int(point[0]), int(point[1])
    rows = slice(max(y - REACH_PX, 0), y + REACH_PX + 1)
    start = np.full((left[rows].shape[0], left.shape[1]), np.nan, np.float32)
    start[:, max(x - REACH_PX, 0) : x + REACH_PX + 1] = parallax
    out = [np.empty_like(start) for _ in range(3)]
    kernels.refine(left[rows], right[rows], start, REACH_PX, TEAR_PX, *out)
    at = (y - rows.start, x)
    return float(out[0][at]), float(out[1][at]), float(out[2][at])


def like_neighbours(matches: Matches) -> NDArray[np.bool_]:
    """Return which points have a parallax within 3 px of the median of their neighbours across the facets."""
    keep = np.ones(len(matches), bool)
    if len(matches) < FEWEST_POINTS:
        return keep
    neighbours: list[set[int]] = [set() for _ in range(len(matches))]
    for facet in facets_between(matches.left):
        for corner in facet:
            neighbours[corner].update(int(k) for k in facet if k != corner)
    for k, around in enumerate(neighbours):
        if around:
            keep[k] = abs(matches.parallax_px[k] - np.median(matches.parallax_px[list(around)])) <= NEIGHBOUR_PX
    return keep


def enough(matches: Matches) -> Matches:
    """Return the matches if there are three or more, else raise `InputError`."""
    if len(matches) >= FEWEST_POINTS:
        return matches
    raise InputError(
        f"{len(matches)} points are seen in both views; three are needed.",
        fix=("check that both views show the same field", "give the band of parallax: --band-px -40 40"),
        code="stereo-points",
    )


def match_markers(left: Array, right: Array, *, band_px: tuple[int, int]) -> Matches:
    """Match dark markers within a transparent volume, whatever their order.

    Markers at different depths pass each other when the specimen is tilted. Partners lie in nearly the same row, within
    the band, and are about as dark; the pairing of least total cost is taken. A point whose second partner would have
    cost little more is marked ambiguous.

    Raises
    ------
    InputError
        Views that differ in size or are featureless; ``stereo-points``: fewer than three markers match.
    """
    left, right = prepared_pair(left, right)
    band = checked_band(band_px, left.shape[1])
    first, second = dark_markers(left), dark_markers(right)
    cost = marker_costs(first, second, band)
    pairs = [(a, b) for a, b in enumerate(assigned(cost)) if b < len(second) and cost[a, b] < UNMATCHED_COST]
    chosen = np.array([a for a, _ in pairs], int), np.array([b for _, b in pairs], int)
    rivals = np.array([_is_ambiguous(cost, a, b) for a, b in pairs], bool)
    sigma = np.full(len(pairs), MARKER_SIGMA_PX)
    return enough(Matches(first[chosen[0], :2], second[chosen[1], :2], sigma, rivals))


def marker_costs(first: Array, second: Array, band: tuple[int, int]) -> Array:
    """Return the cost of every pairing, and in further columns that of leaving each left marker alone."""
    parallax = first[:, np.newaxis, 0] - second[:, 0]
    rows = (first[:, np.newaxis, 1] - second[:, 1]) / MARKER_ROW_PX
    sizes = (np.log(first[:, np.newaxis, 2]) - np.log(second[:, 2])) / MARKER_LOG_SIZE
    cost = np.where((parallax >= band[0]) & (parallax <= band[1]), rows**2 + sizes**2, 1e6)
    return np.hstack([cost, np.full((len(first), len(first)), UNMATCHED_COST)])


def _is_ambiguous(cost: Array, a: int, b: int) -> bool:
    others = np.delete(cost[a], b)
    return bool(others.min() < min(cost[a, b] + AMBIGUOUS, UNMATCHED_COST))


def assigned(cost: Array) -> list[int]:
    """Return the column of each row so that the sum of costs is least; no fewer columns than rows.

    Shortest augmenting paths with prices that keep reduced costs positive (Jonker and Volgenant 1987).
    """
    rows, columns = cost.shape
    row_price, column_price = np.zeros(rows + 1), np.zeros(columns + 1)
    owner = np.full(columns + 1, rows)  # column ``columns`` and row ``rows`` stand for nothing
    for row in range(rows):
        owner[columns] = row
        came_from, at = _shortest_path(cost, owner, row_price, column_price)
        while at != columns:
            owner[at] = owner[came_from[at]]
            at = int(came_from[at])
    taken = np.flatnonzero(owner[:columns] < rows)
    order = taken[np.argsort(owner[taken])]
    return [int(column) for column in order]


def _shortest_path(cost: Array, owner: Array, row_price: Array, column_price: Array) -> tuple[Array, int]:
    """Grow the cheapest path from the row that stands in the last column to a free column; prices follow."""
    rows, columns = cost.shape
    least, came_from = np.full(columns, np.inf), np.full(columns, columns)
    used = np.zeros(columns + 1, bool)
    at = columns
    while owner[at] < rows:
        used[at] = True
        reduced = cost[owner[at]] - row_price[owner[at]] - column_price[:columns]
        better = ~used[:columns] & (reduced < least)
        least[better], came_from[better] = reduced[better], at
        nearest = int(np.argmin(np.where(used[:columns], np.inf, least)))
        step = least[nearest]
        row_price[owner[used]] += step
        column_price[used] -= step
        least[~used[:columns]] -= step
        at = nearest
    return came_from, at


def read_matches(path: Path) -> Matches:
    """Read a list of matches that was edited by hand; other columns than the four places are not looked at.

    Raises
    ------
    InputError
        ``stereo-matches``: the file cannot be read or lacks a column or a number. ``stereo-points``: too few.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [[float(row[name]) for name in COLUMNS] for row in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no list of matches.",
            why=f"{type(error).__name__}: {error}",
            fix=f"give a CSV with the columns {', '.join(COLUMNS)}, in pixels; points.csv of an earlier result is one.",
            code="stereo-matches",
        ) from None
    table = np.array(rows, np.float64).reshape(-1, 4)
    table = table[np.isfinite(table).all(axis=1)]
    unknown = np.full(len(table), np.nan)
    return enough(Matches(table[:, :2], table[:, 2:], unknown, np.zeros(len(table), bool)))


def facets_between(points: Array) -> Array:
    """Return the Delaunay triangles of points (points, 2), as (facets, 3) indices."""
    places = points.astype(np.float32)
    low, high = places.min(axis=0) - 1, places.max(axis=0) + 2
    net = cv2.Subdiv2D(
        (int(low[0]) - 1, int(low[1]) - 1, math.ceil(high[0] - low[0]) + 3, math.ceil(high[1] - low[1]) + 3)
    )
    index = {(float(x), float(y)): k for k, (x, y) in enumerate(places)}
    net.insert([(float(x), float(y)) for x, y in places])
    corners = np.asarray(net.getTriangleList()).reshape(-1, 3, 2)
    found = [[index.get((float(x), float(y)), -1) for x, y in facet] for facet in corners]
    return np.array([facet for facet in found if min(facet) >= 0], int).reshape(-1, 3)


def misfit_to_neighbours(places: Array, facets: Array, values: Array) -> NDArray[np.float64]:
    """How far each point lies from the plane that its neighbours across the facets make: what facets may be off by.

    Parameters
    ----------
    places : array (points, 2)
    facets : array (facets, 3) int
    values : array (points,)

    Returns
    -------
    array (points,)
        Absolute values in the unit of ``values``; 0 where there are fewer than three neighbours.
    """
    joined = np.zeros((len(places), len(places)), bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        joined[facets[:, a], facets[:, b]] = joined[facets[:, b], facets[:, a]] = True
    out = np.zeros(len(places))
    for k in np.flatnonzero(joined.sum(axis=1) >= FEWEST_POINTS):
        columns = np.column_stack([np.ones(int(joined[k].sum())), places[joined[k]] - places[k]])
        out[k] = abs(np.linalg.lstsq(columns, values[joined[k]], rcond=None)[0][0] - values[k])
    return out


def facet_raster(points: Array, facets: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Interpolate values of points linearly on facets; (height, width) float32, NaN outside."""
    out = np.full(shape, np.nan, np.float32)
    _fill_facets(points.astype(np.float64), facets, values.astype(np.float64), out)
    return out


@compiled
def _fill_facets(points: Array, facets: Array, values: Array, out: Array) -> None:
    height, width = out.shape
    for a, b, c in facets:
        ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        vx, vy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        area = ux * vy - uy * vx
        if area == 0:
            continue
        xs = (points[a, 0], points[b, 0], points[c, 0])
        ys = (points[a, 1], points[b, 1], points[c, 1])
        for y in range(max(int(np.ceil(min(ys))), 0), min(int(np.floor(max(ys))), height - 1) + 1):
            for x in range(max(int(np.ceil(min(xs))), 0), min(int(np.floor(max(xs))), width - 1) + 1):
                px, py = x - points[a, 0], y - points[a, 1]
                s, t = (px * vy - py * vx) / area, (ux * py - uy * px) / area
                if s >= 0 and t >= 0 and s + t <= 1:
                    out[y, x] = values[a] + s * (values[b] - values[a]) + t * (values[c] - values[a])


def facet_contours(points: Array, facets: Array, values: Array, levels: Array) -> list[Array]:
    """Return for each level the straight pieces of its contour on the facets, (pieces, 2, 2): ends, x and y."""
    return [_contour(points, facets, values, float(level)) for level in levels]


def _contour(points: Array, facets: Array, values: Array, level: float) -> Array:
    pieces = []
    for facet in facets:
        ends = []
        for a, b in ((facet[0], facet[1]), (facet[1], facet[2]), (facet[2], facet[0])):
            if (values[a] < level) != (values[b] < level):
                share = (level - values[a]) / (values[b] - values[a])
                ends.append(points[a] + share * (points[b] - points[a]))
        if len(ends) == 2:
            pieces.append(ends)
    return np.array(pieces, np.float64).reshape(-1, 2, 2)


def shortest_network(points: Array) -> Array:
    """Connect points in space, (points, 3), by the tree of least length; returns (points - 1, 2) indices, Prim 1957."""
    left = np.ones(len(points), bool)
    left[0] = False
    distance, nearest = np.linalg.norm(points - points[0], axis=1), np.zeros(len(points), int)
    links = []
    for _ in range(len(points) - 1):
        new = int(np.argmin(np.where(left, distance, np.inf)))
        links.append((int(nearest[new]), new))
        left[new] = False
        closer = np.linalg.norm(points - points[new], axis=1)
        nearest = np.where(closer < distance, new, nearest)
        distance = np.minimum(distance, closer)
    return np.array(links, int).reshape(-1, 2)
