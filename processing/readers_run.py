"""Run folders of this program as stacks: exactly the durable planes, at the positions read back.

A run of one stack is that stack. Of sections with one plane each, the planes lie one behind the other, as far apart as
the feed read back; of sections with stacks of their own, one section's stack is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.depths import depths_nm
from acquire.store import RunEnd, StoredRun, open_run
from devices.errors import InputError
from processing.readers import Choice, Recording, choose_channel, choose_time

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

NM_PER_UM = 1000.0


def read_run(folder: Path, choice: Choice) -> Recording:
    """Read the durable planes of one band of a run, finished or not.

    Raises
    ------
    InputError
        No run, or no plane in it yet; ``stack-channel``, ``stack-time``; ``sections-stacks``: each section has a stack
        of its own, and none was chosen.
    """
    run = open_run(folder)
    band = choose_channel(run.layout.channel_count, choice, folder, run.layout.channels)
    sections, along, said = _chosen(run, choice)
    there = [slot for slot in sorted(run.planes) if _is_in(run, slot, sections, band)]
    if not there:
        raise InputError(f"{folder} holds no plane yet.", fix="take the run first.", code="stack-empty")
    z_um, how = _places(run, there, along)
    return Recording(
        len(there),
        lambda k: run.read(there[k]),
        z_um=z_um,
        pixel_um=run.layout.pixel_um,
        notes=(*said, *how, *_remarks(run)),
        label=lambda k: f"plane {there[k]}",
    )


def _chosen(run: StoredRun, choice: Choice) -> tuple[range, str, list[str]]:
    """Return the sections whose planes make the stack, along what they lie, and what to say."""
    layout, cut = run.layout, is_cut(run)
    if layout.sections == 1 or layout.planes_each == 1:
        choose_time(1, choice, run.folder)
    if layout.sections == 1:
        return range(1), "stack", []
    if layout.planes_each == 1:
        along = "sections" if cut else "time"
        words = [] if cut else ["the planes run along time; they are taken as focal planes."]
        return range(layout.sections), along, words
    if choice.time is None and cut:
        raise InputError(
            f"{run.folder} has {layout.sections} sections with {layout.planes_each} planes each.",
            why="One plane of each makes a volume; the planes of one make a focal stack.",
            fix=(
                f"take the sharpest plane or the extended focus of each: stereotome process faces {run.folder} -o DIR",
                "choose one section: --time N, where the command has it",
            ),
            code="sections-stacks",
        )
    time = choose_time(layout.sections, choice, run.folder)
    what = "section" if cut else "time point"
    return range(time, time + 1), "stack", [f"{what} {time} of 0 … {layout.sections - 1}; another one: --time N."]


def is_cut(run: StoredRun) -> bool:
    """Tell whether the sections of a run are those of a specimen, and not points in time or views."""
    return bool(run.manifest.get("plan", {}).get("sections"))


def _is_in(run: StoredRun, slot: int, sections: range, band: int) -> bool:
    section, of_band, _ = run.layout.place(slot)
    return section in sections and of_band == band


def _places(run: StoredRun, there: list[int], along: str) -> tuple[NDArray[np.float64] | None, list[str]]:
    if along == "stack":
        return _read_back(run, there)
    if along == "time":
        return None, []
    depth_nm, how = depths_nm(run, [run.layout.place(slot)[0] for slot in there])
    if depth_nm is None:
        return None, how
    return (depth_nm[0] - depth_nm) / NM_PER_UM, how  # the first face is the uppermost


def _read_back(run: StoredRun, there: list[int]) -> tuple[NDArray[np.float64], list[str]]:
    """Return where the stage was read back; where that tells planes not apart, where it was sent."""
    headers = [run.planes[slot].header for slot in there]
    z_um = np.array([header.z_um for header in headers])
    if np.unique(z_um).size == z_um.size:
        return z_um, []
    words = "the stage read back one position for several planes: they are placed where it was sent."
    return np.array([header.setpoint_um for header in headers]), [words]


def _remarks(run: StoredRun) -> list[str]:
    remarks = [] if run.state is RunEnd.COMPLETED else [f"the run is {run.state}."]
    if run.missing:
        listed = ", ".join(map(str, run.missing[:10])) + (" …" if len(run.missing) > 10 else "")
        remarks.append(f"{len(run.missing)} of {run.layout.planned} planned planes are missing: {listed}.")
    return remarks
