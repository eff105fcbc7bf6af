"""The maps of all sections from the maps of pairs: robust linear least squares with a banded solution.

The unknowns are the six numbers of every section's map A_k from the block to the section. A pair gives
A_j = M_ij A_i, a section with known marks A_j = M. Residuals are displacements in pixels over the section; pairs that
the others contradict lose their say (iteratively reweighted least squares, Geman and McClure's weights).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.align_models import about_centre, distance_px, in_pixels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

ROUNDS = 15
TOLERANCE_PX = 0.5  # disagreement from which a row loses its say, at least
SPREAD = np.sqrt(np.array([0.16, 0.16, 1.0] * 2))  # of the coordinates x, y, 1 over the section's middle
HELD = 1e6  # weight of the one section that stays
LOOSE = 1e-7  # weight that places a section nothing else places next to the one before


@dataclass(frozen=True)
class Row:
    """A pair's map, or with ``first`` None a section's map known absolutely.

    Attributes
    ----------
    first, second : int
        Sections.
    matrix : array (3, 3)
        From pixels of the first section, or of the block, to those of the second.
    weight : float
        Say in the solution, before what the others think of it.
    sigma_px : float
        Error of an absolute row.
    """

    first: int | None
    second: int
    matrix: Array
    weight: float
    sigma_px: float = 0.0


def solve(count: int, rows: Sequence[Row], shape: tuple[int, ...]) -> list[Array]:
    """Return the map of every section, from block to section pixels.

    Parameters
    ----------
    count : int
        Number of sections.
    rows : sequence of Row
        With at least one absolute row.
    shape : tuple of int
        Height and width of the sections.
    """
    inside = [(row, about_centre(row.matrix, shape)) for row in rows]
    say = np.ones(len(rows))
    found = np.zeros((count, 6))
    for _ in range(ROUNDS):
        before, found = found, _least_squares(count, inside, say)
        off = np.array([_disagreement_px(row, found, shape) for row in rows])
        limit = max(TOLERANCE_PX, 3 * float(np.median(off)))
        say = 1 / (1 + (off / limit) ** 2) ** 2
        if np.abs(found - before).max() < 1e-9:
            break
    return [in_pixels(_matrix(six), shape) for six in found]


def _matrix(six: Array) -> Array:
    return np.vstack([six.reshape(2, 3), [0, 0, 1]])


def _disagreement_px(row: Row, found: Array, shape: tuple[int, ...]) -> float:
    second = in_pixels(_matrix(found[row.second]), shape)
    if row.first is None:
        return 0.0  # marks are not put to the vote
    return distance_px(row.matrix @ in_pixels(_matrix(found[row.first]), shape), second, shape)


def _least_squares(count: int, rows: Sequence[tuple[Row, Array]], say: Array) -> Array:
    """Solve A_second − M A_first = 0 for all rows, and A_k = A_{k−1} with hardly any weight."""
    reach = max([row.second - row.first for row, _ in rows if row.first is not None], default=1)
    banded = Banded(count, reach)
    for (row, matrix), factor in zip(rows, say, strict=True):
        banded.add(row.first, row.second, matrix, row.weight * factor * (HELD if row.first is None else 1))
    for k in range(1, count):
        banded.add(k - 1, k, np.eye(3), LOOSE)
    return banded.solution()


class Banded:
    """Normal equations whose unknowns, six for each section, are tied to near sections only."""

    def __init__(self, count: int, reach: int) -> None:
        self.count, self.group = count, 6 * reach
        self.groups = -(-count // reach)
        self.diagonal = np.zeros((self.groups, self.group, self.group))
        self.upper = np.zeros((self.groups, self.group, self.group))
        self.right = np.zeros((self.groups, self.group))

    def add(self, first: int | None, second: int, matrix: Array, weight: float) -> None:
        """Add the row A_second − M A_first, or A_second − M, with a weight."""
        root = np.sqrt(weight) * SPREAD
        own = np.diag(root)
        known = np.zeros(6)
        known[[2, 5]] = matrix[:2, 2]
        if first is None:
            self._block(second, second, own.T @ own)
            self._right(second, own.T @ (root * matrix[:2].ravel()))
            return
        other = -root[:, None] * np.kron(matrix[:2, :2], np.eye(3))
        self._block(second, second, own.T @ own)
        self._block(first, first, other.T @ other)
        self._block(first, second, other.T @ own)
        self._right(second, own.T @ (root * known))
        self._right(first, other.T @ (root * known))

    def _place(self, k: int) -> tuple[int, slice]:
        group, within = divmod(6 * k, self.group)
        return group, slice(within, within + 6)

    def _block(self, i: int, j: int, block: Array) -> None:
        (group_i, at_i), (group_j, at_j) = self._place(i), self._place(j)
        if group_i == group_j:
            self.diagonal[group_i, at_i, at_j] += block
            if i != j:
                self.diagonal[group_i, at_j, at_i] += block.T
        else:
            self.upper[group_i, at_i, at_j] += block

    def _right(self, k: int, part: Array) -> None:
        group, at = self._place(k)
        self.right[group, at] += part

    def solution(self) -> Array:
        """Solve by block elimination; (count, 6)."""
        spare = self.groups * self.group - 6 * self.count
        if spare:
            self.diagonal[-1][-spare:, -spare:] = np.eye(spare)
        for k in range(1, self.groups):
            carried = np.linalg.solve(self.diagonal[k - 1], self.upper[k - 1]).T
            self.diagonal[k] -= carried @ self.upper[k - 1]
            self.right[k] -= carried @ self.right[k - 1]
        found = np.zeros_like(self.right)
        for k in reversed(range(self.groups)):
            later = self.upper[k] @ found[k + 1] if k + 1 < self.groups else 0.0
            found[k] = np.linalg.solve(self.diagonal[k], self.right[k] - later)
        return np.asarray(found.reshape(-1, 6)[: self.count])
