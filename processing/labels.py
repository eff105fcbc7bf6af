"""Features told apart: each connected part of a mask gets a number of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cc3d
import numpy as np

from devices.errors import InputError
from processing.masks import as_mask
from processing.neighbours import RULES, Rule
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Labels = NDArray[np.uint32]

AS_LABELS = Layer("volume", "volume", "uint32")
MOST_LABELS = int(np.iinfo(np.uint32).max)


def checked_rule(rule: int) -> Rule:
    """Return 6, 18 or 26; raise `InputError` ``neighbours`` for all else."""
    if rule not in RULES:
        raise InputError(f"there is no neighbour rule {rule}.", fix="take 6, 18 or 26.", code="neighbours")
    return rule


def checked_labels(volume: Array) -> Array:
    """Return labels, (z, y, x), contiguous: whole numbers from 0 up.

    Raises
    ------
    InputError
        ``labels-needed``: of another kind; ``volume-shape``.
    """
    if volume.ndim != 3 or 0 in volume.shape:
        raise InputError(
            f"a volume has three axes, (z, y, x); this has {volume.shape}.",
            fix="choose one band: --channel N",
            code="volume-shape",
        )
    whole = volume.view(np.uint8) if volume.dtype == np.bool_ else volume
    if whole.dtype.kind == "f" and np.array_equal(whole, np.rint(whole)):
        whole = whole.astype(np.int64)
    if whole.dtype.kind not in "iu" or (whole.dtype.kind == "i" and whole.min() < 0):
        raise InputError(
            f"labels are whole numbers from 0 up; this volume is {volume.dtype}, {volume.min()} … {volume.max()}.",
            fix="label a mask first: label.components",
            code="labels-needed",
        )
    if whole.max() > MOST_LABELS:
        raise InputError(
            f"a label of {whole.max()} is larger than {MOST_LABELS}.", fix="number them from 1.", code="labels-needed"
        )
    return np.ascontiguousarray(whole)


@operator("label.components", gives=[AS_LABELS, Layer("count", dtype="int64")])
def components(volume: Array, *, rule: int = 26, by_value: bool = False, least: int = 1) -> tuple[Array, np.int64]:
    """Numbers of the connected parts of a mask, or of those of equal value.

    Parameters
    ----------
    volume : array (z, y, x)
        A mask; with ``by_value`` whole numbers from 0 up, of which equal ones that touch are one part.
    rule : 6, 18 or 26
        Which neighbours touch: across a face, an edge too, a corner too.
    by_value : bool
        Parts are of one value each; 0 is background.
    least : int
        Parts of fewer voxels are dropped.

    Returns
    -------
    volume : array (z, y, x) uint32
        0 for background, else 1 … count, in the order in which parts are met plane by plane, row by row.
    count : int
        Number of parts; 0 for an empty mask.

    Raises
    ------
    InputError
        ``mask-needed``, ``labels-needed``, ``neighbours``; ``volume-shape``, ``volume-nan``.
    """
    values: Array = checked_labels(volume) if by_value else as_mask(volume)
    near = checked_rule(rule) if sum(n > 1 for n in values.shape) > 1 else 6  # along a line cc3d 4.1 fails by 26
    made, count = cc3d.connected_components(
        values, connectivity=near, return_N=True, binary_image=not by_value, out_dtype=np.uint32
    )
    labels: Labels = np.ascontiguousarray(made)
    return (labels, np.int64(count)) if least <= 1 else without_small(labels, least)


def without_small(labels: Labels, least: int) -> tuple[Labels, np.int64]:
    """Drop labels of fewer than ``least`` voxels and number the others anew, in their order; returns their number."""
    sizes = np.bincount(labels.ravel())
    kept = sizes >= least
    kept[0] = False
    numbers = np.cumsum(kept, dtype=np.uint32) * kept
    return numbers.astype(np.uint32)[labels], np.int64(np.count_nonzero(kept))
