"""Touching features parted where they are narrow: watershed on the distance map.

Distances are counted in sixteenths of a pixel, so that voxels wait in one queue for each level instead of a heap. On
whole numbers the result is that of scikit-image, voxel by voxel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.compiled import compiled
from processing.distance import to_nearest
from processing.labels import AS_LABELS, checked_rule
from processing.masks import as_mask
from processing.neighbours import CUBIC, Spacing, checked_spacing, neighbours
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

LEVELS_PER_PIXEL = 16
MOST_LEVELS = 1 << 16
BLOCKED = -1
NONE = -1


@operator("watershed.split", gives=[AS_LABELS, Layer("count", dtype="int64")])
def split(
    volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, depth_px: float = 1.0
) -> tuple[Array, np.int64]:
    """Parts of a mask numbered, touching ones parted where they are narrow.

    Every summit of the distance map is a feature, unless it stands less than ``depth_px`` above the pass to a higher
    one; features grow downhill from their summits until they meet (Beucher and Lantuéjoul 1979).

    Parameters
    ----------
    volume : array (z, y, x)
        A mask.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule : 6, 18 or 26
        Which neighbours touch, whatever the spacing.
    depth_px : float
        How much deeper than the smaller of two summits their pass must be, in pixels; more joins more.

    Returns
    -------
    volume : array (z, y, x) uint32
        0 for background, else 1 … count, ordered by the place of the summit.
    count : int
        Number of features.

    Raises
    ------
    InputError
        ``mask-full``, ``mask-needed``, ``neighbours``, ``spacing``; ``volume-shape``, ``volume-nan``.
    """
    inside = as_mask(volume)
    spacing = checked_spacing(spacing_um or CUBIC)
    per_um = LEVELS_PER_PIXEL / np.sqrt(spacing[1] * spacing[2])
    distance = to_nearest(inside, spacing)
    per_um = min(per_um, (MOST_LEVELS - 1) / max(float(distance.max()), 1e-9))
    heights = np.rint(distance * np.float32(per_um)).astype(np.uint16)
    heights[inside] = np.maximum(heights[inside], 1)
    summits = summits_of(heights, rule, max(1, round(depth_px * LEVELS_PER_PIXEL)))
    return flood_downhill(heights, summits, rule), np.int64(summits.max())


def summits_of(heights: NDArray[np.uint16], rule: int, depth: int) -> NDArray[np.int32]:
    """Return numbers of one voxel of every summit that stands ``depth`` or more above the pass to a higher one.

    Parameters
    ----------
    heights : array (z, y, x) uint16
        0 is background.
    rule : 6, 18 or 26
        Which voxels are neighbours.
    depth : int
        In levels.

    Returns
    -------
    array (z, y, x) int32
        1, 2, … in raster order, 0 elsewhere.
    """
    padded = np.pad(heights, 1)
    voxels = np.flatnonzero(padded)
    order = voxels[np.argsort(padded.ravel()[voxels], kind="stable")[::-1]]
    marks = np.zeros(padded.size, np.uint8)
    mark_summits(padded.ravel(), order, _steps(rule, padded.shape), depth, marks)
    picked = np.ascontiguousarray(marks.reshape(padded.shape)[1:-1, 1:-1, 1:-1])
    return (np.cumsum(picked.ravel(), dtype=np.int32) * picked.ravel()).reshape(heights.shape)


def flood_downhill(heights: NDArray[np.uint16], markers: Array, rule: int) -> NDArray[np.uint32]:
    """Let numbered voxels grow over all others, the highest first, of equal ones the first come.

    Parameters
    ----------
    heights : array (z, y, x) uint16
        0 is background, which stays 0.
    markers : array (z, y, x) of whole numbers
        Where growth begins.
    rule : 6, 18 or 26
        Which voxels are neighbours.

    Returns
    -------
    array (z, y, x) uint32
        As scikit-image's ``watershed`` of the negative heights within heights > 0.
    """
    padded = np.pad(heights, 1)
    labels = np.full(padded.shape, BLOCKED, np.int32)
    labels[1:-1, 1:-1, 1:-1] = np.where(heights > 0, markers, BLOCKED)
    top = int(heights.max()) + 1
    flood_levels(padded.ravel(), labels.ravel(), _steps(rule, padded.shape), top)
    return np.maximum(labels[1:-1, 1:-1, 1:-1], 0).astype(np.uint32)


def _steps(rule: int, shape: tuple[int, ...]) -> NDArray[np.uint64]:
    """Return the steps to the neighbours in a raveled array, the nearest first; those back as steps around the end."""
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return np.asarray(neighbours(checked_rule(rule)).offsets[1:] @ strides).astype(np.uint64)


@compiled
def flood_levels(heights: Array, labels: Array, steps: Array, top: Any) -> None:
    """Grow ``labels`` (0: free, below: blocked) with one waiting line a height, the markers in one above all.

    What is reached uphill waits in the present line: water does not rise.
    """
    first, last = np.full(top + 1, NONE, np.int32), np.full(top + 1, NONE, np.int32)
    after = np.empty(labels.size, np.int32)
    for voxel in range(labels.size):
        if labels[voxel] > 0:
            append(voxel, top, first, last, after)
    for level in range(top, -1, -1):
        voxel = first[level]
        while voxel != NONE:
            label, here = labels[voxel], np.uint64(voxel)  # unsigned: no test for places counted from the end
            for k in range(steps.size):
                there = here + steps[k]
                if labels[there] == 0:
                    labels[there] = label
                    append(there, min(level, np.int64(heights[there])), first, last, after)
            voxel = after[voxel]


@compiled
def append(voxel: Any, line: Any, first: Array, last: Array, after: Array) -> None:
    """Put a voxel at the end of a line."""
    if first[line] == NONE:
        first[line] = voxel
    else:
        after[last[line]] = voxel
    last[line] = voxel
    after[voxel] = NONE


@compiled
def mark_summits(heights: Array, order: Array, steps: Array, depth: int, marks: Array) -> None:
    """Mark summits: islands rise from falling water; where two join, the lower one counts if it stood high enough.

    ``order`` are the voxels from the highest down. An island is known by its summit, which all its voxels lead to.
    """
    leads = np.full(heights.size, NONE, np.int32)
    for i in range(order.size):
        voxel = np.uint64(order[i])
        island = np.int32(order[i])
        leads[voxel] = island
        for k in range(steps.size):
            there = leads[voxel + steps[k]]
            if there != NONE and there != island:
                island = joined(heights, leads, marks, island, summit_of(leads, there), heights[voxel], depth)
    for i in range(order.size):
        if leads[order[i]] == order[i]:
            marks[order[i]] = 1


@compiled
def joined(heights: Array, leads: Array, marks: Array, one: Any, other: Any, level: Any, depth: Any) -> Any:
    """Join two islands at a pass of height ``level``; returns the summit of both."""
    if one == other:
        return one
    if heights[one] < heights[other] or (heights[one] == heights[other] and one > other):
        one, other = other, one
    if np.int64(heights[other]) - np.int64(level) >= depth:
        marks[other] = 1
    leads[other] = one
    return one


@compiled
def summit_of(leads: Array, voxel: Any) -> Any:
    """Return where a voxel leads to in the end, and shorten the way there."""
    while leads[voxel] != voxel:
        leads[voxel] = leads[leads[voxel]]
        voxel = leads[voxel]
    return voxel
