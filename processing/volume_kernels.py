"""Compiled loops of the volume filters: each works on whole rows, so that the compiler makes vector instructions.

All take (z, y, x) arrays and repeat the outermost voxels beyond the border. Slow twins that they must equal stand
with the tests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.compiled import compiled

if TYPE_CHECKING:
    Array = np.ndarray[Any, Any]


@compiled
def row_at(volume: Array, z: int, y: int) -> Array:
    """Return a row of the volume; outside, the nearest one."""
    row: Array = volume[min(max(z, 0), volume.shape[0] - 1), min(max(y, 0), volume.shape[1] - 1)]
    return row


@compiled
def pad_row(row: Array, reach: int, padded: Array) -> None:
    """Copy a row into the middle of ``padded`` and repeat its ends ``reach`` times."""
    n = row.size
    copy_row(row, padded[reach : reach + n])
    for x in range(reach):
        padded[x] = row[0]
        padded[reach + n + x] = row[n - 1]


@compiled
def copy_row(row: Array, into: Array) -> None:
    """Copy a row; as a loop, since an assignment of slices first looks whether they overlap."""
    for x in range(row.size):
        into[x] = row[x]


@compiled
def exchange(low: Array, high: Array) -> None:
    """Bring the smaller of each two numbers into ``low``, the larger into ``high``."""
    for x in range(low.size):
        a, b = low[x], high[x]
        low[x] = min(b, a)
        high[x] = max(a, b)


@compiled
def rank_rows(volume: Array, offsets: Array, pairs: Array, chosen: int, out: Array) -> None:
    """Put the value of rank ``chosen`` among the neighbours into ``out``.

    Parameters
    ----------
    offsets : array (m, 3) int64
        The neighbours.
    pairs : array (n, 2) int64
        Exchanges after which place ``chosen`` holds the answer.
    """
    nz, ny, nx = volume.shape
    reach = np.abs(offsets[:, 2]).max()
    padded = np.empty(nx + 2 * reach, volume.dtype)
    work = np.empty((offsets.shape[0], nx), volume.dtype)
    for z in range(nz):
        for y in range(ny):
            for k in range(offsets.shape[0]):
                pad_row(row_at(volume, z + offsets[k, 0], y + offsets[k, 1]), reach, padded)
                copy_row(padded[reach + offsets[k, 2] : reach + offsets[k, 2] + nx], work[k])
            for c in range(pairs.shape[0]):
                exchange(work[pairs[c, 0]], work[pairs[c, 1]])
            copy_row(work[chosen], out[z, y])


@compiled
def fold(into: Array, row: Array, largest: bool) -> None:  # noqa: FBT001  compiled code takes no keywords
    """Keep the larger, or the smaller, of two rows in ``into``."""
    if largest:
        for x in range(row.size):
            into[x] = max(into[x], row[x])
    else:
        for x in range(row.size):
            into[x] = min(into[x], row[x])


@compiled
def extreme_rows(volume: Array, rows: Array, largest: bool, out: Array) -> None:  # noqa: FBT001
    """Put the largest or smallest value among the neighbours into ``out``: grey dilation or erosion.

    A run of reach r is spread r times by one voxel to both sides, together with all longer ones.
    """
    nz, ny, nx = volume.shape
    longest = rows[0, 2]
    row, padded = np.empty(nx, volume.dtype), np.empty(nx + 2, volume.dtype)
    for z in range(nz):
        for y in range(ny):
            copy_row(row_at(volume, z + rows[0, 0], y + rows[0, 1]), row)
            for reach in range(longest, -1, -1):
                for k in range(rows.shape[0]):
                    if rows[k, 2] == reach:
                        fold(row, row_at(volume, z + rows[k, 0], y + rows[k, 1]), largest)
                if reach:
                    pad_row(row, 1, padded)
                    fold(row, padded[:nx], largest)
                    fold(row, padded[2:], largest)
            copy_row(row, out[z, y])


@compiled
def sobel_rows(volume: Array, scale: Array, out: Array) -> None:
    """Put the Sobel gradient into ``out`` (3, z, y, x) float32: along z, y and x, each times its ``scale``."""
    nz, ny, nx = volume.shape
    padded = np.zeros((3, nx + 2), np.float32)
    for z in range(nz):
        for y in range(ny):
            sobel_across(volume, z, y, padded)
            for axis in range(2):
                line, factor = padded[axis], scale[axis]
                left, middle, right = line[:nx], line[1 : nx + 1], line[2:]
                for x in range(nx):
                    out[axis, z, y, x] = (left[x] + middle[x] + middle[x] + right[x]) * factor
            left, right = padded[2, :nx], padded[2, 2:]
            for x in range(nx):
                out[2, z, y, x] = (right[x] - left[x]) * scale[2]


@compiled
def sobel_across(volume: Array, z: int, y: int, padded: Array) -> None:
    """Combine the nine rows around a row: difference along z, difference along y, and their smooth sum."""
    nx = volume.shape[2]
    dz, dy, smooth = padded[0, 1:-1], padded[1, 1:-1], padded[2, 1:-1]
    padded[:] = 0
    for a in range(-1, 2):
        for b in range(-1, 2):
            row = row_at(volume, z + a, y + b)
            along_z, along_y = np.float32(a * (2 - abs(b))), np.float32(b * (2 - abs(a)))
            even = np.float32((2 - abs(a)) * (2 - abs(b)))
            for x in range(nx):
                value = np.float32(row[x])
                dz[x] += along_z * value
                dy[x] += along_y * value
                smooth[x] += even * value
    padded[:, 0] = padded[:, 1]
    padded[:, nx + 1] = padded[:, nx]


@compiled
def sobel_magnitude_rows(volume: Array, scale: Array, out: Array) -> None:
    """Put the length of the Sobel gradient into ``out`` (z, y, x) float32."""
    nz, ny, nx = volume.shape
    padded = np.zeros((3, nx + 2), np.float32)
    for z in range(nz):
        for y in range(ny):
            sobel_across(volume, z, y, padded)
            zs, ys, xs, line = padded[0], padded[1], padded[2], out[z, y]
            for x in range(nx):
                gz = (zs[x] + zs[x + 1] + zs[x + 1] + zs[x + 2]) * scale[0]
                gy = (ys[x] + ys[x + 1] + ys[x + 1] + ys[x + 2]) * scale[1]
                gx = (xs[x + 2] - xs[x]) * scale[2]
                line[x] = np.sqrt(gz * gz + gy * gy + gx * gx)


@compiled
def moment_rows(volume: Array, rows: Array, zero: Array, out: Array) -> None:
    """Put the variance of the neighbours into ``out`` (z, y, x) float32.

    ``zero`` is an array of one number of the type the sums are kept in: one that holds them exactly, int32 for 8 bits
    and float64 otherwise, so that nothing cancels.
    """
    nz, ny, nx = volume.shape
    count = zero.dtype.type(np.sum(2 * rows[:, 2] + 1))
    run, squares = np.empty(nx, zero.dtype), np.empty(nx, zero.dtype)
    total, total_squares = np.empty(nx, zero.dtype), np.empty(nx, zero.dtype)
    padded = np.empty(nx + 2 * rows[0, 2], zero.dtype)
    share = np.float32(1) / np.float32(count) / np.float32(count)
    reaches = np.unique(rows[:, 2])
    for z in range(nz):
        for y in range(ny):
            total[:], total_squares[:] = 0, 0
            for reach in reaches:
                sum_runs(volume, z, y, rows, reach, run, squares)
                spread(run, reach, padded, total)
                spread(squares, reach, padded, total_squares)
            for x in range(nx):
                out[z, y, x] = np.float32(count * total_squares[x] - total[x] * total[x]) * share


@compiled
def box_moment_rows(volume: Array, zero: Array, out: Array) -> None:
    """As `moment_rows` for the 26 neighbours: each row's sums along z serve the three rows around it."""
    nz, ny, nx = volume.shape
    sums, squares = np.empty((3, nx), zero.dtype), np.empty((3, nx), zero.dtype)
    run, run_squares = np.empty(nx + 2, zero.dtype), np.empty(nx + 2, zero.dtype)
    for z in range(nz):
        for y in range(-1, ny + 1):
            add_along_z(row_at(volume, z - 1, y), row_at(volume, z, y), row_at(volume, z + 1, y),
                        sums[(y + 1) % 3], squares[(y + 1) % 3])  # fmt: skip
            if y > 0:
                add_three(sums[0], sums[1], sums[2], run)
                add_three(squares[0], squares[1], squares[2], run_squares)
                write_moments(run, run_squares, out[z, y - 1])


@compiled
def add_along_z(above: Array, row: Array, below: Array, total: Array, squares: Array) -> None:
    """Add up three rows, and their squares."""
    kind = total.dtype.type
    for x in range(row.size):
        a, b, c = kind(above[x]), kind(row[x]), kind(below[x])
        total[x] = a + b + c
        squares[x] = a * a + b * b + c * c


@compiled
def add_three(one: Array, two: Array, three: Array, padded: Array) -> None:
    """Add up three rows and repeat the ends."""
    n = one.size
    middle = padded[1 : n + 1]
    for x in range(n):
        middle[x] = one[x] + two[x] + three[x]
    padded[0], padded[n + 1] = padded[1], padded[n]


@compiled
def write_moments(run: Array, run_squares: Array, out: Array) -> None:
    """Write the variance of 27 voxels from sums over nine."""
    share, kind = np.float32(1 / 27) / np.float32(27), run.dtype.type
    for x in range(out.size):
        total = kind(run[x] + run[x + 1] + run[x + 2])
        total_squares = kind(run_squares[x] + run_squares[x + 1] + run_squares[x + 2])
        # kept in its type: the compiler would widen it, and there is no quick way from there to float32
        out[x] = np.float32(kind(kind(27) * total_squares - total * total)) * share


@compiled
def sum_runs(volume: Array, z: int, y: int, rows: Array, reach: int, run: Array, squares: Array) -> None:
    """Add up the rows of one reach, and their squares."""
    run[:], squares[:] = 0, 0
    for k in range(rows.shape[0]):
        if rows[k, 2] == reach:
            row = row_at(volume, z + rows[k, 0], y + rows[k, 1])
            for x in range(run.size):
                value = run.dtype.type(row[x])
                run[x] += value
                squares[x] += value * value


@compiled
def spread(run: Array, reach: int, padded: Array, total: Array) -> None:
    """Add to ``total`` the sum of ``run`` over ``reach`` voxels to both sides."""
    n = run.size
    pad_row(run, reach, padded)
    for shift in range(2 * reach + 1):
        part = padded[shift : shift + n]
        for x in range(n):
            total[x] += part[x]


@compiled
def frei_chen_rows(volume: Array, offsets: Array, edges: Array, lines: Array) -> None:
    """Put the shares of antisymmetric and of symmetric structure among 27 neighbours into two (z, y, x) float32.

    ``offsets`` are 13 of the 26 neighbours, no two of them opposite.
    """
    nz, ny, nx = volume.shape
    middle, odd = np.empty(nx, np.float32), np.empty(nx, np.float32)
    total, squares = np.empty(nx, np.float32), np.empty(nx, np.float32)
    here, there = np.empty(nx + 2, volume.dtype), np.empty(nx + 2, volume.dtype)
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                middle[x] = volume[z, y, x]
            total[:], squares[:], odd[:] = 0, 0, 0
            for k in range(offsets.shape[0]):
                dz, dy, dx = offsets[k]
                pad_row(row_at(volume, z + dz, y + dy), 1, here)
                pad_row(row_at(volume, z - dz, y - dy), 1, there)
                ahead, behind = here[1 + dx : 1 + dx + nx], there[1 - dx : 1 - dx + nx]
                for x in range(nx):  # counted from the middle voxel: nothing cancels
                    a, b = np.float32(ahead[x]) - middle[x], np.float32(behind[x]) - middle[x]
                    total[x] += a + b
                    squares[x] += a * a + b * b
                    odd[x] += (a - b) * (a - b)
            for x in range(nx):
                spent = squares[x] - total[x] * total[x] / np.float32(27)
                flat = spent <= np.float32(1e-6) * squares[x] or squares[x] == 0
                edge = np.float32(0) if flat else min(odd[x] / (spent + spent), np.float32(1))
                edges[z, y, x] = np.sqrt(edge)
                lines[z, y, x] = np.float32(0) if flat else np.sqrt(np.float32(1) - edge)


@compiled
def entropy_rows(levels: Array, rows: Array, information: Array, out: Array) -> None:
    """Put the entropy of the neighbours in bits into ``out`` (z, y, x) float32.

    Parameters
    ----------
    levels : array (z, y, x) uint8
        Grey levels.
    information : array (m + 1,) float64
        c·log2(c) of every count c.
    """
    nz, ny, nx = levels.shape
    count = information.size - 1
    histogram = np.zeros(256, np.int64)
    for z in range(nz):
        for y in range(ny):
            histogram[:] = 0
            spent = 0.0
            for k in range(rows.shape[0]):
                row = row_at(levels, z + rows[k, 0], y + rows[k, 1])
                for x in range(-rows[k, 2], rows[k, 2] + 1):
                    level = row[min(max(x, 0), nx - 1)]
                    spent += information[histogram[level] + 1] - information[histogram[level]]
                    histogram[level] += 1
            for x in range(nx):
                out[z, y, x] = np.log2(count) - spent / count
                for k in range(rows.shape[0]):
                    row = row_at(levels, z + rows[k, 0], y + rows[k, 1])
                    gone = row[min(max(x - rows[k, 2], 0), nx - 1)]
                    spent -= information[histogram[gone]] - information[histogram[gone] - 1]
                    histogram[gone] -= 1
                    come = row[min(max(x + rows[k, 2] + 1, 0), nx - 1)]
                    spent += information[histogram[come] + 1] - information[histogram[come]]
                    histogram[come] += 1
