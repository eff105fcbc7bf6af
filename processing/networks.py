"""Networks that select one rank of a few numbers by exchanges alone, so that a whole row is sorted at once."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Pair = tuple[int, int]


def sorting_pairs(count: int) -> list[Pair]:
    """Return the exchanges that sort ``count`` numbers: odd-even merge sort (Batcher 1968), cut to ``count``.

    Numbers that would stand beyond the end count as infinite; exchanges with them change nothing and are left out.
    """
    size = 1 << max(0, count - 1).bit_length()
    pairs: list[Pair] = []
    width = 1
    while width < size:
        step = width
        while step:
            for start in range(step % width, size - step, 2 * step):
                lows = range(start, min(start + step, size - step))
                pairs += [(i, i + step) for i in lows if i // (2 * width) == (i + step) // (2 * width)]
            step //= 2
        width *= 2
    return [pair for pair in pairs if pair[1] < count]


@cache
def selecting_pairs(count: int, rank: int) -> NDArray[np.int64]:
    """Return the exchanges after which number ``rank`` (from 0, ascending) stands in place ``rank``.

    Returns
    -------
    array (n, 2) int64
        Each row (low, high): the smaller of the two goes to ``low``. For 27 numbers and the median 126 rows.
    """
    needed, kept = {rank}, []
    for pair in reversed(sorting_pairs(count)):
        if needed.intersection(pair):
            needed.update(pair)
            kept.append(pair)
    return np.array(kept[::-1], np.int64).reshape(-1, 2)
