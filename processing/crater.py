"""Depth profiles eroded unevenly: planes bent back to true depth by the crater measured at the end (TECHNIQUES B10).

An ion beam or a polisher takes off more at some places than at others, at each place at a steady rate. Plane k of N,
taken while the floor sank to depth d(x, y), showed at (x, y) what lay at k / (N − 1) of d. So what lies at depth z is
seen in plane z (N − 1) / d, between planes by linear interpolation; below the floor nothing is known.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

KEPT_PLANES = 64


def checked_crater(crater_um: Array, shape: tuple[int, ...]) -> Array:
    """Return the depth of the crater's floor, NaN where it is not known or not positive.

    Raises
    ------
    InputError
        ``crater-shape``: it is not of the size of a plane. ``crater-flat``: nowhere positive.
    """
    if crater_um.shape != shape[:2]:
        raise InputError(
            f"the crater is {crater_um.shape[::-1]} px, a plane {shape[1::-1]} px.",
            fix="measure it on the field of the planes, pixel by pixel.",
            code="crater-shape",
        )
    depth = np.where(np.isfinite(crater_um) & (crater_um > 0), crater_um, np.nan).astype(np.float64)
    if np.isnan(depth).all():
        raise InputError(
            "the crater is nowhere below the surface.",
            fix="give its depth in µm, down positive; for heights, up positive: --heights",
            code="crater-flat",
        )
    return depth


def depths_um(crater_um: Array, planes: int) -> Array:
    """Return evenly spaced depths from the surface to the deepest floor, one for each plane."""
    return np.linspace(0.0, float(np.nanmax(crater_um)), planes)


def unbent(planes: Sequence[Array], crater_um: Array, depths: Array) -> Iterator[tuple[Array, Array]]:
    """Return what lies at each depth.

    Parameters
    ----------
    planes : sequence of array (height, width) or (height, width, 3)
        In the order they were taken, the first before anything was eroded, the last at the crater's floor.
    crater_um : array (height, width)
        Depth of the floor, NaN where unknown.
    depths : array (n,)
        Depths in µm.

    Yields
    ------
    plane, known
        Of the planes' type, 0 where unknown; and where it is known, (height, width) bool.
    """

    @lru_cache(KEPT_PLANES)
    def plane(k: int) -> Array:
        return planes[k].astype(np.float64)

    last = len(planes) - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        for depth in depths:
            place = depth * last / crater_um
            known = np.isfinite(place) & (place <= last * (1 + 1e-9))
            yield _between(plane, np.where(known, np.minimum(place, last), 0.0), known, planes[0]), known


def _between(plane: Any, place: Array, known: Array, like: Array) -> Array:
    """Interpolate linearly between planes at a place of its own for each pixel."""
    out = np.zeros(like.shape, np.float64)
    lower = np.floor(place).astype(int)
    for k in np.unique(lower[known]):
        here = known & (lower == k)
        share = (place - k)[here]
        if like.ndim == 3:
            share = share[:, None]
        above = plane(int(k))[here]
        out[here] = above + share * (plane(int(k) + 1)[here] - above) if share.any() else above
    return np.rint(out).astype(like.dtype)
