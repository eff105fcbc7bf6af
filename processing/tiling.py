"""Surfaces stretched between the outlines of neighbouring sections, with splits, merges and ends.

Two outlines belong together where they overlap. Where one faces several, it is either divided among them along the
lines midway between their centroids, or joined to each as a whole; in the second case the pieces run into each other,
and only what lies in front is seen.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.path import Path as Polygon

from devices.errors import InputError
from processing.compiled import compiled
from processing.facets import Facets, point_normals

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from processing.outlines import Outline

    Array = NDArray[Any]
    Line = tuple[Array, float]
    Pair = tuple["_Ring", "_Ring"]

Splits = Literal["divided", "whole"]
FEWEST_CORNERS = 3
ON_LINE = 1e-9  # of the outline's size: points so near to a line of division lie on it


@dataclass(frozen=True, eq=False)
class Tiled:
    """A surface between outlines.

    Attributes
    ----------
    facets : Facets
        Closed and turned alike; of ``whole`` splits, closed pieces.
    splits : int
        Pairs of sections and outlines where one faces several.
    """

    facets: Facets
    splits: int


class _Ring:
    """An outline whose points are numbered in the whole surface; lines of division add points to it."""

    def __init__(self, outline: Outline) -> None:
        self.outline = outline
        self.points = outline.points
        self.first = 0

    @property
    def hole(self) -> bool:
        return self.outline.area_um2 < 0

    def refine(self, lines: Sequence[Line]) -> None:
        """Add a point wherever a line (normal, offset) crosses."""
        for normal, offset in lines:
            points = []
            for a, b in zip(self.points, np.roll(self.points, -1, axis=0), strict=True):
                points.append(a)
                da, db = self._side(a, normal, offset), self._side(b, normal, offset)
                if da * db < 0:
                    points.append(a + (b - a) * da / (da - db))
            self.points = np.array(points)

    def part(self, lines: Sequence[Line]) -> list[int]:
        """Return the numbers of the points on the lower side of all lines, in order."""
        left = [
            k
            for k, point in enumerate(self.points)
            if all(self._side(point, normal, offset) <= 0 for normal, offset in lines)
        ]
        return [self.first + k for k in left]

    def _side(self, point: Array, normal: Array, offset: float) -> float:
        away = float(point @ normal - offset)
        return 0.0 if abs(away) < ON_LINE * float(np.ptp(self.outline.points)) else away


def tile(outlines: Iterable[Outline], splits: Splits = "divided") -> Tiled:
    """Stretch a surface between the outlines of each two neighbouring sections, and close its ends flat.

    Parameters
    ----------
    outlines : iterable of Outline
        Of sections in order; holes run the other way round.
    splits : {"divided", "whole"}
        What is done where one outline faces several.

    Raises
    ------
    InputError
        ``mask-empty``: no outlines.
    """
    sections: dict[int, list[_Ring]] = defaultdict(list)
    for outline in outlines:
        sections[outline.section].append(_Ring(outline))
    if not sections:
        raise InputError("there are no outlines.", fix="choose another threshold.", code="mask-empty")
    order = sorted(sections)
    pairs = {k: _pairs(sections[k], sections.get(k + 1, [])) for k in order}
    divisions = _divisions(pairs) if splits == "divided" else {}
    for ring, other in divisions:
        ring.refine(divisions[ring, other])
    _number([ring for k in order for ring in sections[k]])
    mesh = _Mesh([ring for k in order for ring in sections[k]])
    for linked in pairs.values():
        for a, b in linked:
            mesh.join(a, b, divisions.get((a, b), []), divisions.get((b, a), []))
    for k in order:
        for ring in sections[k]:
            mesh.close(ring, _half_step([r[0].outline.z_um for r in (sections[n] for n in order)], ring.outline.z_um))
    points, triangles = np.concatenate(mesh.points), np.concatenate(mesh.triangles)
    count = sum(
        2 * len(linked) - len({a for a, _ in linked}) - len({b for _, b in linked}) for linked in pairs.values()
    )
    return Tiled(Facets(points, triangles, point_normals(points, triangles)), count)


def _half_step(places_um: list[float], z_um: float) -> float:
    """Return half the distance to the nearest section: as far as a section stands for what is around it."""
    away = np.abs(np.array(places_um) - z_um)
    return float(away[away > 0].min()) / 2 if (away > 0).any() else 0.5


class _Mesh:
    """Triangles as they come, and the points they use."""

    def __init__(self, rings: list[_Ring]) -> None:
        self.points = [np.column_stack([r.points, np.full(len(r.points), r.outline.z_um)]) for r in rings]
        self.triangles: list[Array] = []
        self.count = sum(map(len, self.points))
        self.above: set[_Ring] = set()
        self.below: set[_Ring] = set()

    def join(self, lower: _Ring, upper: _Ring, of_lower: list[Line], of_upper: list[Line]) -> None:
        """Stretch a band; where the whole of a ring is joined once more, the band is a piece with an end of its own."""
        low, high = lower.part(of_lower), upper.part(of_upper)
        if min(len(low), len(high)) < FEWEST_CORNERS:
            return
        if lower in self.above and not of_lower:
            low = self._copied(low)
            self.triangles.append(cap(self._all(), low)[:, ::-1])
        if upper in self.below and not of_upper:
            high = self._copied(high)
            self.triangles.append(cap(self._all(), high))
        self.triangles.append(band(self._all(), np.array(low), np.array(high)))
        self.above.add(lower)
        self.below.add(upper)

    def close(self, ring: _Ring, half_um: float) -> None:
        """End a ring that nothing follows on a side, half a step beyond its section."""
        numbers = ring.part([])
        for joined, up in ((self.above, 1), (self.below, -1)):
            if ring not in joined:
                end = self._copied(numbers, up * half_um)
                sides = [(a, b, c) for a, b, c in zip(numbers, np.roll(numbers, -1), end, strict=True)]
                sides += [(b, d, c) for b, c, d in zip(np.roll(numbers, -1), end, np.roll(end, -1), strict=True)]
                found = np.concatenate([np.array(sides), cap(self._all(), end)])
                self.triangles.append(found[:, ::up])

    def _copied(self, numbers: list[int], up_um: float = 0.0) -> list[int]:
        self.points.append(self._all()[numbers] + (0, 0, up_um))
        self.count += len(numbers)
        return list(range(self.count - len(numbers), self.count))

    def _all(self) -> Array:
        if len(self.points) > 1:
            self.points = [np.concatenate(self.points)]
        return self.points[0]


def _pairs(lower: list[_Ring], upper: list[_Ring]) -> list[Pair]:
    """Return which rings of two sections overlap, outlines with outlines and holes with holes."""
    return [(a, b) for a in lower for b in upper if a.hole == b.hole and _overlap(a.points, b.points)]


def _overlap(one: Array, other: Array) -> bool:
    return bool(Polygon(one).contains_points(other).any() or Polygon(other).contains_points(one).any())


def _divisions(pairs: dict[int, list[Pair]]) -> dict[Pair, list[Line]]:
    """Return, of each ring that faces several, the lines that part off what belongs to each of them."""
    found = {}
    for linked in pairs.values():
        facing: dict[_Ring, list[_Ring]] = defaultdict(list)
        for a, b in linked:
            facing[a].append(b)
            facing[b].append(a)
        for ring, others in facing.items():
            for other in others:
                found[ring, other] = [_midway(other, third) for third in others if third is not other]
    return {key: lines for key, lines in found.items() if lines}


def _midway(near: _Ring, far: _Ring) -> Line:
    """Return the line midway between two centroids, the near one on its lower side."""
    a, b = (np.array(ring.outline.centroid_um) for ring in (near, far))
    normal = (b - a) / max(float(np.linalg.norm(b - a)), 1e-300)
    return normal, float(normal @ (a + b) / 2)


def _number(rings: list[_Ring]) -> None:
    """Give the points of all rings their numbers."""
    total = 0
    for ring in rings:
        ring.first = total
        total += len(ring.points)


def band(points: Array, lower: Array, upper: Array) -> Array:
    """Return triangles between two rings, outwards: those of the least total length of edges (Fuchs et al. 1977).

    The rings are laid with their centroids over each other, so that what leans is not twisted, and begin where they are
    nearest.
    """
    a, b = points[lower, :2], points[upper, :2]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    i, j = np.unravel_index(apart.argmin(), apart.shape)
    lower, upper = np.roll(lower, -int(i)), np.roll(upper, -int(j))
    apart = np.roll(apart, (-int(i), -int(j)), (0, 1))
    return stitched(apart, lower.astype(np.int64), upper.astype(np.int64))


@compiled
def stitched(apart: Array, lower: Array, upper: Array) -> Array:
    """Find the cheapest way around both rings, step by step on either."""
    m, n = apart.shape
    cost = np.full((m + 1, n + 1), np.inf)
    cost[0, 0] = 0.0
    for i in range(m + 1):
        for j in range(n + 1):
            if i:
                cost[i, j] = min(cost[i, j], cost[i - 1, j] + apart[i % m, j % n])
            if j:
                cost[i, j] = min(cost[i, j], cost[i, j - 1] + apart[i % m, j % n])
    found = np.empty((m + n, 3), np.int64)
    i, j = m, n
    for k in range(m + n):
        if j == 0 or (i > 0 and cost[i - 1, j] <= cost[i, j - 1]):
            found[k, 0], found[k, 1], found[k, 2] = lower[i - 1], lower[i % m], upper[j % n]
            i -= 1
        else:
            found[k, 0], found[k, 1], found[k, 2] = upper[j % n], upper[j - 1], lower[i % m]
            j -= 1
    return found


def cap(points: Array, ring: Sequence[int]) -> Array:
    """Return triangles that fill a ring, upwards: ears are cut off one by one (Meisters 1975)."""
    left, found = list(ring), []
    flat = points[:, :2]
    turn = np.sign(_area(flat[left]))
    while len(left) > 3:
        k = _ear(flat, left, float(turn))
        found.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    found.append((left[0], left[1], left[2]))
    return np.array(found, np.int64)


def _area(polygon: Array) -> float:
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _ear(flat: Array, left: list[int], turn: float) -> int:
    """Return a corner that can be cut off; of a ring that crosses itself the sharpest one."""
    here = flat[left]
    before, after = np.roll(here, 1, axis=0), np.roll(here, -1, axis=0)
    convex = turn * _cross(here - before, after - here)
    for k in np.argsort(-convex, kind="stable"):
        if convex[k] <= 0:
            break
        others = np.delete(here, [k, k - 1, (k + 1) % len(left)], axis=0)
        if not _within(others, before[k], here[k], after[k], turn).any():
            return int(k)
    return int(convex.argmax())


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _within(points: Array, a: Array, b: Array, c: Array, turn: float) -> NDArray[np.bool_]:
    sides = [turn * _cross(q - p, points - p) > 0 for p, q in pairwise((a, b, c, a))]
    return np.asarray(np.logical_and.reduce(sides))
