"""Operators that make a mask of a volume, or a better one of a mask: threshold, holes filled.

A mask is (z, y, x) uint8, 255 inside and 0 outside, so that it is the same in memory, on the disk and to look at. Any
volume of two values, one of them 0, is taken for one, and boolean arrays are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import fill_voids
import numpy as np

from devices.errors import InputError
from processing import thresholds
from processing.operators import Layer, like, operator
from processing.volume_filters import checked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Mask = NDArray[np.uint8]

INSIDE = 255
WHOLE_PLANES = (0, 1 << 40, 1 << 40)
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


@operator("mask.threshold", gives=[AS_MASK, Layer("threshold", dtype="float64")],
          halo=lambda params: None if params["above"] is None else (0, 0, 0))  # fmt: skip
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


@operator("mask.fill_holes", gives=[AS_MASK], halo=lambda params: WHOLE_PLANES if params["by_plane"] else None)
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


@operator("mask.central", gives=[like("volume"), Layer("mask", "volume", "uint8")],
          halo=lambda params: None if params["above"] is None else WHOLE_PLANES)  # fmt: skip
def central(
    volume: Array, *, method: str = "otsu", above: float | None = None, neck_px: float = 3.0, centre: float = 0.25
) -> tuple[Array, Array]:
    """In every plane only the largest bright feature near the middle, as a brain within its skull; all else is 0.

    Plane by plane: what is brighter than the threshold is opened by ``neck_px``, so that bridges break; of its parts
    that with the greatest area counts, area far from the middle counting less; its edge is given back, its holes are
    filled.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    method : str
        How the threshold, one for all planes, is found where none is given, as of `threshold`.
    above : float, optional
        The threshold.
    neck_px : float
        Radius of what breaks bridges; 0 breaks none.
    centre : float
        How far from the middle of the frame area counts less: standard deviation of a Gaussian, as a share of height
        and width.

    Returns
    -------
    volume : array (z, y, x)
        The grey values inside, 0 outside.
    mask : array (z, y, x) uint8
        255 inside, 0 outside; all 0 in planes where nothing is bright.

    Raises
    ------
    InputError
        ``threshold``, ``operator-params``, ``volume-shape``, ``volume-nan``.
    """
    grey = checked(volume)
    bright = threshold(grey, method=method, above=above)[0]
    y, x = ((np.arange(n) - (n - 1) / 2) / (centre * n) for n in grey.shape[1:])
    near = np.exp(-(y[:, None] ** 2 + x**2) / 2)
    reach = int(np.ceil(neck_px))
    disc = (np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= neck_px).astype(np.uint8)
    mask = np.stack([_central_part(plane, disc, near) for plane in bright])
    return np.where(mask > 0, grey, grey.dtype.type(0)), mask


def _central_part(bright: Mask, disc: Mask, near: NDArray[np.float64]) -> Mask:
    """Return the part of a plane's mask in which most of the weights ``near`` lie."""
    padded: Any = np.pad(bright, len(disc), mode="edge")
    inner = (slice(len(disc), -len(disc)),) * 2
    cut = cv2.morphologyEx(padded, cv2.MORPH_OPEN, disc)
    count, parts = cv2.connectedComponents(cut, connectivity=4)
    if count == 1:
        return np.zeros_like(bright)
    weight = np.bincount(parts[inner].ravel(), near.ravel(), count)
    weight[0] = -1
    part = np.uint8(INSIDE) * (parts == weight.argmax()).astype(np.uint8)
    whole = (cv2.dilate(part, disc) & padded)[inner]
    filled: Mask = to_mask(fill_voids.fill(np.ascontiguousarray(whole > 0)))
    return filled
