"""Operators that make a mask of a volume, or a better one of a mask: threshold, holes filled.

A mask is (z, y, x) uint8, 255 inside and 0 outside, so that it is the same in memory, on the disk and to look at. Any
volume of two values, one of them 0, is taken for one, and boolean arrays are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import fill_voids
import numpy as np

from devices.errors import InputError
from processing import thresholds
from processing.operators import Layer, operator
from processing.volume_filters import checked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Mask = NDArray[np.uint8]

INSIDE = 255
AS_MASK = Layer("volume", "volume", "uint8")


def as_mask(volume: Array) -> NDArray[np.bool_]:
    """Return where a mask is inside, (z, y, x), contiguous.

    Raises
    ------
    InputError
        ``mask-needed``: it has more than one value besides 0; ``volume-shape``, ``volume-nan``.
    """
    if volume.dtype != np.bool_:
        volume = checked(volume)
        low, high = volume.min(), volume.max()
        if (low != 0 or high != INSIDE) and not _two_valued(volume, low, high):
            raise _mask_needed(low, high)
        inside: NDArray[np.bool_] = volume != 0
        if high == INSIDE and np.count_nonzero(inside) != np.count_nonzero(volume == INSIDE):
            raise _mask_needed(low, high)
        return inside
    checked(volume.view(np.uint8))
    return np.ascontiguousarray(volume)


def _two_valued(volume: Array, low: Any, high: Any) -> bool:
    return bool((low == 0 or low == high) and np.all((volume == low) | (volume == high)))


def _mask_needed(low: Any, high: Any) -> InputError:
    return InputError(
        f"a mask is needed, with one value inside and 0 outside; this volume has grey values, {low} … {high}.",
        fix="make one first: mask.threshold",
        code="mask-needed",
    )


def to_mask(inside: NDArray[np.bool_]) -> Mask:
    """Return a boolean volume as a mask of 0 and 255."""
    mask: Mask = inside.view(np.uint8) * np.uint8(INSIDE)
    return mask


def some_of(inside: NDArray[np.bool_], doing: str) -> NDArray[np.bool_]:
    """Return a mask that is not empty.

    Raises
    ------
    InputError
        ``mask-empty``, with the words for what was to be done.
    """
    if not inside.any():
        raise InputError(
            f"the mask is empty: there is nothing to {doing}.", fix="lower the threshold", code="mask-empty"
        )
    return inside


@operator("mask.threshold", gives=[AS_MASK, Layer("threshold", dtype="float64")])
def threshold(
    volume: Array, *, method: str = "otsu", above: float | None = None, up_to: float | None = None, dark: bool = False
) -> tuple[Array, np.float64]:
    """Mask of what is brighter than a threshold, given or found.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    method : str
        How the threshold is found where none is given: otsu, li, yen, isodata, minimum, triangle, mean.
    above : float, optional
        The threshold; inside is what is greater.
    up_to : float, optional
        Largest value that is inside.
    dark : bool
        The reverse: inside is what was outside.

    Returns
    -------
    volume : array (z, y, x) uint8
        255 inside, 0 outside.
    threshold : float
        The one that was taken.

    Raises
    ------
    InputError
        ``threshold``: nothing parts this volume; ``operator-params``; ``volume-shape``, ``volume-nan``.
    """
    grey = checked(volume)
    level = thresholds.found(method, *thresholds.histogram(grey)) if above is None else above
    inside = grey > level
    if up_to is not None:
        inside &= grey <= up_to
    return to_mask(~inside if dark else inside), np.float64(level)


@operator("mask.fill_holes", gives=[AS_MASK])
def fill_holes(volume: Array, *, by_plane: bool = False) -> Array:
    """Mask with its holes filled: background that no path along faces joins to the border of the volume.

    Parameters
    ----------
    volume : array (z, y, x)
        A mask.
    by_plane : bool
        Each plane for itself: pores open along z are filled, too.

    Returns
    -------
    array (z, y, x) uint8
        255 inside, 0 outside.

    Raises
    ------
    InputError
        ``mask-needed``; ``volume-shape``, ``volume-nan``.
    """
    inside = as_mask(volume)
    parts = list(inside) if by_plane else [inside]
    filled = [fill_voids.fill(part) for part in parts]
    return to_mask(np.stack(filled) if by_plane else np.ascontiguousarray(filled[0]))
