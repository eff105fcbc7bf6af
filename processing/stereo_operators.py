"""Elevation from a stereo pair as an operator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.elevation import Geometry, Method, elevation
from processing.operators import Layer, like, operator
from processing.stereo_geometry import tilted_pair

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

MAPS = (like("range", "volume", dtype="float32"), like("range_sigma", "volume", dtype="float32"))
PARALLAX = (like("parallax", "volume", dtype="float32"), Layer("plane_deg", dtype="float64"))


@operator("stereo.tilt", gives=[*MAPS, *PARALLAX])
def tilt(
    volume: Array,
    pixel_um: float,
    *,
    tilt_deg: float,
    left_deg: float | None = None,
    method: Method = "area",
    band_px: tuple[int, int] | None = None,
) -> tuple[Array, Array, Array, np.float64]:
    """Measure the height of a surface from two tilted views.

    Parameters
    ----------
    volume : array (2, height, width) uint8 or uint16
        Left and right view; the tilt axis runs along y.
    pixel_um : float
        Size of a pixel in the specimen.
    tilt_deg, left_deg, method, band_px
        As in ``stereotome process elevation``.

    Returns
    -------
    range, range_sigma : array (height, width) float32
        Height in µm on the left view, up positive, and its standard error; NaN where nothing is known.
    parallax : array (height, width) float32
        x_left − x_right in pixels.
    plane_deg : float
        Tilt of the mean plane.

    Raises
    ------
    InputError
        Views that cannot be matched, or numbers that make no sense.
    """
    if len(volume) != 2:
        raise InputError(
            f"a stereo pair has two views, there are {len(volume)}.", fix="give two pictures.", code="stereo-planes"
        )
    geometry = Geometry(tilted_pair(tilt_deg, left_deg=left_deg), pixel_um)
    found = elevation(volume[0], volume[1], geometry, method=method, band_px=band_px)
    return found.elevation_um, found.sigma_um, found.parallax_px, np.float64(found.plane.tilt_deg)
