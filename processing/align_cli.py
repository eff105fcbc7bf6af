"""The command ``stereotome process align``."""

from __future__ import annotations

import json as notation
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.align_fiducials import Marks, read_marks
from processing.align_fill import MADE, bridges, marked
from processing.align_isotropy import Isotropic, elongation, mapped, shortened, tensors
from processing.align_mark_search import find_marks
from processing.align_methods import Method  # noqa: TC001  the command line is made from the annotations
from processing.align_models import Model
from processing.align_report import files_of, write_alignment
from processing.align_stack import FLAGS, Alignment, SectionAligner, choose_model
from processing.align_trend import Trend, drift, with_trend
from processing.outputs import about_stack, peak_memory_mb, versions
from processing.result_folder import check_results
from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from devices.protocols import Clock

Switch = Parameter(negative="")
Choice = Model | Literal["auto"]
GAP = 1.5  # times the usual distance of sections


def align(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    model: Choice = "auto",
    method: Method = "auto",
    fiducials: str | None = None,
    reference: int = 0,
    trend: Trend = "remove",
    isotropic: Isotropic | None = None,
    interpolate: Annotated[bool, Switch] = False,
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
        The section that stays as it is, counted from 0.
    trend
        What runs smoothly through the stack: remove takes it for drifting sections, keep for the specimen's own
        shape, model does so for a steady shift and twist. Without meaning where marks are given.
    isotropic
        Take the specimen for one without preferred direction, by its texture or its dark or bright features, and take
        out the compression all sections share with the reference, which neighbours cannot tell. Not with marks.
    interpolate
        Draw blank, damaged and unmatched sections from the sound ones beside them, for looking; each is flagged.
        Without it they stay as they were taken.
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
    check_reference(opened, reference)
    work = Work(opened, model, method, fiducials, reference, trend, isotropic, SystemClock())
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


def check_reference(stack: Stack, reference: int) -> None:
    """Refuse a stack that needs no alignment, or a reference that is not there."""
    if len(stack) < 2:
        raise InputError(f"{stack.source} holds one section.", fix="give two sections or more.", code="align-one")
    if not 0 <= reference < len(stack):
        raise InputError(
            f"there is no section {reference}; there are 0 … {len(stack) - 1}.",
            fix="choose one of these: --reference N",
            code="align-reference",
        )


@dataclass(frozen=True)
class Work:
    """A stack to be aligned and how."""

    stack: Stack
    model: Choice
    method: Method
    fiducials: str | None
    reference: int
    trend: Trend
    isotropic: Isotropic | None
    clock: Clock

    def solved(self, *, quiet: bool) -> tuple[Alignment, dict[str, Any]]:
        """Align the stack; returns the report, too."""
        begin = self.clock.now()
        model, why = choose_model(self.stack) if self.model == "auto" else (self.model, "")
        aligner = SectionAligner(model, self.method)
        with progress("matching sections", len(self.stack), quiet=quiet) as show:
            for k in range(len(self.stack)):
                aligner.add(self.stack[k])
                show(k + 1)
        marks = self._marks(aligner)
        anchors = marks.rows(model, self.reference) if marks else ()
        alignment = aligner.finish(self.reference, anchors, gaps(self.stack))
        notes = [*self.stack.notes, *([why] if why else []), *([marks.words()] if marks else [])]
        if not marks:
            drifted = drift(list(alignment.matrices), alignment.shape)
            notes.append(drifted.words(len(self.stack)))
            alignment = self._with_trend(alignment)
        if self.isotropic is not None and not marks:
            alignment, said = uncompressed(self.stack, alignment, self.isotropic)
            notes.append(said)
        return alignment, self._report(alignment, notes, round(self.clock.now() - begin, 3))

    def _marks(self, aligner: SectionAligner) -> Marks | None:
        if self.fiducials is None:
            return None
        if self.fiducials == "auto":
            return find_marks(self.stack, aligner.finish(self.reference).matrices, self.reference)
        return read_marks(Path(self.fiducials), self.stack)

    def _with_trend(self, alignment: Alignment) -> Alignment:
        matrices = with_trend(list(alignment.matrices), alignment.shape, self.trend, self.reference)
        return alignment.with_matrices(matrices)

    def _report(self, alignment: Alignment, notes: list[str], seconds: float) -> dict[str, Any]:
        told = [f"section {s.index} {FLAGS[flag]} ({flag})." for s in alignment.sections for flag in s.flags]
        return {
            "format": "stereotome-align",
            "version": 1,
            **about_stack(self.stack),
            "notes": [*notes, *told],
            "model": alignment.model,
            "method": self.method,
            "reference": alignment.reference,
            "fiducials": self.fiducials,
            "trend": self.trend if self.fiducials is None else None,
            "isotropic": self.isotropic if self.fiducials is None else None,
            "loop_px": alignment.loop_px,
            "pairs": pair_table(alignment),
            "flags": {str(s.index): list(s.flags) for s in alignment.sections if s.flags},
            "seconds": seconds,
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "versions": versions(),
            "files": list(files_of(self.method)),
        }


def uncompressed(stack: Stack, alignment: Alignment, kind: Isotropic) -> tuple[Alignment, str]:
    """Take out the compression that the looks of all sections, put on each other, show; says what it was."""
    groups = [mapped(tensors(stack[s.index], kind), s.matrix) for s in alignment.sections if not s.flags]
    found = elongation(groups, kind)
    if found is None:
        return alignment, f"--isotropic {kind}: fewer than three sections show enough of it; nothing was taken out."
    back = np.eye(3)
    back[:2, :2] = shortened(found)
    middle = (np.array(alignment.shape[1::-1]) - 1) / 2
    back[:2, 2] = middle - back[:2, :2] @ middle
    said = (
        f"taken for isotropic by its {kind}, section {alignment.reference} is compressed by {found.compression:.2%} ± "
        f"{found.compression_error:.2%} along {found.direction_deg:.1f}° ± {found.direction_error_deg:.1f}°; all "
        "sections were stretched back by that."
    )
    return alignment.with_matrices([s.matrix @ back for s in alignment.sections]), said


def pair_table(alignment: Alignment) -> list[dict[str, Any]]:
    """Return what was found for every pair."""
    return [
        {
            "first": i,
            "second": j,
            "start": found.start,
            "correlation": round(found.correlation, 4),
            "noise_error_px": round(found.error_px, 5),
            "inliers": round(found.inliers, 3),
            "overlap": round(found.overlap, 3),
            "mismatch": found.mismatch,
            "believed": found.believed,
        }
        for (i, j), found in alignment.pairs.items()
    ]


def gaps(stack: Stack) -> list[int]:
    """Return the sections that come after others that are missing, by their positions."""
    if stack.z_um is None or len(stack) < 3:
        return []
    steps = np.abs(np.diff(stack.z_um))
    return [int(k) + 1 for k in np.flatnonzero(steps > GAP * np.median(steps))]


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    neighbours = [p["correlation"] for p in report["pairs"] if p["second"] - p["first"] == 1]
    words = (
        f"{report['input']['planes']} sections, {report['model']}; neighbours correlate {np.median(neighbours):.3f} "
        f"(median, filtered), loops of pairs close to {report['loop_px']:.2f} px, {len(report['flags'])} flagged; "
        f"{report['seconds']:.1f} s, {report['peak_memory_mb']:.0f} MB at most"
    )
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
