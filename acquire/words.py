"""Numbers in words, as messages and reports write them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def ranges(numbers: Sequence[int]) -> str:
    """Return sorted whole numbers in words: ``0-2, 7``."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ", ".join("-".join(map(str, part)) for part in parts)


def took(seconds: float) -> str:
    """Return a time in words: ``4.2 s``, ``12 min``, ``2 h 05 min``."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"


def spanned(low: float, high: float) -> str:
    """Return both ends in words, with four digits of what lies between them: ``76319.87 … 76358.12``."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return f"{low:.4g} … {high:.4g}"
    digits = min(max(3 - math.floor(math.log10(span)), 0), 12)
    return f"{low:.{digits}f} … {high:.{digits}f}"
