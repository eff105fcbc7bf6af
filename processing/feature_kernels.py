"""Compiled loops that measure every feature of a volume at once, plane by plane: sums that add up.

Labels are (rows, columns) uint32, 0 for background; tables have a row for each label, 0 included. A row of voxels is
taken in runs of one label, so that places cost a few operations for a whole run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.compiled import compiled

if TYPE_CHECKING:
    Array = np.ndarray[Any, Any]

# Columns of sums: voxels, Σz, Σy, Σx, Σz², Σy², Σx², Σzy, Σzx, Σyx, and Σ and Σ² of the grey values.
SUMS = 12


@compiled
def add_plane(labels: Array, grey: Array, z: int, sums: Array, spans: Array, extremes: Array) -> None:
    """Add a plane to the tables.

    Parameters
    ----------
    grey : array (rows, columns) float32
        Grey values.
    sums : array (n, 12) float64
        As the comment above says.
    spans : array (n, 6) int64
        Smallest z, y, x and largest z, y, x.
    extremes : array (n, 2) float64
        Smallest and largest grey value.
    """
    for y in range(labels.shape[0]):
        row, x = labels[y], 0
        while x < row.size:
            label, start = row[x], x
            x = end_of_run(row, x)
            if label:
                add_greys(grey[y, start:x], sums[label], extremes[label])
                add_places(z, y, start, x, sums[label])
                widen(spans[label], z, y, start, x - 1)


@compiled
def end_of_run(row: Array, x: int) -> int:
    """Return where the run that begins at ``x`` is over."""
    label = row[x]
    while x < row.size and row[x] == label:
        x += 1
    return x


@compiled
def add_greys(grey: Array, sums: Array, extremes: Array) -> None:
    """Add grey values to the sums of a label, and widen their extremes."""
    total, squares, low, high = 0.0, 0.0, extremes[0], extremes[1]
    for x in range(grey.size):
        value = np.float64(grey[x])
        total += value
        squares += value * value
        low = min(low, value)
        high = max(high, value)
    sums[10] += total
    sums[11] += squares
    extremes[0], extremes[1] = low, high


@compiled
def add_places(z: int, y: int, start: int, stop: int, sums: Array) -> None:
    """Add the voxels ``start`` … ``stop`` - 1 of a row to the sums of a label; sums of squares are (Σ of 1 … n)."""
    n = np.float64(stop - start)
    along = n * (start + stop - 1) / 2
    squares = n * start * start + start * n * (n - 1) + (n - 1) * n * (2 * n - 1) / 6
    sums[0] += n
    sums[1] += n * z
    sums[2] += n * y
    sums[3] += along
    sums[4] += n * z * z
    sums[5] += n * y * y
    sums[6] += squares
    sums[7] += n * z * y
    sums[8] += z * along
    sums[9] += y * along


@compiled
def widen(span: Array, z: int, y: int, first: int, last: int) -> None:
    """Widen the box of a label to hold a run."""
    span[0] = min(span[0], z)
    span[1] = min(span[1], y)
    span[2] = min(span[2], first)
    span[3] = max(span[3], z)
    span[4] = max(span[4], y)
    span[5] = max(span[5], last)


@compiled
def add_blocks(upper: Array, lower: Array, inner: bool, tables: Array, euler: Array, area: Array) -> None:  # noqa: FBT001
    """Add what all blocks of 2×2×2 voxels between two planes hold of each label.

    Parameters
    ----------
    upper, lower : array (rows + 2, columns + 2) uint32
        Labels of the planes with a frame of 0 around.
    inner : bool
        Both planes are within the volume, so that surface between them is surface and no cut.
    tables : array (2, 256) float64
        Euler number and surface of each filling.
    euler, area : array (n,) float64
        Sums for each label.
    """
    rows, columns = upper.shape
    mixed = np.empty(columns - 1, np.uint32)
    for y in range(rows - 1):
        a, b, c, d = upper[y], upper[y + 1], lower[y], lower[y + 1]
        within = inner and 0 < y < rows - 2
        find_mixed(a, b, c, d, mixed)
        for x in range(columns - 1):
            if mixed[x]:
                block = (a[x], a[x + 1], b[x], b[x + 1], c[x], c[x + 1], d[x], d[x + 1])
                add_block(block, within and 0 < x < columns - 2, tables, euler, area)


@compiled
def find_mixed(a: Array, b: Array, c: Array, d: Array, mixed: Array) -> None:
    """Put 0 where a block has one label alone; a loop of its own, since it takes many blocks at a time."""
    for x in range(mixed.size):
        first, second = a[x], a[x + 1]
        left = (first ^ b[x]) | (first ^ c[x]) | (first ^ d[x])
        right = (second ^ b[x + 1]) | (second ^ c[x + 1]) | (second ^ d[x + 1])
        mixed[x] = left | right | (first ^ second)


@compiled
def add_block(block: tuple[int, ...], within: bool, tables: Array, euler: Array, area: Array) -> None:  # noqa: FBT001
    """Add one block to each label in it, which is looked at where it is met first."""
    done = 0
    for k in range(8):
        label = block[k]
        if label and not done >> k & 1:
            filling = 0
            for j in range(k, 8):
                if block[j] == label:
                    filling |= 1 << j
            done |= filling
            euler[label] += tables[0, filling]
            if within:
                area[label] += tables[1, filling]


@compiled
def count_fillings(upper: Array, lower: Array, inner: bool, counts: Array) -> None:  # noqa: FBT001
    """Count how often blocks of 2×2×2 voxels between two planes are filled in each of the 256 ways.

    Parameters
    ----------
    upper, lower : array (rows + 2, columns + 2) uint8
        Masks of 0 and 1 with a frame of 0 around.
    inner : bool
        Both planes are within the volume.
    counts : array (2, 256) int64
        Of blocks that reach beyond the volume, and of those within.
    """
    rows, columns = upper.shape
    for y in range(rows - 1):
        a, b, c, d = upper[y], upper[y + 1], lower[y], lower[y + 1]
        within = inner and 0 < y < rows - 2
        left = np.int64(0)
        for x in range(1, columns):
            right = np.int64(a[x]) << 1 | np.int64(b[x]) << 3 | np.int64(c[x]) << 5 | np.int64(d[x]) << 7
            counts[int(within and 1 < x < columns - 1), left | right] += 1
            left = right >> 1


@compiled
def add_ends(labels: Array, z: int, common: Array, own: Array, reach: Array, places: Array) -> None:
    """Keep the outermost voxels of each label along directions: only ends of runs can be outermost.

    Parameters
    ----------
    common : array (m, 3) float64
        Directions for all labels, times the voxels' sizes.
    own : array (n, 3, 3) float64
        Three for each label, likewise.
    reach : array (n, m + 3, 2) float64
        How far they reach backwards and forwards.
    places : array (n, m + 3, 2, 3) int32
        The outermost voxels.
    """
    for y in range(labels.shape[0]):
        row, x = labels[y], 0
        while x < row.size:
            label, start = row[x], x
            x = end_of_run(row, x)
            if label:
                for end in (start, x - 1):
                    stretch(z, y, end, common, reach[label], places[label])
                    stretch(z, y, end, own[label], reach[label, common.shape[0] :], places[label, common.shape[0] :])


@compiled
def stretch(z: int, y: int, x: int, directions: Array, reach: Array, places: Array) -> None:
    """Keep a voxel where it is the outermost one."""
    for k in range(directions.shape[0]):
        far = z * directions[k, 0] + y * directions[k, 1] + x * directions[k, 2]
        if far < reach[k, 0]:
            reach[k, 0] = far
            keep(z, y, x, places[k, 0])
        if far > reach[k, 1]:
            reach[k, 1] = far
            keep(z, y, x, places[k, 1])


@compiled
def keep(z: int, y: int, x: int, place: Array) -> None:
    """Write down a place."""
    place[0], place[1], place[2] = z, y, x


@compiled
def longest(places: Array, spacing: Array) -> Array:
    """Return the largest dimension of each label: the farthest of its outermost voxels, (n,).

    Parameters
    ----------
    places : array (n, m, 3) int32
        The outermost voxels.
    spacing : array (3,) float64
        Sizes of a voxel, which counts as the ellipsoid within it: it is as long as it is along its sides.
    """
    found = np.empty(places.shape[0])
    for label in range(places.shape[0]):
        z, y, x = farthest(places[label], spacing)
        square = z * z + y * y + x * x
        thick = (z * spacing[0]) ** 2 + (y * spacing[1]) ** 2 + (x * spacing[2]) ** 2
        found[label] = np.sqrt(square) + np.sqrt(thick / square) if square else spacing.max()
    return found


@compiled
def farthest(points: Array, spacing: Array) -> tuple[float, float, float]:
    """Return how far apart the two are that are farthest apart, along z, y and x."""
    longest, best = -1.0, (0.0, 0.0, 0.0)
    for i in range(points.shape[0]):
        z, y, x = points[i, 0] * spacing[0], points[i, 1] * spacing[1], points[i, 2] * spacing[2]
        for j in range(i + 1):
            dz, dy, dx = z - points[j, 0] * spacing[0], y - points[j, 1] * spacing[1], x - points[j, 2] * spacing[2]
            square = dz * dz + dy * dy + dx * dx
            if square > longest:
                longest, best = square, (dz, dy, dx)
    return best
