"""What must be known of a whole stack before it is deblurred, found plane by plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.focus import plane_noise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


@dataclass(frozen=True)
class Known:
    """What must be known of a whole stack.

    Attributes
    ----------
    low, high : int
        Smallest and largest grey level.
    saturated : float
        Share of the voxels that are as bright as can be.
    background : float
        The first percentile.
    noise : float
        Of the camera, in grey levels.
    flat : tuple of int
        Planes that are one grey value everywhere.
    """

    low: int
    high: int
    saturated: float
    background: float
    noise: float
    flat: tuple[int, ...]


def known_of(volume: Array) -> Known:
    """Look at a stack, (planes, rows, columns)."""
    return summed([plane_said(plane) for plane in volume])


def plane_said(plane: Array) -> dict[str, Any]:
    """Look at one plane."""
    values, counts = np.unique(plane[::4, ::4], return_counts=True)
    return {
        "low": int(plane.min()),
        "high": int(plane.max()),
        "saturated": float(np.mean(plane >= np.iinfo(plane.dtype).max)),
        "noise": plane_noise(plane),
        "values": values.tolist(),
        "counts": counts.tolist(),
    }


def summed(said: list[dict[str, Any]]) -> Known:
    """Sum up what was said of every plane."""
    values = np.concatenate([s["values"] for s in said])
    flat = [k for k, s in enumerate(said) if s["low"] == s["high"]]
    noise = min((s["noise"] for k, s in enumerate(said) if k not in flat), default=said[0]["noise"])
    return Known(
        low=min(s["low"] for s in said),
        high=max(s["high"] for s in said),
        saturated=float(np.mean([s["saturated"] for s in said])),
        background=percentile(values, np.concatenate([s["counts"] for s in said]), 1.0),
        noise=noise,
        flat=tuple(flat),
    )


def percentile(values: Array, counts: Array, percent: float) -> float:
    """Return a percentile, linear between values, of values that are there so many times."""
    order = np.argsort(values)
    ends = np.cumsum(counts[order])
    place = (int(ends[-1]) - 1) * percent / 100
    low, high = (
        float(values[order][np.searchsorted(ends, rank, side="right")]) for rank in (int(place), -int(-place // 1))
    )
    return low + (high - low) * (place % 1)
