"""How deep the faces of a run of sections lie: as the feed read back, or as planned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.per_cut import per_cut

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.per_cut import PerCut
    from acquire.store import StoredRun


def depths_nm(run: StoredRun, sections: Sequence[int]) -> tuple[NDArray[np.float64] | None, list[str]]:
    """Return how deep each face lies, and in words how that is known; None if nothing is known of it.

    What the feed read back goes before the planned thickness, unless it is missing for a section or does not rise.
    """
    thickness_nm = planned_nm(run)
    read: dict[int, float] = {}
    for record in run.records:
        if record["e"] == "origin":
            read[0] = record["depth_nm"]  # of a face that is imaged as it is; one that is removed first is fed, below
        elif record["e"] == "feed_done":
            read[record["section"]] = record["readback_nm"]
    if all(section in read for section in sections):
        depth_nm = np.array([read[section] for section in sections], float)
        if (np.diff(depth_nm) > 0).all():
            return depth_nm, [f"the planes are sections, as far apart as the feed read back{_uneven(thickness_nm)}."]
    if thickness_nm is None:
        return None, ["the planes are sections of unknown thickness."]
    return planned_depths_nm(run, sections), [f"the planes are sections, {thickness_nm} nm apart as planned."]


def _uneven(thickness_nm: PerCut | None) -> str:
    even = thickness_nm is None or len(thickness_nm.ranges) == 1
    return "" if even else f", unevenly, as planned: {thickness_nm} nm"


def planned_nm(run: StoredRun) -> PerCut | None:
    """Return the planned thickness of each cut, of a run that knows it."""
    told = (run.manifest["plan"].get("sections") or {}).get("thickness_nm")
    return per_cut(told) if told else None


def planned_depths_nm(run: StoredRun, sections: Sequence[int]) -> NDArray[np.float64]:
    """Return how deep each face lies as planned, from where the feed stood at the start."""
    thickness_nm = planned_nm(run)
    assert thickness_nm is not None
    first = int(run.manifest["plan"]["sections"].get("remove_first", False))
    return np.array([thickness_nm.total_nm(section + first) for section in sections], float)
