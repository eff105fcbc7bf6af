"""Thresholds found in a histogram: where to part dark from bright when nobody says it.

All work on counts and the values they belong to, so that a volume needs to be gone through once, in any number of
parts. Each equals scikit-image's function of the same name on whole numbers; on others that function's result depends
on its bins, as here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.planes import slabs
from processing.volume_filters import checked

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from processing.planes import Planes

    Array = NDArray[Any]

FLOAT_BINS = 4096


@dataclass(frozen=True, eq=False)
class Values:
    """What values a volume has.

    Attributes
    ----------
    low, high : float
        Smallest and largest.
    two : bool
        There are no others.
    counts, values : array
        How often each is there, as of `histogram`.
    """

    low: float
    high: float
    two: bool
    counts: Array
    values: Array

    def level(self, threshold: str) -> float:
        """Return the threshold: a number as it is, or what a method finds; of two values the lower.

        Raises
        ------
        InputError
            ``threshold``: it is no finite number, or nothing parts dark from bright; ``operator-params``.
        """
        try:
            level = float(threshold)
        except ValueError:
            pass
        else:
            if not np.isfinite(level):
                raise InputError(f"{threshold} is no threshold.", fix="give a finite number.", code="threshold")
            return level
        if threshold in METHODS and self.two and self.low < self.high:
            return self.low
        return found(threshold, self.counts, self.values)


def values_of(volume: Planes) -> Values:
    """Go through a volume, twice where its values are not of 8 or 16 bit, and see what values it has.

    Raises
    ------
    InputError
        ``volume-nan``, ``volume-shape``.
    """
    limits: tuple[float, float] | None = None
    if volume.dtype not in (np.bool_, np.uint8, np.uint16):
        ends = [(float(grey.min()), float(grey.max())) for grey in _checked_slabs(volume)]
        limits = min(low for low, _ in ends), max(high for _, high in ends)
    tallies, values, between = [], np.empty(0), 0
    for grey in _checked_slabs(volume):
        counts, values = histogram(grey, limits)
        tallies.append(counts)
        between += 0 if limits is None else int(np.count_nonzero((grey != limits[0]) & (grey != limits[1])))
    counts = np.sum(tallies, axis=0)
    if limits is not None:
        return Values(*limits, between == 0, counts, values)
    there = np.flatnonzero(counts)
    return Values(float(there[0]), float(there[-1]), there.size < 3, counts, values)


def _checked_slabs(volume: Planes) -> Iterator[Array]:
    """Yield slabs of the types that kernels know; a volume of other axes has none."""
    if len(volume.shape) != 3 or 0 in volume.shape:
        checked(volume[0:1])
    for _, slab in slabs(volume):
        yield checked(slab)


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
            fix="give the threshold: --threshold V, or mask.threshold:above=V",
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
