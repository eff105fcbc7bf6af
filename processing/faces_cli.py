"""``stereotome process faces``: one picture of each section of a run, as a volume."""

from __future__ import annotations

import sys
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from acquire.depths import depths_nm
from acquire.measures import focus_energy
from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from acquire.store import open_run
from devices.errors import InputError
from processing.focus import focus_stack
from processing.outputs import versions, write_durably
from processing.readers_run import NM_PER_UM, is_cut
from processing.result_folder import check_results, json_bytes
from processing.stack import open_stack
from processing.volume_files import publish, volume_names, write_volume

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from processing.stack import Stack

    Array = NDArray[Any]

NAME = "faces"
FILES = (*volume_names(NAME), "report.json")
Take = Literal["sharpest", "extended-focus"]


def faces(
    run: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    take: Take = "sharpest",
    channel: int | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Make a volume of a run of sections with focal stacks: one picture of each face, spaced as the feed read back.

    Parameters
    ----------
    run
        The run's folder.
    output
        Folder for the volume and the report.
    take
        Of the stack of each section its sharpest plane, or its extended focus.
    channel
        Band to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    quiet
        Show no progress and no notes.
    """
    check_results(output, FILES, overwrite=overwrite)
    stored = open_run(run)
    if not is_cut(stored):
        raise InputError(f"{run} has no sections.", fix="stereotome process focus takes a single stack.", code="usage")
    sections = sorted({stored.layout.place(slot)[0] for slot in stored.planes})
    if not sections:
        raise InputError(f"{run} holds no plane yet.", fix="take the run first.", code="stack-empty")
    if stored.layout.planes_each == 1:
        raise InputError(
            f"each section of {run} has one plane: there is nothing to choose.",
            fix=f"the run is a volume as it is: stereotome measure {run}",
            code="usage",
        )
    stacks = [open_stack(run, channel=channel, time=section) for section in sections]
    depth_nm, notes = depths_nm(stored, sections)
    if len(sections) <= sections[-1]:
        notes = [*notes, "sections are missing: the distance of the planes is the mean of what is there."]
    report = {
        "format": "stereotome-faces",
        "version": 1,
        "input": {"source": str(run)},
        "take": take,
        "notes": notes,
        "sections": sections,
        "depth_nm": None if depth_nm is None else depth_nm.tolist(),
        "versions": versions(),
        "files": list(FILES),
    }
    publish(output, lambda part: _fill(part, stacks, depth_nm, report, quiet=quiet))
    for note in [] if quiet else notes:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write("".join(f"{output / name}\n" for name in FILES))
    return 0


def _fill(
    part: Path, stacks: list[Stack], depth_nm: NDArray[np.float64] | None, report: dict[str, Any], *, quiet: bool
) -> None:
    """Write the volume, and the report with the plane that was taken of each stack."""
    chosen: list[int | None] = []

    def pictures() -> Iterator[Array]:
        with progress("sections", len(stacks), quiet=quiet) as show:
            for done, stack in enumerate(stacks, start=1):
                picture, plane = picture_of(stack, report["take"])
                chosen.append(plane)
                yield picture
                show(done)

    write_volume(part, NAME, f"{report['take']} of each section", _layout(stacks, depth_nm), pictures())
    write_durably(part / "report.json", json_bytes(report | {"planes": chosen}))


def picture_of(stack: Stack, take: Take) -> tuple[Array, int | None]:
    """Return the picture of a face, and which plane of its stack it is, if it is one."""
    if len(stack) == 1:
        return stack[0], 0
    if take == "extended-focus":
        return focus_stack(stack, z_um=stack.z_um, register=False).extended_focus, None
    plane = int(np.argmax([focus_energy(pixels) for pixels in stack]))
    return stack[plane], plane


def _layout(stacks: list[Stack], depth_nm: NDArray[np.float64] | None) -> FocalArray:
    first, apart = stacks[0], len(stacks) - 1
    step_um = 1.0 if depth_nm is None or not apart else float(np.ptp(depth_nm)) / apart / NM_PER_UM
    return FocalArray(len(stacks), first.shape, str(first.dtype), 0.0, step_um, first.pixel_um)
