"""Grey and binary morphology: the largest or the smallest value around each voxel, and what is made of the two.

All take any grey volume; a mask is one of two grey values. What lies around a voxel is a rule, 6, 18 or 26 neighbours,
or a ball of ``radius`` pixels with the true spacing; where planes are more than three times farther apart than pixels,
rules work plane by plane. Beyond the border nothing counts, which is the same as repeating the outermost voxels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.operators import like, operator
from processing.volume_filters import around, checked, reach
from processing.volume_kernels import extreme_rows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from processing.neighbours import Neighbours, Spacing

    Array = NDArray[Any]


def twice(params: Mapping[str, Any]) -> tuple[int, int, int]:
    """How far two steps look."""
    z, y, x = reach(params)
    return 2 * z, 2 * y, 2 * x


def extreme(grey: Array, near: Neighbours, *, largest: bool) -> Array:
    """Return the largest or smallest value around each voxel."""
    out = np.empty_like(grey)
    extreme_rows(grey, near.rows, largest, out)
    return out


def opened(grey: Array, near: Neighbours, *, bright: bool) -> Array:
    """Return the opening, which takes away what is bright and small, or the closing, what is dark and small."""
    return extreme(extreme(grey, near, largest=not bright), near, largest=bright)


@operator("morphology.erode", gives=[like("volume")], halo=reach)
def erode(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Smallest value around each voxel: bright features shrink.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values, or a mask.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule : 6, 18 or 26
        Which neighbours count beside the voxel itself.
    radius : float
        A ball of that many pixels instead of a rule.

    Returns
    -------
    array (z, y, x)
        Of the volume's type.

    Raises
    ------
    InputError
        ``neighbours``, ``spacing``, ``volume-shape``, ``volume-nan``.
    """
    return extreme(checked(volume), around(rule, radius, spacing_um), largest=False)


@operator("morphology.dilate", gives=[like("volume")], halo=reach)
def dilate(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Largest value around each voxel: bright features grow.

    Parameters
    ----------
    volume, spacing_um, rule, radius
        As of `erode`.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `erode`.
    """
    return extreme(checked(volume), around(rule, radius, spacing_um), largest=True)


@operator("morphology.open", gives=[like("volume")], halo=twice)
def open_(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Eroded, then dilated: what is bright and smaller than the neighbourhood goes, bridges break.

    Parameters
    ----------
    volume, spacing_um, rule, radius
        As of `erode`.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `erode`.
    """
    return opened(checked(volume), around(rule, radius, spacing_um), bright=True)


@operator("morphology.close", gives=[like("volume")], halo=twice)
def close(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Dilated, then eroded: what is dark and smaller than the neighbourhood goes, gaps close.

    Parameters
    ----------
    volume, spacing_um, rule, radius
        As of `erode`.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `erode`.
    """
    return opened(checked(volume), around(rule, radius, spacing_um), bright=False)


@operator("morphology.gradient", gives=[like("volume")], halo=reach)
def gradient(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Largest less smallest value around each voxel: edges, of a mask its boundary on both sides.

    Parameters
    ----------
    volume, spacing_um, rule, radius
        As of `erode`.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `erode`.
    """
    grey, near = checked(volume), around(rule, radius, spacing_um)
    largest: Array = extreme(grey, near, largest=True)
    return largest - extreme(grey, near, largest=False)


@operator("morphology.top_hat", gives=[like("volume")], halo=twice)
def top_hat(
    volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0, dark: bool = False
) -> Array:
    """Difference to the opening: bright and small features on an uneven ground.

    Parameters
    ----------
    volume, spacing_um, rule, radius
        As of `erode`.
    dark : bool
        What closing fills instead: dark and small features.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `erode`.
    """
    grey, near = checked(volume), around(rule, radius, spacing_um)
    smooth: Array = opened(grey, near, bright=not dark)
    return smooth - grey if dark else grey - smooth
