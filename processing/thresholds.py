"""Thresholds found in a histogram: where to part dark from bright when nobody says it.

All work on counts and the values they belong to, so that a volume needs to be gone through once, in any number of
parts. Each equals scikit-image's function of the same name on whole numbers; on others that function's result depends
on its bins, as here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

FLOAT_BINS = 4096


def histogram(volume: Array, limits: tuple[float, float] | None = None) -> tuple[Array, Array]:
    """Count the values of a volume.

    Parameters
    ----------
    volume : array
        uint8 or uint16: every value is counted for itself. Others: 4096 even steps between ``limits``.
    limits : tuple of float, optional
        Smallest and largest value, where not those of the volume.

    Returns
    -------
    counts : array (n,) int64
    values : array (n,) float64
        Middles of the steps.
    """
    if volume.dtype in (np.uint8, np.uint16):
        counts = np.bincount(volume.ravel(), minlength=np.iinfo(volume.dtype).max + 1)
        return counts, np.arange(counts.size, dtype=np.float64)
    low, high = limits or (float(volume.min()), float(volume.max()))
    counts, edges = np.histogram(volume, FLOAT_BINS, (low, high))
    return counts, (edges[:-1] + edges[1:]) / 2


def found(method: str, counts: Array, values: Array) -> float:
    """Return the threshold that ``method`` finds: what is above it is bright.

    Raises
    ------
    InputError
        ``operator-params``: there is no such method; ``threshold``: fewer than two values, or no two peaks.
    """
    if method not in METHODS:
        raise InputError(
            f"there is no threshold method {method!r}.",
            fix=f"take one of: {', '.join(METHODS)}",
            code="operator-params",
        )
    there = np.flatnonzero(counts)
    if there.size < 2:
        raise InputError(
            "all voxels have one value: nothing parts dark from bright.",
            fix="give the threshold: mask.threshold:above=V",
            code="threshold",
        )
    part = slice(there[0], there[-1] + 1)
    try:
        return float(METHODS[method](counts[part], values[part]))
    except RuntimeError as error:  # minimum: the smoothed histogram never has two peaks
        raise InputError(
            f"{method}: {str(error).rstrip('.').lower()}.", fix="take another method, such as otsu.", code="threshold"
        ) from None


def _of_skimage(name: str) -> Callable[[Array, Array], float]:
    def apply(counts: Array, values: Array) -> float:
        from skimage import filters  # noqa: PLC0415  takes half a second

        return float(getattr(filters, f"threshold_{name}")(hist=(counts, values)))

    return apply


def li(counts: Array, values: Array) -> float:
    """Least cross entropy (Li and Tam 1998): the threshold at the logarithmic mean of the means of both sides."""
    shifted = values - values[0]
    at, before = np.average(shifted, weights=counts), -1.0
    tolerance = np.diff(shifted).min() / 2
    while abs(at - before) > tolerance:
        before, bright = at, shifted > at
        above = np.average(shifted[bright], weights=counts[bright])
        below = np.average(shifted[~bright], weights=counts[~bright])
        if below == 0:  # its logarithm has no value; all that is dark is equal
            break
        at = (below - above) / (np.log(below) - np.log(above))
    return float(at + values[0])


def mean(counts: Array, values: Array) -> float:
    """Mean of all values."""
    return float(np.average(values, weights=counts))


def triangle(counts: Array, values: Array) -> float:
    """Where the histogram stays farthest below the line from its peak to its longer end (Zack 1977)."""
    peak = int(counts.argmax())
    flip = peak < counts.size - peak - 1
    tallies = counts[::-1] if flip else counts
    peak = tallies.size - peak - 1 if flip else peak
    across = np.arange(peak)
    rise = tallies[0] + (tallies[peak] - tallies[0]) * across / max(peak, 1)
    place = int(np.argmax(rise - tallies[:peak])) if peak else 0
    return float(values[::-1][place] if flip else values[place])


METHODS: dict[str, Callable[[Array, Array], float]] = {
    "otsu": _of_skimage("otsu"),
    "li": li,
    "yen": _of_skimage("yen"),
    "isodata": _of_skimage("isodata"),
    "minimum": _of_skimage("minimum"),
    "triangle": triangle,
    "mean": mean,
}
