"""How grey levels become colours in the live picture: limits from the histogram, dragged ends, gamma, colour table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from display.scene import TABLE_ENTRIES, colour_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

TABLES = ("gray", "viridis", "magma", "cividis", "hot", "turbo")
GAMMAS = (0.2, 5.0)
MOST_IGNORED = 20.0
Auto = Literal["off", "continuous"]


@dataclass(frozen=True)
class Contrast:
    """What the live picture makes of grey levels; kept between frames unless ``auto`` is continuous.

    Attributes
    ----------
    low, high : float
        Grey levels shown as nothing and as full.
    gamma : float
        Above 1 lifts the dark.
    table : str
        Name of the colour table.
    paint : bool
        Pixels at the ends of the camera's scale are hatched.
    auto : str
        ``continuous`` follows every frame.
    ignored_percent : float
        Share of the darkest, and of the brightest pixels that may be cut off.
    """

    low: float = 0.0
    high: float = 4095.0
    gamma: float = 1.0
    table: str = "gray"
    paint: bool = True
    auto: Auto = "off"
    ignored_percent: float = 0.1


@dataclass(frozen=True, eq=False)
class Histogram:
    """How often grey levels occur.

    Attributes
    ----------
    counts : array (bins,)
        Pixels in bins of equal width from 0 to ``top``.
    top : int
        The largest grey level the camera can give.
    """

    counts: NDArray[np.int64]
    top: int

    @property
    def width(self) -> float:
        """Grey levels in a bin."""
        return (self.top + 1) / len(self.counts)

    @cached_property
    def bars(self) -> NDArray[np.float32]:
        """Heights of bars from 0 to 1, logarithmic."""
        heights = np.log1p(self.counts)
        return (heights / max(float(heights.max()), 1.0)).astype(np.float32)


def spread(histogram: Histogram, ignored_percent: float) -> tuple[float, float]:
    """Return the grey levels between which all but the ignored shares at both ends lie."""
    total = histogram.counts.cumsum()
    ignored = total[-1] * ignored_percent / 100
    first = int(np.searchsorted(total, ignored, side="right"))
    last = int(np.searchsorted(total, total[-1] - ignored, side="left"))
    low, high = first * histogram.width, (max(last, first) + 1) * histogram.width - 1
    if high > low:
        return low, high
    return max(low - 1, 0.0), min(low + 1, float(histogram.top))  # one level everywhere: grey, white only at full scale


def fitted(contrast: Contrast, histogram: Histogram) -> Contrast:
    """Return the contrast that fits a frame once."""
    low, high = spread(histogram, contrast.ignored_percent)
    return replace(contrast, low=low, high=high)


def followed(contrast: Contrast, histogram: Histogram) -> Contrast:
    """Return the contrast for the next frame: the same, unless it is to follow every one."""
    return fitted(contrast, histogram) if contrast.auto == "continuous" else contrast


def dragged(contrast: Contrast, end: Literal["low", "high"], level: float, top: int) -> Contrast:
    """Return the contrast with one end moved by hand, inside the camera's scale and never past the other end."""
    if end == "low":
        return replace(contrast, low=min(max(level, 0.0), contrast.high - 1), auto="off")
    return replace(contrast, high=max(min(level, float(top)), contrast.low + 1), auto="off")


def chosen(contrast: Contrast, *, gamma: float, table: str, paint: bool, ignored_percent: float) -> Contrast:
    """Return the contrast with what was chosen by hand, within what can be told apart."""
    gamma = min(max(gamma, GAMMAS[0]), GAMMAS[1])
    ignored_percent = min(max(ignored_percent, 0.0), MOST_IGNORED)
    return replace(contrast, gamma=gamma, table=table, paint=paint, ignored_percent=ignored_percent)


@cache
def colours(table: str) -> NDArray[np.float32]:
    """Return a colour table as a row of pixels, (1, 256, 3)."""
    return colour_table(table).reshape(1, TABLE_ENTRIES, 3)
