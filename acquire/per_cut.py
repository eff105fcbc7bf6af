"""A length for each cut of a run: one for all, or ranges of cuts, counted from 1: ``"1-20: 100, 21-: 50"``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

EXAMPLE = '"1-20: 100, 21-: 50"'
_RANGE = re.compile(r"(\d+)\s*(?:(-)\s*(\d*))?\s*:(.*)")


@dataclass(frozen=True)
class Range:
    """The same for all cuts from ``first`` to ``last``, both included; None: to the last cut of the run."""

    first: int
    last: int | None
    nm: float

    def __post_init__(self) -> None:
        if not (self.nm > 0 and math.isfinite(self.nm)):
            raise ValueError(f"should be above 0 nm, not {self.nm:g}{self._where}")
        if self.first < 1:
            raise ValueError("cuts are counted from 1")
        if self.last is not None and self.last < self.first:
            raise ValueError(f"{self.first}-{self.last} ends before it begins")

    @property
    def _where(self) -> str:
        return "" if (self.first, self.last) == (1, None) else f" from cut {self.first} on"

    def __str__(self) -> str:
        cuts = str(self.first) if self.last == self.first else f"{self.first}-{self.last or ''}"
        return f"{cuts}: {self.nm:.12g}"

    def first_cuts(self, cuts: int) -> int:
        """Return how many of the first ``cuts`` cuts of a run lie in this range."""
        return max(0, (cuts if self.last is None else min(cuts, self.last)) - self.first + 1)


@dataclass(frozen=True)
class PerCut:
    """Ranges that follow one another from the first cut on; raises `ValueError` if they do not."""

    ranges: tuple[Range, ...]

    def __post_init__(self) -> None:
        if self.ranges[0].first != 1:
            raise ValueError(f"{_cuts(1, self.ranges[0].first - 1)} in no range")
        for before, after in pairwise(self.ranges):
            if before.last is None or before.last >= after.first:
                raise ValueError(f"cut {after.first} is in two ranges")
            if before.last + 1 < after.first:
                raise ValueError(f"{_cuts(before.last + 1, after.first - 1)} in no range")

    def __str__(self) -> str:
        return str(self.told) if isinstance(self.told, str) else f"{self.told:.12g}"

    @property
    def told(self) -> float | str:
        """As it is written in a file: a number for all cuts alike, else the ranges."""
        only = self.ranges[0]
        return only.nm if only.last is None else ", ".join(map(str, self.ranges))

    @property
    def cuts(self) -> int | None:
        """How many cuts there are ranges for; None without end."""
        return self.ranges[-1].last

    @property
    def extremes_nm(self) -> tuple[float, float]:
        """The least and the greatest."""
        lengths_nm = [part.nm for part in self.ranges]
        return min(lengths_nm), max(lengths_nm)

    def each(self, change: Callable[[float], int]) -> PerCut:
        """Return the same ranges with another length each."""
        return PerCut(tuple(Range(part.first, part.last, change(part.nm)) for part in self.ranges))

    def nm(self, cut: int) -> float:
        """Return the length for a cut; the first is 1."""
        return next(part.nm for part in reversed(self.ranges) if part.first <= cut)

    def total_nm(self, cuts: int) -> float:
        """Return the sum over the first cuts."""
        return sum(part.first_cuts(cuts) * part.nm for part in self.ranges)

    def cuts_within(self, depth_nm: float) -> int:
        """Return how many of the first cuts go into a depth.

        Raises
        ------
        ValueError
            The ranges end before it is reached.
        """
        cuts = 0
        for part in self.ranges:
            fit = int((depth_nm - self.total_nm(cuts)) // part.nm)
            if part.last is None or cuts + fit < part.last:
                return cuts + fit
            cuts = part.last
        if self.total_nm(cuts) < depth_nm:
            raise ValueError(
                f"the ranges end at cut {cuts}, {self.total_nm(cuts) / 1000:g} µm deep, before {depth_nm / 1000:g} µm "
                f"are reached: let the last go on, {self.ranges[-1].first}-"
            )
        return cuts

    def check(self, cuts: int) -> None:
        """Raise `ValueError` unless the ranges are those of a run of that many cuts."""
        if self.cuts is not None and self.cuts < cuts:
            raise ValueError(f"{_cuts(self.cuts + 1, cuts)} in no range: let the last go on, {self.ranges[-1].first}-")
        beyond = self.ranges[-1].first if self.cuts is None else self.cuts
        if isinstance(self.told, str) and beyond > cuts:
            raise ValueError(f"there is a range for cut {beyond}, but the run makes {cuts} cuts")


def per_cut(told: object) -> PerCut:
    """Return what a file or a person says: a number, or ranges such as ``1-20: 100, 21-: 50``; undone by `PerCut.told`.

    Raises
    ------
    ValueError
        In words: it is neither, a length is not above zero, or the ranges leave out a cut or have it twice.
    """
    match told:
        case PerCut():
            return told
        case str() if ":" in told:
            return PerCut(tuple(sorted(map(_range, told.split(",")), key=lambda part: part.first)))
        case str():
            return PerCut((Range(1, None, _number(told)),))
        case int() | float() if not isinstance(told, bool):
            return PerCut((Range(1, None, told),))
        case _:
            raise ValueError(f"should be a number of nm, or ranges such as {EXAMPLE}")


def _range(text: str) -> Range:
    found = _RANGE.fullmatch(text.strip())
    if not found:
        raise ValueError(f"'{text.strip()}' is no range of cuts; write for example {EXAMPLE}")
    first, dash, last, nm = found.groups()
    end = int(last) if last else None if dash else int(first)
    return Range(int(first), end, _number(nm))


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise ValueError(f"'{text.strip()}' is no number of nm; write for example {EXAMPLE}") from None
    return int(number) if number.is_integer() else number


def _cuts(first: int, last: int) -> str:
    return f"cut {first} is" if first == last else f"cuts {first}-{last} are"
