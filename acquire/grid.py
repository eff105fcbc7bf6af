"""Where the planes of a run come to lie in an export: times, channels, depths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from acquire.depths import planned_depths_nm, planned_nm
from devices.errors import InputError

if TYPE_CHECKING:
    from acquire.store import StoredRun

NM_PER_UM = 1000


@dataclass(frozen=True)
class Grid:
    """The planes of an export.

    Attributes
    ----------
    slots : ndarray, shape (t, c, z), int
        Which plane of the run lies there.
    start_um, step_um : float
        Position of the first plane along z, and signed distance of planes.
    remark : str
        What has to be told of that distance, if anything.
    """

    slots: np.ndarray
    start_um: float
    step_um: float
    remark: str = ""


def grid_of(stored: StoredRun, sections: Literal["t", "z"] = "t") -> Grid:
    """Return where planes go: sections along t beside their stacks, or one plane of each along z.

    A stack of one section and band closes up over planes that were never taken; of anything larger they keep their
    places, up to the last section of which there is any plane.

    Raises
    ------
    InputError
        Sections are wanted along z, but each has a stack of its own.
    """
    layout = stored.layout
    if layout.sections == 1 and layout.channel_count == 1:
        return Grid(np.array(sorted(stored.planes))[None, None], layout.start_um, layout.step_um)
    taken = 1 + max(layout.place(slot)[0] for slot in stored.planes)
    slots = np.arange(layout.planned).reshape(layout.sections, layout.channel_count, layout.planes_each)[:taken]
    if sections == "t":
        return Grid(slots, layout.start_um, layout.step_um)
    if layout.planes_each > 1:
        raise InputError(
            "the sections of this run have stacks of their own: they cannot all lie along z.",
            fix=(
                "leave --sections out: they lie along t then",
                "make a volume of one picture each: stereotome process faces RUN -o DIR",
            ),
            code="usage",
        )
    return Grid(slots[:, :, 0].T[None], 0.0, *_thickness_um(stored, taken))


def _thickness_um(stored: StoredRun, taken: int) -> tuple[float, str]:
    """Return how far the sections are apart as planned, and what has to be told of it."""
    thickness_nm = planned_nm(stored)
    if thickness_nm is None:
        return 1.0, ""
    if len(thickness_nm.ranges) == 1 or taken < 2:
        return thickness_nm.nm(1) / NM_PER_UM, ""
    first_nm, last_nm = planned_depths_nm(stored, (0, taken - 1))
    words = f"sections of {thickness_nm} nm: one spacing stands for all, their mean; where each lies is told with it"
    return float(last_nm - first_nm) / (taken - 1) / NM_PER_UM, words
