"""Connected parts that go on from one slab of planes to the next."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from processing.labels import checked_rule, components

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from processing.neighbours import Rule

    Array = NDArray[Any]

REACH = {6: 0, 18: 1, 26: 2}  # steps within the plane that a neighbour in the next plane may be away


def touching(upper: Array, lower: Array, rule: int, values: Sequence[Array] | None = None) -> Array:
    """Return the pairs of labels, (n, 2), that touch across two planes; with ``values``, where those are equal."""
    pairs = [np.unique(one.astype(np.uint64) << 32 | other) for one, other in _neighbours(upper, lower, rule, values)]
    both = np.unique(np.concatenate(pairs))
    return np.stack([both >> 32, both & 0xFFFFFFFF], axis=1).astype(np.int64)


def _neighbours(upper: Array, lower: Array, rule: int, values: Sequence[Array] | None) -> Iterator[tuple[Array, Array]]:
    reach = REACH[checked_rule(rule)]
    for dy, dx in product((-1, 0, 1), repeat=2):
        if abs(dy) + abs(dx) > reach:
            continue
        here = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip((dy, dx), upper.shape, strict=True))
        there = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip((dy, dx), upper.shape, strict=True))
        one, other = upper[here], lower[there]
        touch = (one > 0) & (other > 0)
        if values is not None:
            touch &= values[0][here] == values[1][there]
        yield one[touch], other[touch]


def joined(count: int, pairs: Sequence[Array]) -> tuple[int, Array]:
    """Return how many there are of ``count`` once pairs, each (n, 2), are one; and the new number of each."""
    if not count:
        return 0, np.empty(0, np.int64)
    both = np.concatenate([np.empty((0, 2), np.int64), *pairs])
    links = coo_array((np.ones(len(both), bool), (both[:, 0], both[:, 1])), (count, count))
    parts, numbers = connected_components(links, directed=False)
    return int(parts), numbers


class Parts:
    """The parts of a mask, counted as its slabs come."""

    def __init__(self, rule: Rule) -> None:
        self._rule = rule
        self._begin = self._count = 0
        self._last: Array | None = None
        self._pairs: list[Array] = []
        self._open: list[Array] = []

    def add(self, mask: NDArray[np.bool_]) -> None:
        """Take the next slab."""
        labels, found = components(mask, rule=self._rule)
        begin, self._count = self._count, self._count + int(found)
        if self._last is None:
            self._leave_open(labels[0], begin)
        else:
            self._pairs.append(touching(self._last, labels[0], self._rule) - 1 + [self._begin, begin])
        self._leave_open(labels[:, [0, -1]], begin)
        self._leave_open(labels[:, :, [0, -1]], begin)
        self._begin, self._last = begin, labels[-1]

    def _leave_open(self, side: Array, begin: int) -> None:
        there = np.unique(side)
        self._open.append(there[there > 0] - 1 + np.int64(begin))

    def total(self) -> tuple[int, int]:
        """Return how many there are, and how many of them the border of the volume does not touch."""
        parts, numbers = joined(self._count, self._pairs)
        if self._last is not None:
            self._leave_open(self._last, self._begin)
        at_border = np.concatenate([np.empty(0, np.int64), *self._open])
        return parts, parts - np.unique(numbers[at_border]).size
