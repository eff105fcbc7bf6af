"""Floods of a mask from one voxel, 64 voxels of a row at a time.

A row along x is kept as the bits of 64-bit words, the first voxel in the lowest bit. All runs of a row that hold a
flooded voxel are filled at once: upwards by the carry of one addition, downwards by doubling distances.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from processing.compiled import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.neighbours import Rule

    Words = NDArray[np.uint64]

WORD = 64
ZERO, ONE, TOP = np.uint64(0), np.uint64(1), np.uint64(WORD - 1)
DOUBLING = tuple(np.uint64(1 << k) for k in range(6))


def flooded(inside: NDArray[np.bool_], seed: tuple[int, int, int], rule: Rule) -> NDArray[np.bool_]:
    """Return the part of a mask that is joined to one of its voxels.

    Parameters
    ----------
    inside : array (z, y, x) bool
        The mask; the seed lies inside.
    seed : tuple of int
        z, y, x of the voxel.
    rule : 6, 18 or 26
        Which neighbours are joined.
    """
    rows = _to_words(inside)
    reached = np.zeros_like(rows)
    z, y, x = seed
    reached[z, y, x // WORD] = ONE << np.uint64(x % WORD)
    _flood(rows, reached, z, y, rule)
    bits = np.unpackbits(reached.view(np.uint8), axis=-1, count=inside.shape[2], bitorder="little")
    return bits.view(np.bool_)


def _to_words(inside: NDArray[np.bool_]) -> Words:
    packed = np.packbits(inside, axis=-1, bitorder="little")
    depth, height, used = packed.shape
    padded = np.zeros((depth, height, -(-used // 8) * 8), np.uint8)
    padded[..., :used] = packed
    return padded.view(np.uint64)


@compiled
def _flood(rows: Words, reached: Words, z: int, y: int, rule: int) -> None:
    """Spread what is reached from one row, in place: rows that gained voxels wait in a queue, each once."""
    depth, height, words = rows.shape
    waiting = np.empty(depth * height, np.int64)
    waits = np.zeros(depth * height, np.bool_)
    wider = np.empty(words, np.uint64)
    waiting[0], first, count = z * height + y, 0, 1
    while count:
        z, y = divmod(waiting[first], height)
        waits[waiting[first]] = False
        first, count = (first + 1) % waiting.size, count - 1
        _fill_runs(rows[z, y], reached[z, y])
        if rule != 6:
            _widen(reached[z, y], wider)
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                away = abs(dz) + abs(dy)
                other_z, other_y = z + dz, y + dy
                if away == 0 or (rule == 6 and away == 2) or not (0 <= other_z < depth and 0 <= other_y < height):
                    continue
                aslant = rule == 26 or (rule == 18 and away == 1)
                gained = _gains(wider if aslant else reached[z, y], rows[other_z, other_y], reached[other_z, other_y])
                other = other_z * height + other_y
                if gained and not waits[other]:
                    waits[other] = True
                    waiting[(first + count) % waiting.size] = other
                    count += 1


@compiled
def _fill_runs(row: Words, reached: Words) -> None:
    """Reach every run of a row of which a voxel is reached, in place."""
    carry = ZERO
    for k in range(row.size):
        start = reached[k] | (row[k] & carry)
        reached[k] = (row[k] & ~(row[k] + start)) | start
        carry = reached[k] >> TOP
    carry = ZERO
    for k in range(row.size - 1, -1, -1):
        run, found = row[k], reached[k] | (row[k] & (carry << TOP))
        for step in DOUBLING:
            found |= run & (found >> step)
            run &= run >> step
        reached[k] = found
        carry = found & ONE


@compiled
def _widen(row: Words, wider: Words) -> None:
    """Put a row, each voxel with its neighbours along x, into ``wider``."""
    for k in range(row.size):
        below = row[k - 1] >> TOP if k > 0 else ZERO
        above = row[k + 1] << TOP if k + 1 < row.size else ZERO
        wider[k] = row[k] | (row[k] << ONE) | below | (row[k] >> ONE) | above


@compiled
def _gains(offered: Words, row: Words, reached: Words) -> bool:
    """Reach what is offered to a row and inside, in place; return whether anything of it is new."""
    gained = False
    for k in range(row.size):
        new = offered[k] & row[k] & ~reached[k]
        if new:
            reached[k] |= new
            gained = True
    return gained
