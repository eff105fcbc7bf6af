"""Numbers of a whole volume: how much is inside, how much surface it has, in four ways, and how it hangs together.

The relations are those of stereology (Underwood 1970): V_V = P_P, S_V = 2 P_L = (4/π) B_A, true for any structure whose
surface has no preferred direction, or when lines and planes of all directions are taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.neighbours import CUBIC, Spacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.whole import Whole

    Array = NDArray[Any]

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


def volume_fraction(found: Whole) -> Estimate:
    """Return the share of voxels inside, with its counting error.

    Voxels of one feature are not independent, so that counting them would make the error far too small. The volume is
    parted in up to 4×4×4 blocks; the scatter of their shares is the error of their mean. It is right when blocks are
    larger than features, and too small when not.
    """
    share, shares = found.inside / found.size, found.shares
    if shares.size < 2:
        return Estimate(share, None, "voxels inside over all")
    error = float(shares.std(ddof=1) / np.sqrt(shares.size))
    return Estimate(share, error, f"voxels inside over all; error from the scatter of {shares.size} blocks")


def by_intercepts(found: Whole, spacing_um: Spacing = CUBIC) -> dict[str, float]:
    """Return S_V = 2 P_L, in 1/µm, from lines along each axis: crossings per length of line."""
    return {
        name: 2 * found.crossings(step) / spacing_um[axis]
        for axis, (name, step) in enumerate(zip("zyx", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True))
        if found.shape[axis] > 1
    }


def by_boundaries(found: Whole, spacing_um: Spacing = CUBIC) -> dict[str, float]:
    """Return S_V = (4/π) B_A, in 1/µm, from planes across each axis: length of outlines per area.

    The length is that of Crofton's formula in the plane, with lines of four directions.
    """
    return {
        "zyx"[axis]: 4 / np.pi * _boundary_length(found, across, spacing_um)
        for axis, across in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1)))
        if min(found.shape[a] for a in across) > 1
    }


def _boundary_length(found: Whole, across: tuple[int, int], spacing_um: Spacing) -> float:
    """Return the length of outlines per area; directions count by their share of a half turn."""
    a, b = (spacing_um[axis] for axis in across)
    steps = [(0, 1), (1, 1), (1, 0), (1, -1)]
    turns = np.sort([np.arctan2(i * a, j * b) % np.pi for i, j in steps])
    shares = (np.roll(turns, -1) - np.roll(turns, 1)) % np.pi / (2 * np.pi)
    total = 0.0
    for (i, j), share in zip(steps, shares, strict=True):
        step = [0, 0, 0]
        step[across[0]], step[across[1]] = i, j
        total += np.pi / 2 * share * found.crossings((step[0], step[1], step[2])) / float(np.hypot(i * a, j * b))
    return total


def surface_ways(
    found: Whole, spacing_um: Spacing, facets: tuple[float, float | None] | None
) -> tuple[dict[str, Estimate], list[str]]:
    """Return surface per volume, in 1/µm, in four ways, and what must be said of it.

    Parameters
    ----------
    facets : (float, float or None), optional
        Surface per volume of triangles, and its error.
    """
    cells = float(np.prod([max(n - 1, 1) * s for n, s in zip(found.shape, spacing_um, strict=True)]))
    lines, planes = by_intercepts(found, spacing_um), by_boundaries(found, spacing_um)
    ways = {
        "intercepts": _of_axes(lines, "2 P_L, lines along"),
        "boundaries": _of_axes(planes, "4/π B_A, planes across"),
    }
    if min(found.shape) > 1:
        ways["crofton"] = Estimate(found.surface_um2(spacing_um) / cells, None, "crossings of lines of 13 directions")
    if facets is not None:
        ways["facets"] = Estimate(*facets, "triangles")
    return ways, _agreement(ways)


def _of_axes(found: dict[str, float], how: str) -> Estimate:
    values = np.array(list(found.values()))
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Estimate(float(values.mean()) if len(values) else 0.0, error, f"{how} {', '.join(found)}")


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
