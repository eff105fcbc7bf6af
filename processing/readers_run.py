"""Run folders of this program as stacks: exactly the durable planes, at the positions read back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.store import RunEnd, StoredRun, open_run
from devices.errors import InputError
from processing.readers import Choice, Recording, choose_channel

if TYPE_CHECKING:
    from pathlib import Path


def read_run(folder: Path, choice: Choice) -> Recording:
    """Read the durable planes of a run, finished or not.

    Raises
    ------
    InputError
        No run, or no plane in it yet.
    """
    run = open_run(folder)
    choose_channel(1, choice, folder)
    there = sorted(run.planes)
    if not there:
        raise InputError(f"{folder} holds no plane yet.", fix="take the run first.", code="stack-empty")
    return Recording(
        len(there),
        lambda k: run.read(there[k]),
        z_um=np.array([run.planes[k].header.z_um for k in there]),
        pixel_um=run.layout.pixel_um,
        notes=tuple(_remarks(run)),
        label=lambda k: f"plane {there[k]}",
    )


def _remarks(run: StoredRun) -> list[str]:
    remarks = [] if run.state is RunEnd.COMPLETED else [f"the run is {run.state}."]
    if run.missing:
        listed = ", ".join(map(str, run.missing[:10])) + (" …" if len(run.missing) > 10 else "")
        remarks.append(f"{len(run.missing)} of {run.layout.planned} planned planes are missing: {listed}.")
    return remarks
