"""Numbers of a whole volume: how much is inside, how much surface it has, in four ways, and how it hangs together.

The relations are those of stereology (Underwood 1970): V_V = P_P, S_V = 2 P_L = (4/π) B_A, true for any structure whose
surface has no preferred direction, or when lines and planes of all directions are taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, Any

import numpy as np

from processing import feature_kernels as kernels
from processing.blocks import euler_table, surface_table
from processing.neighbours import CUBIC, Rule, Spacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Mask = NDArray[np.bool_]

BLOCKS_EACH = 4  # along each axis, at most, for the counting error
FEWEST_BLOCK_VOXELS = 4  # along each axis
DISAGREE = 0.05  # of the mean of the ways to measure surface: more is said


@dataclass(frozen=True)
class Estimate:
    """A number with its error.

    Attributes
    ----------
    value : float
    error : float or None
        Standard error; None where none can be given.
    how : str
        In words.
    """

    value: float
    error: float | None
    how: str


def volume_fraction(mask: Mask) -> Estimate:
    """Return the share of voxels inside, with its counting error.

    Voxels of one feature are not independent, so that counting them would make the error far too small. The volume is
    parted in up to 4×4×4 blocks; the scatter of their shares is the error of their mean. It is right when blocks are
    larger than features, and too small when not.
    """
    share = float(np.mean(mask))
    cuts = [np.linspace(0, n, _parts(n) + 1).astype(int) for n in mask.shape]
    boxes = product(*([slice(a, b) for a, b in pairwise(c)] for c in cuts))
    shares = np.array([mask[box].mean() for box in boxes])
    if len(shares) < 2:
        return Estimate(share, None, "voxels inside over all")
    error = float(shares.std(ddof=1) / np.sqrt(len(shares)))
    return Estimate(share, error, f"voxels inside over all; error from the scatter of {len(shares)} blocks")


def _parts(length: int) -> int:
    return int(np.clip(length // FEWEST_BLOCK_VOXELS, 1, BLOCKS_EACH))


def by_intercepts(mask: Mask, spacing_um: Spacing = CUBIC) -> dict[str, float]:
    """Return S_V = 2 P_L, in 1/µm, from lines along each axis: crossings per length of line."""
    return {
        name: 2 * _crossings(mask, step) / spacing_um[axis]
        for axis, (name, step) in enumerate(zip("zyx", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True))
        if mask.shape[axis] > 1
    }


def _crossings(mask: Mask, step: tuple[int, int, int]) -> float:
    """Return the share of steps in a direction that cross the surface.

    Lines and planes along the border have half of it outside, and count half: so all ways to measure see one volume,
    that between the middles of the outermost voxels.
    """
    here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, mask.shape, strict=True))
    there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, mask.shape, strict=True))
    crossed = mask[here] != mask[there]
    left: Any = crossed
    weights = [np.ones(n) if s else _half_at_ends(n) for s, n in zip(step, crossed.shape, strict=True)]
    for weight in weights[::-1]:
        left = left @ weight
    return float(left) / float(np.prod([weight.sum() for weight in weights]))


def _half_at_ends(count: int) -> Array:
    weight = np.ones(count)
    if count > 1:
        weight[[0, -1]] = 0.5
    return weight


def by_boundaries(mask: Mask, spacing_um: Spacing = CUBIC) -> dict[str, float]:
    """Return S_V = (4/π) B_A, in 1/µm, from planes across each axis: length of outlines per area.

    The length is that of Crofton's formula in the plane, with lines of four directions.
    """
    return {
        "zyx"[axis]: 4 / np.pi * _boundary_length(mask, across, spacing_um)
        for axis, across in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1)))
        if min(mask.shape[a] for a in across) > 1
    }


def _boundary_length(mask: Mask, across: tuple[int, int], spacing_um: Spacing) -> float:
    """Return the length of outlines per area; directions count by their share of a half turn."""
    a, b = (spacing_um[axis] for axis in across)
    steps = [(0, 1), (1, 1), (1, 0), (1, -1)]
    turns = np.sort([np.arctan2(i * a, j * b) % np.pi for i, j in steps])
    shares = (np.roll(turns, -1) - np.roll(turns, 1)) % np.pi / (2 * np.pi)
    total = 0.0
    for (i, j), share in zip(steps, shares, strict=True):
        step = [0, 0, 0]
        step[across[0]], step[across[1]] = i, j
        total += np.pi / 2 * share * _crossings(mask, (step[0], step[1], step[2])) / float(np.hypot(i * a, j * b))
    return total


@dataclass(frozen=True)
class Whole:
    """What blocks of 2×2×2 voxels add up to over a mask.

    Attributes
    ----------
    euler : int
        Euler number of the mask, as if nothing were outside.
    euler_share : float
        The same, corrected for what the border cuts: what the volume adds to that of a larger specimen.
    surface_um2 : float
        By Crofton's formula, without the cuts at the border.
    """

    euler: int
    euler_share: float
    surface_um2: float


def whole(mask: Mask, spacing_um: Spacing = CUBIC, rule: Rule = 26) -> Whole:
    """Add up Euler number and surface of a mask."""
    euler, area = np.zeros(2), np.zeros(2)
    tables = np.stack([euler_table(rule) / 8, surface_table(spacing_um)])
    last = np.zeros(np.add(mask.shape[1:], 2), np.uint32)
    for z in range(len(mask) + 1):
        plane = np.pad(mask[z], 1).astype(np.uint32) if z < len(mask) else np.zeros_like(last)
        kernels.add_blocks(last, plane, 0 < z < len(mask), tables, euler, area)
        last = plane
    return Whole(round(euler[1]), float(euler[1]) - _cut_by_border(mask, rule), float(area[1]))


def _cut_by_border(mask: Mask, rule: Rule) -> float:
    """Return what the border adds to the Euler number (Odgaard and Gundersen 1993).

    Blocks that tile a specimen share sides, edges and corners. Each side belongs to two of them, each edge to four,
    each corner to eight, so that half the Euler number of the six sides is not this block's own; of the edges a
    quarter was taken away too often, of the corners an eighth too little.
    """
    total = 0.0
    for fixed in (1, 2, 3):
        sign = (-1) ** (fixed + 1) / 2**fixed
        for axes in combinations(range(3), fixed):
            for ends in product((0, -1), repeat=fixed):
                box: list[Any] = [slice(None)] * 3
                for axis, end in zip(axes, ends, strict=True):
                    box[axis] = slice(end, None if end else 1)
                total += sign * _euler(mask[tuple(box)], rule)
    return total


def _euler(mask: Mask, rule: Rule) -> float:
    """Euler number of a small part; a side of one voxel's thickness has that of the plane."""
    padded = np.pad(mask, 1)
    filling = np.zeros(np.subtract(padded.shape, 1), np.int64)
    for k, corner in enumerate(product((0, 1), repeat=3)):
        place = tuple(slice(c, n - 1 + c) for c, n in zip(corner, padded.shape, strict=True))
        filling |= padded[place].astype(np.int64) << k
    return float(euler_table(rule)[filling].sum()) / 8


def surface_ways(
    mask: Mask, spacing_um: Spacing, crofton_um2: float, facets: tuple[float, float | None] | None
) -> tuple[dict[str, Estimate], list[str]]:
    """Return surface per volume, in 1/µm, in four ways, and what must be said of it.

    Parameters
    ----------
    crofton_um2 : float
        Surface by `whole`.
    facets : (float, float or None), optional
        Surface per volume of triangles, and its error.
    """
    cells = float(np.prod([max(n - 1, 1) * s for n, s in zip(mask.shape, spacing_um, strict=True)]))
    lines, planes = by_intercepts(mask, spacing_um), by_boundaries(mask, spacing_um)
    ways = {
        "intercepts": _of_axes(lines, "2 P_L, lines along"),
        "boundaries": _of_axes(planes, "4/π B_A, planes across"),
    }
    if min(mask.shape) > 1:
        ways["crofton"] = Estimate(crofton_um2 / cells, None, "crossings of lines of 13 directions")
    if facets is not None:
        ways["facets"] = Estimate(*facets, "triangles")
    return ways, _agreement(ways)


def _of_axes(found: dict[str, float], how: str) -> Estimate:
    values = np.array(list(found.values()))
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Estimate(float(values.mean()) if len(values) else 0.0, error, f"{how} {', '.join(found)}")


def is_mask(volume: Array) -> bool:
    """Tell whether a volume has two values at most."""
    low, high = volume.min(), volume.max()
    return bool(np.all((volume == low) | (volume == high)))


def _agreement(ways: dict[str, Estimate]) -> list[str]:
    values = np.array([way.value for way in ways.values()])
    if len(values) < 2 or not values.max():
        return []
    apart = float(np.ptp(values) / values.mean())
    if apart <= DISAGREE:
        return []
    words = (
        f"the ways to measure surface differ by {apart:.0%}: the structure has a preferred direction (then believe the "
        "facets), or is hardly larger than voxels (then believe none)."
    )
    return [words]
