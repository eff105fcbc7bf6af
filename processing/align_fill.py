"""Sections that show nothing of use, drawn from their neighbours: only when asked for, and marked as such.

What is made is for looking: it says nothing about the specimen that its neighbours do not say already.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.align_stack import Alignment

    Array = NDArray[Any]

SPOILT = frozenset({"blank", "unmatched", "damaged"})
MADE = "interpolated"


class Bridge(NamedTuple):
    """The sections before and after, and the share of the one after."""

    before: int
    after: int
    share: float


def bridges(alignment: Alignment, z_um: Array | None) -> dict[int, Bridge]:
    """Return for every spoilt section between two sound ones what it may be drawn from; others stay as they are.

    Parameters
    ----------
    alignment : Alignment
        With the flags of its sections.
    z_um : array (sections,), optional
        Positions; evenly spaced when unknown.
    """
    place = np.arange(len(alignment.sections), dtype=np.float64) if z_um is None else np.asarray(z_um, np.float64)
    sound = [s.index for s in alignment.sections if not SPOILT & {*s.flags}]
    found = {}
    for k in {*range(len(place))} - {*sound}:
        before, after = max((i for i in sound if i < k), default=None), min((i for i in sound if i > k), default=None)
        if before is not None and after is not None:
            found[k] = Bridge(before, after, float((place[k] - place[before]) / (place[after] - place[before])))
    return found


def blended(before: Array, after: Array, share: float) -> Array:
    """Return (1 − share) before + share after, 0 where one of them shows nothing; type as given."""
    made = cv2.addWeighted(before, 1 - share, after, share, 0)
    seen = (before != 0) & (after != 0)
    return np.asarray(np.where(seen, made, 0).astype(before.dtype))


def marked(alignment: Alignment, made: dict[int, Bridge]) -> Alignment:
    """Return the alignment with its interpolated sections flagged as such."""
    sections = [replace(s, flags=(*s.flags, MADE)) if s.index in made else s for s in alignment.sections]
    return replace(alignment, sections=tuple(sections))
