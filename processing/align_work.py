"""The work of aligning one stack: matching its sections, marks or trend, and what the report says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.progress import progress
from processing.align_fiducials import Marks, read_marks
from processing.align_isotropy import Isotropic, elongation, mapped, shortened, tensors
from processing.align_mark_search import find_marks
from processing.align_models import Model
from processing.align_report import files_of
from processing.align_stack import FLAGS, Alignment, SectionAligner, choose_model
from processing.align_trend import Trend, drift, with_trend
from processing.outputs import about_stack, peak_memory_mb, versions

if TYPE_CHECKING:
    from devices.protocols import Clock
    from processing.align_methods import Method
    from processing.stack import Stack

Choice = Model | Literal["auto"]
GAP = 1.5  # times the usual distance of sections


@dataclass(frozen=True)
class Work:
    """A stack to be aligned and how."""

    stack: Stack
    clock: Clock
    model: Choice = "auto"
    method: Method = "auto"
    fiducials: str | None = None
    reference: int | None = None
    trend: Trend = "remove"
    isotropic: Isotropic | None = None

    def solved(self, *, quiet: bool, matched: SectionAligner | None = None) -> tuple[Alignment, dict[str, Any]]:
        """Align the stack, whose sections may be matched already; returns the report, too."""
        begin = self.clock.now()
        aligner, why = (matched, "") if matched else self._matched(quiet=quiet)
        reference = aligner.first_sound if self.reference is None else self.reference
        marks = self._marks(aligner, reference)
        anchors = marks.rows(aligner.model, reference) if marks else ()
        alignment = aligner.finish(reference, anchors, gaps(self.stack))
        notes = [*self.stack.notes, *([why] if why else []), *([marks.words()] if marks else [])]
        if not marks:
            drifted = drift(list(alignment.matrices), alignment.shape)
            notes.append(drifted.words(len(self.stack)))
            alignment = self._with_trend(alignment)
        if self.isotropic is not None and not marks:
            alignment, said = uncompressed(self.stack, alignment, self.isotropic)
            notes.append(said)
        return alignment, self._report(alignment, notes, round(self.clock.now() - begin, 3))

    def _matched(self, *, quiet: bool) -> tuple[SectionAligner, str]:
        """Match all sections; returns in words why they are mapped as they are, too."""
        model, why = choose_model(self.stack) if self.model == "auto" else (self.model, "")
        aligner = SectionAligner(model, self.method)
        with progress("matching sections", len(self.stack), quiet=quiet) as show:
            for k in range(len(self.stack)):
                aligner.add(self.stack[k])
                show(k + 1)
        return aligner, why

    def _marks(self, aligner: SectionAligner, reference: int) -> Marks | None:
        if self.fiducials is None:
            return None
        if self.fiducials == "auto":
            return find_marks(self.stack, aligner.finish(reference).matrices, reference)
        return read_marks(Path(self.fiducials), self.stack)

    def _with_trend(self, alignment: Alignment) -> Alignment:
        matrices = with_trend(list(alignment.matrices), alignment.shape, self.trend, alignment.reference)
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
