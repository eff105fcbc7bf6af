"""The command ``stereotome process align``."""

from __future__ import annotations

import csv
import json as notation
import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.align_fill import MADE, bridges, marked
from processing.align_isotropy import Isotropic  # noqa: TC001  the command line is made from the annotations
from processing.align_methods import Method  # noqa: TC001
from processing.align_report import files_of, write_alignment
from processing.align_stack import FLAGS
from processing.align_trend import Trend  # noqa: TC001
from processing.align_work import Choice, Work
from processing.memory import check_memory
from processing.readers import reading
from processing.result_folder import check_results
from processing.stack import open_stack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.stack import Stack

Switch = Parameter(negative="")
PLANES_AT_WORK = 12  # copies of a plane of 8 bits that matching and resampling hold, measured on 16 and 36 megapixels


def align(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    model: Choice = "auto",
    method: Method = "auto",
    fiducials: str | None = None,
    reference: int | None = None,
    trend: Trend = "remove",
    isotropic: Isotropic | None = None,
    interpolate: Annotated[bool, Switch] = False,
    depths: Path | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Align the sections of a stack, and say how sure that is.

    Parameters
    ----------
    stack
        Run folder, OME-Zarr, TIFF, a folder of PNG, JPEG or TIFF images (or a quoted pattern of their names), NPY,
        NPZ or NIfTI.
    output
        Folder for the aligned stack, transforms, picture and report.
    model
        Maps a section may need: translation, rigid, uniaxial (rigid and compressed along one direction), similarity,
        affine; auto looks at a few pairs.
    method
        auto: several starts, then a robust refinement. One way alone, without refinement: centroids (of features of
        the binary pictures), mismatch (least Ex-OR area of the binary pictures, with its curve), phase (correlation,
        shift only), fourier-mellin (shift, turn, scale), features.
    fiducials
        auto, or a CSV file with columns section, mark, x_px, y_px: places of marks that run straight through the
        specimen; a section called "known" gives their true places.
    reference
        The section that stays as it is, counted from 0; the first that shows something when left out.
    trend
        What runs smoothly through the stack: remove takes it for drifting sections, keep for the specimen's own
        shape, model does so for a steady shift and twist. Without meaning where marks are given.
    isotropic
        Take the specimen for one without preferred direction, by its texture or its dark or bright features, and take
        out the compression all sections share with the reference, which neighbours cannot tell. Not with marks.
    interpolate
        Draw blank, damaged and unmatched sections from the sound ones beside them, for looking; each is flagged.
        Without it they stay as they were taken.
    depths
        A CSV file with the column removed_um, a line for each section: how deep its face lies below the first one; what
        process indents makes of polished faces. Goes before --step-um.
    step_um
        Distance of sections in µm; goes before what the file says.
    channel
        Channel, or series of images, to take when there are several; counted from 0.
    time
        Time point to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_results(output, files_of(method), overwrite=overwrite)
    opened = open_stack(stack, step_um=step_um, channel=channel, time=time)
    fix = "cut the sections into fields, or bin them first"
    check_memory(needed_bytes(opened), f"the alignment of {opened.source}", fix)
    if depths is not None:
        opened.z_um = read_depths(depths, len(opened))
    check_reference(opened, reference)
    work = Work(opened, SystemClock(), model, method, fiducials, reference, trend, isotropic)
    alignment, report = work.solved(quiet=quiet)
    made = bridges(alignment, opened.z_um) if interpolate else {}
    alignment = marked(alignment, made)
    report["interpolated"] = {str(k): {"before": b.before, "after": b.after} for k, b in made.items()}
    report["flags"] = {str(s.index): list(s.flags) for s in alignment.sections if s.flags}
    report["notes"] += [f"section {k} {FLAGS[MADE]} ({MADE})." for k in made]
    with progress("resampling", len(opened), quiet=quiet) as show:
        write_alignment(output, opened, alignment, report, show, made)
    for note in [] if quiet else report["notes"]:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(notation.dumps(report, ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


def needed_bytes(stack: Stack) -> float:
    """Return what aligning a stack takes at most: copies of a plane at work, and of each section what is compared."""
    height, width = stack.shape[:2]
    plane_bytes = float(np.prod(stack.shape)) * stack.dtype.itemsize
    return PLANES_AT_WORK * plane_bytes + len(stack) * float(height * width)


def read_depths(path: Path, count: int) -> NDArray[np.float64]:
    """Read how deep each face lies, in µm; the first one is the uppermost, as in runs.

    Raises
    ------
    InputError
        ``align-depths``: no such column, not a number for each section, or faces that do not lie one below the other.
    """
    with reading(path), path.open(newline="", encoding="utf-8-sig") as file:
        lines = list(csv.DictReader(file))
    try:
        removed = np.array([float(line["removed_um"]) for line in lines])
    except (KeyError, TypeError, ValueError):
        removed = np.array([])
    if len(removed) == count and np.isfinite(removed).all() and (np.diff(removed) > 0).all():
        return np.asarray(removed[0] - removed)
    raise InputError(
        f"{path} does not say how deep {count} sections lie.",
        why=f"It has {len(lines)} lines; the column removed_um must rise from one to the next.",
        fix="give chain.csv as process indents writes it for the same faces",
        code="align-depths",
    )


def check_reference(stack: Stack, reference: int | None) -> None:
    """Refuse a stack that needs no alignment, or a reference that is not there."""
    if len(stack) < 2:
        raise InputError(f"{stack.source} holds one section.", fix="give two sections or more.", code="align-one")
    if reference is not None and not 0 <= reference < len(stack):
        raise InputError(
            f"there is no section {reference}; there are 0 … {len(stack) - 1}.",
            fix="choose one of these: --reference N",
            code="align-reference",
        )


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    neighbours = [p["correlation"] for p in report["pairs"] if p["second"] - p["first"] == 1]
    words = (
        f"{report['input']['planes']} sections, {report['model']}; neighbours correlate {np.median(neighbours):.3f} "
        f"(median, filtered), loops of pairs close to {report['loop_px']:.2f} px, {len(report['flags'])} flagged; "
        f"{report['seconds']:.1f} s, {report['peak_memory_mb']:.0f} MB at most"
    )
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
