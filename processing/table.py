"""What operators give besides arrays and numbers: tables, written as CSV, and pictures, written as PNG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Table:
    """Rows under names.

    Attributes
    ----------
    columns : tuple of str
        Names, with units.
    rows : tuple of tuples
        Numbers and words.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[object, ...], ...]

    def column(self, name: str) -> list[object]:
        """Return the values under a name."""
        return [row[self.columns.index(name)] for row in self.rows]


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels to be looked at.

    Attributes
    ----------
    pixels : array (h, w, 3) uint8
        RGB.
    """

    pixels: NDArray[np.uint8]
