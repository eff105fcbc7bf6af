"""Regions grown from seeds: by likeness to the seed, and as a balloon that does not leak through narrow gaps."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any, Literal

import cc3d
import numpy as np

from devices.errors import InputError
from processing.flooding import flooded
from processing.labels import checked_rule
from processing.masks import AS_MASK, to_mask
from processing.morphology import extreme
from processing.neighbours import ball, neighbours
from processing.operators import operator
from processing.volume_filters import checked, median

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.neighbours import Rule, Spacing

    Array = NDArray[Any]
    Inside = NDArray[np.bool_]
    Place = tuple[int, int, int]

MOST_ROUNDS = 50
FIRST_REACH = 16  # voxels around a seed that are looked at first
FARTHER = 8  # times as far, where that is not enough
ROOM = 8  # voxels around a balloon in which it may grow before more of the volume is looked at


@operator("grow.region", gives=[AS_MASK])
def region(
    volume: Array,
    *,
    seed: tuple[int, ...],
    tolerance: float,
    rule: int = 26,
    like: Literal["seed", "mean", "neighbour"] = "seed",
) -> Array:
    """Mask of what is joined to a seed by voxels of nearly its value.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    seed : tuple of int
        z, y, x of a voxel, counted from 0; of more seeds one after the other: their regions are united.
    tolerance : float
        Most difference in grey values.
    rule : 6, 18 or 26
        Which neighbours are joined.
    like : str
        To what a voxel is compared: seed, the seed's value; mean, the mean of the region, found again until it does not
        change; neighbour, that of the neighbour it is reached from, so that slopes are followed.

    Returns
    -------
    array (z, y, x) uint8
        255 inside, 0 outside.

    Raises
    ------
    InputError
        ``seed``: not a place in the volume; ``operator-params``: a tolerance below zero; ``neighbours``;
        ``volume-shape``, ``volume-nan``.
    """
    grey = checked(volume)
    if not tolerance >= 0:
        raise InputError(f"a tolerance of {tolerance:g} is not possible.", fix="0 or more", code="operator-params")
    grow = {"seed": by_seed, "mean": by_mean, "neighbour": by_neighbour}[like]
    found = (grow(grey, place, tolerance, checked_rule(rule)) for place in places(seed, grey.shape))
    return to_mask(reduce(np.logical_or, found))


def places(seed: tuple[int, ...], shape: tuple[int, ...]) -> list[Place]:
    """Return seeds as places in a volume.

    Raises
    ------
    InputError
        ``seed``: not three numbers each, or outside.
    """
    found = [(seed[i], seed[i + 1], seed[i + 2]) for i in range(0, len(seed) - 2, 3)]
    if not found or len(seed) % 3 or any(not 0 <= p < n for place in found for p, n in zip(place, shape, strict=True)):
        raise InputError(
            f"seed {', '.join(map(str, seed))} is no place in a volume of {'×'.join(map(str, shape))}.",
            fix="give z,y,x, counted from 0: seed=10,120,80",
            code="seed",
        )
    return found


def by_seed(grey: Array, place: Place, tolerance: float, rule: Rule) -> Inside:
    """Return the voxels within the tolerance of the seed's value that are joined to it."""
    return around_value(grey, place, float(grey[place]), tolerance, rule)


def around_value(grey: Array, place: Place, value: float, tolerance: float, rule: Rule) -> Inside:
    """Return the voxels within the tolerance of a value that are joined to the seed, which counts as within."""
    low: Any = value - tolerance
    high: Any = value + tolerance
    if grey.dtype.kind == "u":  # compared as what they are, not as real numbers
        top = np.iinfo(grey.dtype).max
        low, high = (grey.dtype.type(np.clip(v, 0, top)) for v in (np.ceil(low), np.floor(high)))

    def join(part: Array, seed: Place) -> Inside:
        within: Inside = (part >= low) & (part <= high)
        within[seed] = True
        return flooded(within, seed, rule)

    return spread(grey, place, join)


def by_mean(grey: Array, place: Place, tolerance: float, rule: Rule) -> Inside:
    """Return the region around the seed that is all within the tolerance of its own mean.

    Where region and mean do not come to rest within 50 rounds, the last is taken.
    """
    inside = by_seed(grey, place, tolerance, rule)
    for _ in range(MOST_ROUNDS):
        value = float(grey[inside].mean(dtype=np.float64))
        before, inside = inside, around_value(grey, place, value, tolerance, rule)
        if np.array_equal(before, inside):
            break
    return inside


def by_neighbour(grey: Array, place: Place, tolerance: float, rule: Rule) -> Inside:
    """Return the voxels that are reached from the seed by steps within the tolerance."""

    def join(part: Array, seed: Place) -> Inside:
        raised: Array = part.astype(np.uint32) + 1 if part.dtype.kind == "u" else part - part.min() + np.float32(1)
        labels: Array = cc3d.connected_components(raised, connectivity=rule, delta=float(tolerance))
        same: Inside = labels == labels[seed]
        return same

    return spread(grey, place, join)


def spread(grey: Array, place: Place, join: Callable[[Array, Place], Inside]) -> Inside:
    """Look for what is joined to a seed in a box around it, and in larger ones until it does not reach its sides."""
    inside = np.zeros(grey.shape, bool)
    reach = FIRST_REACH
    while True:
        box = tuple(slice(max(0, p - reach), p + reach + 1) for p in place)
        seed = (place[0] - box[0].start, place[1] - box[1].start, place[2] - box[2].start)
        found = join(np.ascontiguousarray(grey[box]), seed)
        if found.shape == grey.shape:
            return found
        if not _leaves(found, box, grey.shape):
            inside[box] = found
            return inside
        reach *= FARTHER


def _leaves(found: Inside, box: tuple[slice, ...], shape: tuple[int, ...]) -> bool:
    """Tell whether a region reaches a side of its box beyond which the volume goes on."""
    for axis, (side, length) in enumerate(zip(box, shape, strict=True)):
        first, last = found.take(0, axis), found.take(-1, axis)
        if (side.start > 0 and first.any()) or (side.stop < length and last.any()):
            return True
    return False


@operator("grow.balloon", gives=[AS_MASK])
def balloon(
    volume: Array,
    spacing_um: Spacing | None = None,
    *,
    seed: tuple[int, ...],
    low: float,
    high: float,
    stiffness_px: float = 2.0,
    most_steps: int = 1000,
) -> Array:
    """Mask that a balloon fills: it swells from the seed through grey values of a band and is too stiff for gaps.

    In each step the surface moves out by a voxel where the grey values allow it, then every voxel goes with the most of
    a ball around it: the surface is smoothed, and a gap narrower than that ball stays shut (dilation and median in turn
    are pressure and mean curvature motion: Guichard and Morel 1997).

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    seed : tuple of int
        z, y, x of voxels where balloons begin, as of `region`; at least ``stiffness_px`` + 1 from the nearest wall.
    low, high : float
        Band of grey values that the balloon may fill.
    stiffness_px : float
        Radius of the ball.
    most_steps : int
        Most steps; a step is a voxel.

    Returns
    -------
    array (z, y, x) uint8
        255 inside, 0 outside. Corners sharper than the ball stay empty.

    Raises
    ------
    InputError
        ``seed``: not in the volume, or no room for a balloon there; ``volume-shape``, ``volume-nan``, ``spacing``.
    """
    grey = checked(volume)
    allowed = ((grey >= low) & (grey <= high)).view(np.uint8)
    inside = np.zeros(grey.shape, np.uint8)
    start = ball(stiffness_px + 1, spacing_um or (1.0, 1.0, 1.0)).offsets
    for place in places(seed, grey.shape):
        voxels = place + start
        voxels = voxels[((voxels >= 0) & (voxels < grey.shape)).all(axis=1)]
        inside[tuple(voxels.T)] = 1
    inside &= allowed
    for _ in range(most_steps):
        box = _box(inside, ROOM)
        if not _swell(inside[box], allowed[box], spacing_um, stiffness_px):
            break
    if not inside.any():
        raise InputError(
            f"there is no room for a balloon at seed {', '.join(map(str, seed))}.",
            fix="a seed further from the walls, a wider band low … high, or less stiffness_px",
            code="seed",
        )
    return inside * np.uint8(255)


def _swell(inside: NDArray[np.uint8], allowed: Array, spacing_um: Spacing | None, stiffness_px: float) -> bool:
    """Move the surface by a voxel, in place; False where nothing changed."""
    grown = extreme(np.ascontiguousarray(inside), neighbours(6), largest=True) & allowed
    smooth = median(grown, spacing_um, radius=stiffness_px) & allowed
    changed = bool((smooth != inside).any())
    inside[...] = smooth
    return changed


def _box(inside: Array, room: int) -> tuple[slice, ...]:
    """Return the part of a volume that holds a mask, with room around it."""
    box = []
    for axis in range(3):
        there = np.flatnonzero(inside.any(axis=tuple(other for other in range(3) if other != axis)))
        low, high = (int(there[0]), int(there[-1])) if there.size else (0, 0)
        box.append(slice(max(0, low - room), high + room + 1))
    return tuple(box)
