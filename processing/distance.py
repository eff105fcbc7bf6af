"""How far it is from every voxel of a mask to the nearest voxel outside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import edt
import numpy as np

from devices.errors import InputError
from processing.masks import as_mask
from processing.neighbours import CUBIC, Spacing, checked_spacing
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


@operator("distance.map", gives=[Layer("volume", "volume", "float32")])
def distance(
    volume: Array, spacing_um: Spacing | None = None, *, outside: bool = False, signed: bool = False
) -> NDArray[np.float32]:
    """Distance from every voxel inside a mask to the nearest one outside, in µm (voxels without a spacing).

    Parameters
    ----------
    volume : array (z, y, x)
        A mask. What lies beyond the border of the volume is not known and counts as nothing.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x); any, since distances need no neighbours.
    outside : bool
        The reverse: from every voxel outside to the nearest one inside.
    signed : bool
        Both: positive inside, negative outside.

    Returns
    -------
    array (z, y, x) float32
        Euclidean distances between middles of voxels, exact but for rounding (Felzenszwalb and Huttenlocher 2012).

    Raises
    ------
    InputError
        ``mask-full``: nothing to measure to, the mask fills the volume, or is empty with ``outside``;
        ``mask-needed``, ``spacing``; ``volume-shape``, ``volume-nan``.
    """
    inside = as_mask(volume)
    spacing = checked_spacing(spacing_um or CUBIC)
    if signed:
        return np.asarray(to_nearest(inside, spacing) - to_nearest(~inside, spacing), np.float32)
    return to_nearest(~inside if outside else inside, spacing)


def to_nearest(inside: NDArray[np.bool_], spacing: Spacing) -> NDArray[np.float32]:
    """Return the distance from every voxel inside to the nearest one outside; raises `InputError` ``mask-full``."""
    if inside.all():
        raise InputError(
            "the mask fills the whole volume or, seen from outside, nothing of it: no distance has an end.",
            fix="choose another threshold.",
            code="mask-full",
        )
    return np.asarray(edt.edt(inside, anisotropy=spacing, black_border=False, parallel=1), np.float32)
