"""Lengths, angles and profiles between points picked by hand, from a table."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from devices.errors import InputError
from processing.planes import side_of, slabs

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.neighbours import Spacing
    from processing.planes import Planes

    Array = NDArray[Any]

COLUMNS = ("name", "z", "y", "x")


@dataclass(frozen=True, eq=False)
class Picked:
    """One line of points.

    Attributes
    ----------
    name : str
    points : array (n, 3)
        (z, y, x) in voxels, from the middle of the first.
    """

    name: str
    points: Array

    def length_um(self, spacing_um: Spacing) -> float:
        """Length along all points."""
        steps = np.diff(self.points * np.array(spacing_um), axis=0)
        return float(np.linalg.norm(steps, axis=1).sum())

    def angles_deg(self, spacing_um: Spacing) -> list[float]:
        """Angle at each point between two others; 180 where the line goes straight on."""
        at = self.points * np.array(spacing_um)
        back, on = at[:-2] - at[1:-1], at[2:] - at[1:-1]
        lengths = np.linalg.norm(back, axis=1) * np.linalg.norm(on, axis=1)
        cosine = np.divide((back * on).sum(axis=1), lengths, out=np.ones(len(lengths)), where=lengths > 0)
        return [float(a) for a in np.degrees(np.arccos(np.clip(cosine, -1, 1)))]

    def profile(self, grey: Planes, spacing_um: Spacing) -> tuple[Array, Array]:
        """Return distances in µm along the line, a smallest side of a voxel apart, and the grey values there."""
        steps = np.linalg.norm(np.diff(self.points * np.array(spacing_um), axis=0), axis=1)
        along = np.concatenate([[0], np.cumsum(steps)])
        at = np.linspace(0, along[-1], max(2, round(along[-1] / min(spacing_um)) + 1))
        places = np.stack([np.interp(at, along, axis) for axis in self.points.T])
        places[0] = np.clip(places[0], 0, len(grey) - 1)
        values = np.empty(len(at))
        for start, slab in slabs(grey, after=1):
            here = (places[0] >= start) & (places[0] < start + side_of(grey))
            if here.any():
                within = places[:, here] - [[start], [0], [0]]
                values[here] = ndimage.map_coordinates(np.asarray(slab, np.float64), within, order=1, mode="nearest")
        return at, values


def read_picked(path: Path, shape: tuple[int, ...]) -> list[Picked]:
    """Read a table of points: name, z, y, x in voxels; those of one name, in order, are a line.

    Raises
    ------
    InputError
        ``points``: columns are missing, a place is no number or outside, or a name has one point.
    """
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        lines: dict[str, list[list[float]]] = {}
        for row in rows:
            lines.setdefault(row["name"], []).append([float(row[axis]) for axis in "zyx"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise _wrong(f"{path} cannot be read: {error}") from None
    if not lines:
        raise _wrong(f"{path} holds no points")
    for name, points in lines.items():
        at = np.array(points)
        if len(at) < 2:
            raise _wrong(f"{name!r} has one point")
        if not np.isfinite(at).all() or (at < -0.5).any() or (at > np.array(shape) - 0.5).any():
            raise _wrong(f"{name!r} has points outside of the volume of {shape}")
    return [Picked(name, np.array(points)) for name, points in lines.items()]


def _wrong(what: str) -> InputError:
    return InputError(
        f"{what}.", fix="give a CSV with columns name,z,y,x in voxels; two lines at least of each name.", code="points"
    )
