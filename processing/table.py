"""A table, as an operator gives it: written as CSV."""

from __future__ import annotations

from dataclasses import dataclass


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
