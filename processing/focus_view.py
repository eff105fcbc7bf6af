"""A volume looked at from any direction: the planes that lie square to the line of sight, cut as they are asked for.

What `processing.focus` does along z it does along any direction on these: depth of the brightest voxel, first voxel
over a threshold.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from devices.errors import InputError
from processing.focus_tracks import brightness, one_band
from processing.memory import check_memory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.registration import Planes

    Array = NDArray[Any]

BYTES_PER_PIXEL = 3 * 8 + 3 * 8  # three coordinates of a plane, and what is needed to compute them


@dataclass(frozen=True)
class View:
    """A direction to look along.

    Attributes
    ----------
    azimuth_deg : float
        Towards where the line of sight leans: 0 is +x (right), 90 is +y (down).
    tilt_deg : float
        How far it leans from the z axis; 0 looks along rising z, 180 against it.

    Raises
    ------
    InputError
        ``focus-view``: an angle that is not finite.
    """

    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite([self.azimuth_deg, self.tilt_deg]).all():
            raise InputError(
                "a view along angles that are no numbers.",
                fix="give both in degrees: --azimuth-deg 30 --tilt-deg 40",
                code="focus-view",
            )

    def axes(self) -> NDArray[np.float64]:
        """Right, down and line of sight of the picture as rows in (x, y, z): a rotation.

        The turn is about the direction in the plane that is square to the azimuth (Rodrigues' formula).
        """
        azimuth, tilt = np.deg2rad([self.azimuth_deg, self.tilt_deg])
        x, y = -np.sin(azimuth), np.cos(azimuth)
        cross = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
        return np.asarray(turn.T)


class ViewedPlanes:
    """Planes of a volume square to a view, nearest first; cubic voxels of the side of a pixel, linear in between.

    Parameters
    ----------
    planes : sequence of arrays (height, width[, 3]) uint8 or uint16
    z_um : array (planes,), optional
        Positions, rising or falling; plane numbers when left out.
    pixel_um : float, optional
        Size of a pixel; as large as the mean step of z when left out.
    view : View
        Where to look from.
    band : int, optional
        Of colour planes; their luminance when left out.

    Raises
    ------
    InputError
        ``memory``: the volume is too large to be held; ``focus-view``: a single plane.
    """

    def __init__(
        self,
        planes: Planes,
        z_um: Array | None,
        pixel_um: float | None,
        view: View,
        *,
        band: int | None = None,
    ) -> None:
        if len(planes) < 2:
            raise InputError("one plane has no sides to look from.", fix="give a volume.", code="focus-view")
        first = brightness(one_band(planes[0], band))[0]
        check_memory(len(planes) * first.nbytes, "a view of the volume", "bin it first: stereotome process resample")
        z = np.arange(len(planes), dtype=np.float64) if z_um is None else np.asarray(z_um, np.float64)
        order = np.argsort(z)
        self._volume = np.stack([brightness(one_band(planes[k], band))[0] for k in order])
        self._z = z[order]
        self.pixel = pixel_um or float(np.ptp(z)) / (len(planes) - 1)
        self._axes = view.axes()
        low, high = self._extent()
        self._low = low
        self.shape = (int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1)
        self.depth = self.pixel * (low[2] + np.arange(int(np.ceil(high[2] - low[2] - 1e-6)) + 1))

    def _extent(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of the volume along the axes of the view, in pixels."""
        height, width = self._volume.shape[1:]
        sides = ((-(width - 1) / 2, (width - 1) / 2), (-(height - 1) / 2, (height - 1) / 2))
        corners = np.array(list(product(*sides, (self._z[0] / self.pixel, self._z[-1] / self.pixel)))) @ self._axes.T
        return np.round(corners.min(0), 6), np.round(corners.max(0), 6)

    def __len__(self) -> int:
        return int(self.depth.size)

    def __getitem__(self, k: int) -> Array:
        rows, columns = (np.arange(n) + start for n, start in zip(self.shape, self._low[1::-1], strict=True))
        across, down, ahead = self._axes
        place = [
            across[a] * columns + (down[a] * rows)[:, np.newaxis] + ahead[a] * self.depth[k] / self.pixel
            for a in range(3)
        ]
        height, width = self._volume.shape[1:]
        index = (
            np.interp(place[2] * self.pixel, self._z, np.arange(self._z.size), left=-2, right=-2),
            place[1] + (height - 1) / 2,
            place[0] + (width - 1) / 2,
        )
        return np.asarray(map_coordinates(self._volume, np.stack(index), order=1, output=self._volume.dtype))
