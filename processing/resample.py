"""To cubic voxels: planes interpolated along z, or pixels binned within them; a few planes in memory at a time."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from devices.errors import InputError
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.registration import Planes

    Array = NDArray[Any]

NAME, TITLE = "resampled", "resampled to cubic voxels"  # of the volume in files
Method = Literal["nearest", "linear", "cubic", "bin"]
BIN_FROM = 3.0  # step over pixel from which binning loses less than interpolation invents
KEPT = 4  # planes in memory, as many as a cubic needs
MOST_VOXELS = 1 << 36
ENLARGED = {"nearest": cv2.INTER_NEAREST, "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}


def choose_method(step_um: float, pixel_um: float) -> tuple[Method, str]:
    """Choose between interpolation and binning; returns the reason, too."""
    ratio = step_um / pixel_um
    if ratio > BIN_FROM:
        return "bin", f"planes are {ratio:.3g} pixels apart, more than {BIN_FROM:g}: pixels are binned to that size."
    return "linear", f"planes are {ratio:.3g} pixels apart: new planes are interpolated between them."


@dataclass(frozen=True)
class Taps:
    """What a new plane is made of: indices of planes, and their weights."""

    planes: tuple[int, ...]
    weights: tuple[float, ...]


def taps(z_um: NDArray[np.float64], at_um: float, method: Method) -> Taps:
    """Return what the plane at ``at_um`` is made of.

    Parameters
    ----------
    z_um : array (planes,)
        Rising positions.
    at_um : float
        Within them.
    method : Method
        linear; cubic: Hermite's with tangents by finite differences, Catmull and Rom's for even steps; else the nearest
        plane.
    """
    low = int(np.clip(np.searchsorted(z_um, at_um, side="right") - 1, 0, z_um.size - 2))
    step = z_um[low + 1] - z_um[low]
    t = float((at_um - z_um[low]) / step)
    if method in {"nearest", "bin"}:
        return Taps((low + int(t > 0.5),), (1.0,))
    if method == "linear":
        return _without_zeros({low: 1 - t, low + 1: t})
    weights = {low: (1 + 2 * t) * (1 - t) ** 2, low + 1: t * t * (3 - 2 * t)}
    for knot, part in ((low, t * (1 - t) ** 2), (low + 1, t * t * (t - 1))):
        before, after = max(knot - 1, 0), min(knot + 1, z_um.size - 1)
        slope = part * step / (z_um[after] - z_um[before])
        weights[after] = weights.get(after, 0.0) + slope
        weights[before] = weights.get(before, 0.0) - slope
    return _without_zeros(weights)


def _without_zeros(weights: dict[int, float]) -> Taps:
    kept = {plane: float(weight) for plane, weight in weights.items() if abs(weight) > 1e-12}
    return Taps(tuple(kept), tuple(kept.values()))


class CubicPlanes:
    """Planes of cubic voxels, each made when it is asked for.

    Parameters
    ----------
    planes : sequence of arrays (height, width[, 3]) uint8 or uint16
    z_um : array (planes,)
        Positions, rising or falling, even or not.
    pixel_um, side_um : float
        Size of a pixel, and the side wanted of a voxel.
    method : Method

    Raises
    ------
    InputError
        ``resample-spacing``: sizes that are not positive, a single plane, or more voxels than make sense.
    """

    def __init__(self, planes: Planes, z_um: Array, pixel_um: float, side_um: float, method: Method) -> None:
        if len(planes) < 2 or not all(np.isfinite(s) and s > 0 for s in (pixel_um, side_um)):
            raise InputError(
                f"{len(planes)} planes with pixels of {pixel_um:g} µm cannot become voxels of {side_um:g} µm.",
                fix="give two planes or more, and sizes above 0: --pixel-um 0.2 --side-um 0.2",
                code="resample-spacing",
            )
        self._planes, self.method, self.side_um = planes, method, side_um
        self._order = np.argsort(z_um)
        self._z = np.asarray(z_um, np.float64)[self._order]
        count = np.floor(np.ptp(self._z) / side_um + 1e-6) + 1
        height, width = planes[0].shape[:2]
        self.shape = (max(1, round(height * pixel_um / side_um)), max(1, round(width * pixel_um / side_um)))
        self._shrinks = side_um > pixel_um
        self.pixel_um = pixel_um * height / self.shape[0]
        self._held: OrderedDict[int, Array] = OrderedDict()
        if count * self.shape[0] * self.shape[1] > MOST_VOXELS:
            raise InputError(
                f"voxels of {side_um:g} µm would be {count:.3g}×{self.shape[0]:.3g}×{self.shape[1]:.3g}.",
                fix="larger voxels: --side-um",
                code="resample-spacing",
            )
        self.z_um = self._z[0] + side_um * np.arange(int(count))

    def __len__(self) -> int:
        return int(self.z_um.size)

    def __getitem__(self, k: int) -> Array:
        made = taps(self._z, float(self.z_um[k]), self.method)
        parts = [self._plane(i) for i in made.planes]
        if len(parts) == 1:
            return parts[0]
        total = sum(np.float32(w) * p.astype(np.float32) for w, p in zip(made.weights, parts, strict=True))
        return np.clip(np.rint(total), 0, np.iinfo(parts[0].dtype).max).astype(parts[0].dtype)

    def _plane(self, i: int) -> Array:
        if i not in self._held:
            self._held[i] = self._sized(self._planes[int(self._order[i])])
            if len(self._held) > KEPT:
                self._held.popitem(last=False)
        return self._held[i]

    def _sized(self, plane: Array) -> Array:
        if plane.shape[:2] == self.shape:
            return plane
        how = cv2.INTER_AREA if self._shrinks else ENLARGED.get(self.method, cv2.INTER_LINEAR)
        how = cv2.INTER_NEAREST if self.method == "nearest" else how
        return np.asarray(cv2.resize(plane, self.shape[::-1], interpolation=how))


@operator("volume.cubic", gives=[Layer("volume", dtype="volume"), Layer("z_um", dtype="float64"), Layer("pixel_um")])
def cubic(
    volume: Array,
    z_um: Array,
    pixel_um: float,
    *,
    side_um: float | None = None,
    method: Literal["auto", "nearest", "linear", "cubic", "bin"] = "auto",
) -> tuple[Array, Array, float]:
    """Make the voxels cubic.

    Parameters
    ----------
    volume : array (planes, height, width[, 3]) uint8 or uint16
    z_um : array (planes,)
        Positions, rising or falling.
    pixel_um : float
        Size of a pixel.
    side_um : float
        Side of the voxels; a pixel's, or when binning the mean step of the planes, when left out.
    method : str
        Interpolation along z: nearest, linear, cubic; bin: means of pixels; auto: bin beyond 3 pixels a step.

    Returns
    -------
    array, array, float
        Volume, positions of its planes (rising), size of a pixel.

    Raises
    ------
    InputError
        As `CubicPlanes`.
    """
    step = mean_step(z_um)
    chosen = choose_method(step, pixel_um)[0] if method == "auto" else method
    planes = CubicPlanes(volume, z_um, pixel_um, side_um or default_side(chosen, step, pixel_um), chosen)
    made = np.stack([planes[k] for k in range(len(planes))])
    return made, planes.z_um, planes.pixel_um


def mean_step(z_um: Array) -> float:
    """Mean distance of planes; 1 for a single one."""
    return float(np.ptp(z_um)) / (len(z_um) - 1) if len(z_um) > 1 else 1.0


def default_side(method: Method, step_um: float, pixel_um: float) -> float:
    """Side of a voxel that needs the least change."""
    return step_um if method == "bin" else pixel_um
