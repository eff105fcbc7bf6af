"""The focus measurement as operators: from the planes of a stack to pictures and range images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from processing.focus import focus_stack
from processing.focus_tracks import Method  # noqa: TC001  the operators' parameters are made from the annotations
from processing.focus_view import View, ViewedPlanes
from processing.operators import Layer, operator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from processing.focus import FocusResult

    Array = NDArray[Any]

RANGE_LAYERS = (
    Layer("extended_focus", dtype="volume"),
    Layer("range", dtype="float32"),
    Layer("confidence", dtype="float32"),
    Layer("width", dtype="float32"),
    Layer("plane", dtype="uint16"),
)


@operator("focus.stack", gives=RANGE_LAYERS)
def stack(
    volume: Array,
    z_um: Array | None = None,
    *,
    method: Method = "brightfield",
    threshold: float | None = None,
    band: int | None = None,
    register: bool = False,
) -> tuple[Array, ...]:
    """Measure extended focus and range along z.

    Parameters
    ----------
    volume : array (planes, height, width[, 3]) uint8 or uint16
    z_um : array (planes,), optional
        Positions, rising or falling.
    method, threshold, band
        As in `processing.focus.FocusSweep`.
    register : bool
        Match the planes by shift and scale first.

    Returns
    -------
    arrays
        Extended focus like a plane; range, confidence and width float32, plane uint16, as in
        `processing.focus.RangeImage`.

    Raises
    ------
    InputError
        Planes, positions or a threshold that make no sense.
    """
    return _layers(focus_stack(volume, z_um=z_um, method=method, threshold=threshold, band=band, register=register))


@operator("focus.view", gives=RANGE_LAYERS)
def view(
    volume: Array,
    z_um: Array | None = None,
    pixel_um: float | None = None,
    *,
    azimuth_deg: float = 0.0,
    tilt_deg: float = 0.0,
    method: Literal["confocal", "threshold"] = "confocal",
    threshold: float | None = None,
    band: int | None = None,
) -> tuple[Array, ...]:
    """Find the brightest voxel, or the first one over a threshold, along any direction.

    Parameters
    ----------
    volume, z_um, threshold, band
        As in `stack`.
    pixel_um : float, optional
        Size of a pixel.
    azimuth_deg, tilt_deg : float
        As in `processing.focus_view.View`.
    method : {"confocal", "threshold"}
        Which voxel is looked for.

    Returns
    -------
    arrays
        As `stack`, in the frame of the view: depth in µm along the line of sight, in pixels where ``z_um`` is unknown.

    Raises
    ------
    InputError
        As `processing.focus_view.ViewedPlanes`.
    """
    planes = ViewedPlanes(volume, z_um, pixel_um, View(azimuth_deg, tilt_deg), band=band)
    depth = None if z_um is None else planes.depth
    return _layers(focus_stack(planes, z_um=depth, method=method, threshold=threshold, register=False))


def _layers(result: FocusResult) -> tuple[Array, ...]:
    return result.extended_focus, result.range, result.confidence, result.width, result.plane
