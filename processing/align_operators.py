"""Alignment of sections as an operator: from a stack as taken to one in which sections lie on each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.align_methods import Method  # noqa: TC001  the operator's parameters are made from the annotations
from processing.align_models import Model  # noqa: TC001
from processing.align_report import resampled
from processing.align_stack import SectionAligner
from processing.align_trend import Trend, with_trend
from processing.operators import Layer, like, operator
from processing.table import Table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


COLUMNS = ("section", "m00", "m01", "m02", "m10", "m11", "m12", "flags")


@operator("align.stack", gives=[like("volume"), Layer("sections")])
def stack(
    volume: Array, *, model: Model = "rigid", method: Method = "auto", reference: int = 0, trend: Trend = "remove"
) -> tuple[Array, Table]:
    """Lay the sections of a stack on each other; without marks, which of them lean is not told from drift.

    Parameters
    ----------
    volume : array (sections, height, width[, 3]) uint8 or uint16
        As taken.
    model, method, reference, trend
        As in ``stereotome process align``.

    Returns
    -------
    volume : array
        Each section resampled once; 0 where it shows nothing.
    sections : Table
        The first two rows of each section's matrix, from output (x, y, 1) to the section as taken, and its flags.

    Raises
    ------
    InputError
        ``align-no-match``: not one pair of sections could be matched.
    """
    aligner = SectionAligner(model, method)
    for section in volume:
        aligner.add(section)
    found = aligner.finish(reference)
    matrices = with_trend(list(found.matrices), found.shape, trend, reference)
    moved = np.stack([resampled(section, m) for section, m in zip(volume, matrices, strict=True)])
    placed = zip(found.sections, matrices, strict=True)
    rows = tuple((s.index, *m[:2].ravel().tolist(), " ".join(s.flags)) for s, m in placed)
    return moved, Table(COLUMNS, rows)
