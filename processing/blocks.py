"""What a block of 2×2×2 voxels adds to surface and Euler number, for each of the 256 ways it can be filled.

Both are sums over all blocks of a volume: the surface by counting where lines of 13 directions cross it (Crofton), the
Euler number by counting corners, edges, faces and bodies of the solid that the voxels make.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import SphericalVoronoi

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.neighbours import Rule, Spacing

    Array = NDArray[Any]
    Place = tuple[int, int, int]

PLACES: tuple[Place, ...] = tuple(product((0, 1), (0, 1), (0, 1)))  # (z, y, x); place k is bit k of a filling
STEPS_APART = {6: 1, 18: 2, 26: 3}  # of two voxels that still touch under a rule
AXES = tuple(combinations(range(3), 2))
DIRECTIONS: tuple[Place, ...] = tuple(d for d in product((-1, 0, 1), (-1, 0, 1), (-1, 0, 1)) if d > (0, 0, 0))


@cache
def direction_weights(spacing_um: Spacing) -> dict[Place, float]:
    """Return how much surface one crossing stands for along each of 13 directions.

    Crofton's formula: the crossings of all lines of a direction, times the area a line stands for, are the surface's
    projection, and four times the mean projection of a convex body is its surface (each line crosses it twice). A
    direction counts as much as the share of the sphere nearest to it.

    Parameters
    ----------
    spacing_um : tuple of float
        Distance of voxels along (z, y, x).

    Returns
    -------
    dict
        From direction, in voxels, to area in µm².
    """
    steps = np.array([*DIRECTIONS, *(-np.array(DIRECTIONS))]) * np.array(spacing_um)
    length = np.linalg.norm(steps, axis=1)
    shares = SphericalVoronoi(steps / length[:, None]).calculate_areas() / (4 * np.pi)
    area = 4 * shares * np.prod(spacing_um) / length
    return {direction: float(value) for direction, value in zip(DIRECTIONS, area, strict=False)}


def crossed(step: Place) -> NDArray[np.float64]:
    """Return, for each filling, which share of the pairs of voxels a step apart has one inside and one outside."""
    pairs = [(PLACES.index(a), PLACES.index(b)) for a in PLACES if (b := _moved(a, step)) in PLACES]
    fillings = np.arange(256)
    shares = [(fillings >> i & 1) != (fillings >> j & 1) for i, j in pairs]
    return np.asarray(np.mean(shares, axis=0), np.float64)


def _moved(place: Place, step: Place) -> Place:
    return place[0] + step[0], place[1] + step[1], place[2] + step[2]


def surface_table(spacing_um: Spacing) -> NDArray[np.float64]:
    """Return the surface in each filling, (256,), in µm²; of each pair of voxels, the share that is this block's."""
    table: NDArray[np.float64] = sum(
        (weight * crossed(step) for step, weight in direction_weights(spacing_um).items()), np.zeros(256)
    )
    return table


@cache
def _euler(rule: Rule) -> tuple[int, ...]:
    count = _points if rule == 6 else _solids
    return tuple(count([PLACES[k] for k in range(8) if filling >> k & 1], rule) for filling in range(256))


def euler_table(rule: Rule) -> NDArray[np.int64]:
    """Return the Euler number in each filling, (256,), in eighths: parts less tunnels plus cavities.

    Under rules 18 and 26 voxels are bodies: the number is corners - edges + faces - bodies, a corner counting once for
    each group of voxels that the rule glues together there. Under rule 6 they are points, joined to squares and cubes,
    so that what is not the solid touches under rule 26.
    """
    return np.array(_euler(rule), np.int64)


def _solids(filled: list[Place], rule: Rule) -> int:
    """Count around the middle of a block: a corner, six half edges, twelve quarters of faces, eighths of bodies."""
    halves = sum(any(p[axis] == side for p in filled) for axis, side in product(range(3), (0, 1)))
    faces = sum(any(p[a] == i and p[b] == j for p in filled) for a, b in AXES for i, j in product((0, 1), repeat=2))
    return 8 * _groups(filled, rule) - 4 * halves + 2 * faces - len(filled)


def _points(filled: list[Place], rule: Rule) -> int:
    """Count in a block: it has an eighth of each point, a quarter of each link, half of each square, its own cube."""
    links = sum(_apart(a, b) <= STEPS_APART[rule] for a, b in combinations(filled, 2))
    squares = sum(sum(p[axis] == side for p in filled) == 4 for axis, side in product(range(3), (0, 1)))
    return len(filled) - 2 * links + 4 * squares - 8 * (len(filled) == 8)


def _apart(a: Place, b: Place) -> int:
    return sum(abs(i - j) for i, j in zip(a, b, strict=True))


def _groups(filled: list[Place], rule: Rule) -> int:
    """Count the groups of voxels that are glued together."""
    left, count = list(filled), 0
    while left:
        reached, count = [left.pop()], count + 1
        while reached:
            here = reached.pop()
            near = [p for p in left if _apart(p, here) <= STEPS_APART[rule]]
            left = [p for p in left if p not in near]
            reached += near
    return count
