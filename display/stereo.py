"""What makes a picture stereoscopic: which two views, how far apart, how they are shown. Plain values, pure functions.

The camera looks along -z of view space; the plane at z = -distance lies in the screen. Moving an eye by e/2 to its side
while its frustum keeps that plane in place is, for parallel and for perspective projection alike, the shear
x' = x ± (z + distance) tan(V/2) before the projection, V = 2 atan(e / 2 distance) being the vergence: the shift of
planes and the off-axis frustum are one. There is no vertical parallax and nothing is foreshortened. Turning the
specimen by ±V/2 instead is what a tilting stage does; it is offered for comparison with such pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from devices.errors import DisplayError, did_you_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from devices.glasses_timing import Eye

    Matrix = NDArray[np.float64]

Views = Literal["shift", "rotate"]
Mode = Literal[
    "mono",
    "parallel",
    "crossed",
    "over-under",
    "rows",
    "columns",
    "checkerboard",
    "frame-packed",
    "anaglyph-grey",
    "anaglyph-colour",
    "anaglyph-half-colour",
    "anaglyph-dubois",
    "anaglyph-dubois-lcd",
    "anaglyph-optimised",
    "anaglyph-green-magenta",
    "anaglyph-amber-blue",
    "anaglyph-red-green",
    "anaglyph-red-blue",
    "page-flip",
]
MODES: tuple[str, ...] = get_args(Mode)

WIDEST_ANGLE_DEG = 60.0
UNEASY_ANGLE_DEG = 10.0  # eyes hardly fuse views that differ by more
COMFORTABLE_SHARE = 1 / 30  # largest parallax on a screen, as a share of the picture's width
ROUNDING = 1e-3


def vergence_deg(interocular_mm: float, distance_mm: float) -> float:
    """Return the angle between the lines of sight of two eyes that look at one point: 75 mm at 1 m make 4.3°.

    Raises
    ------
    DisplayError
        A length that is not positive.
    """
    if not (math.isfinite(distance_mm) and math.isfinite(interocular_mm) and distance_mm > 0 <= interocular_mm):
        raise DisplayError(
            f"no vergence of eyes {interocular_mm:g} mm apart at {distance_mm:g} mm.", fix="give lengths in mm."
        )
    return math.degrees(2 * math.atan2(interocular_mm / 2, distance_mm))


@dataclass(frozen=True)
class Stereo:
    """How two eyes see a scene.

    Attributes
    ----------
    mode : str
        One of `MODES`; ``mono`` draws one view from between the eyes.
    views : {"shift", "rotate"}
        The eyes move and the screen stays (shift of planes, off-axis frusta), or the specimen turns.
    vergence_deg : float
        Angle between the two lines of sight, 0 to 60; see `vergence_deg`.
    depth : float
        Stretches depth about the plane of the screen; negative turns relief inside out.
    swap : bool
        Exchange the eyes.

    Raises
    ------
    DisplayError
        Values that make no sense.
    """

    mode: Mode = "mono"
    views: Views = "shift"
    vergence_deg: float = vergence_deg(75.0, 1000.0)
    depth: float = 1.0
    swap: bool = False

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise DisplayError(f"stereo: no mode '{self.mode}'{did_you_mean(self.mode, list(MODES))}.")
        if self.views not in get_args(Views):
            raise DisplayError(f"stereo: no views '{self.views}'{did_you_mean(self.views, list(get_args(Views)))}.")
        if not (0 <= self.vergence_deg <= WIDEST_ANGLE_DEG and math.isfinite(self.depth)):
            raise DisplayError(
                f"stereo: no two views {self.vergence_deg:g}° apart with depth × {self.depth:g}.",
                fix=f"choose an angle from 0 to {WIDEST_ANGLE_DEG:g}°, and a number for depth.",
            )

    @property
    def eyes(self) -> tuple[Eye | None, ...]:
        """Whose views have to be drawn, left first; None is the view from between the eyes."""
        return (None,) if self.mode == "mono" else ("left", "right")

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes every picture of these eyes hard to look at."""
        return () if self.mode == "mono" else angle_warnings(self.vergence_deg)


def eye_matrix(stereo: Stereo, eye: Eye | None, distance: float) -> Matrix:
    """Return what an eye does to view space, as a matrix to stand between view and projection.

    Parameters
    ----------
    stereo : Stereo
        How the eyes see.
    eye : {"left", "right"} or None
        Whose; None is the view from between the eyes, in which depth alone is stretched.
    distance : float
        From the camera to the plane that lies in the screen, in units of view space.

    Returns
    -------
    array (4, 4)
        Works on columns (x, y, z, 1).
    """
    side = {"left": 1.0, "right": -1.0, None: 0.0}[eye]
    half = math.radians(stereo.vergence_deg) / 2 * side
    turned = _sheared(math.tan(half)) if stereo.views == "shift" else _turned(half)
    stretched = np.diag([1.0, 1.0, stereo.depth, 1.0])
    return _moved(-distance) @ turned @ stretched @ _moved(distance)


def _moved(z: float) -> Matrix:
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def _sheared(slope: float) -> Matrix:
    matrix = np.eye(4)
    matrix[0, 2] = slope
    return matrix


def _turned(angle: float) -> Matrix:
    matrix = np.eye(4)
    matrix[0, [0, 2]] = math.cos(angle), math.sin(angle)
    matrix[2, [0, 2]] = -math.sin(angle), math.cos(angle)
    return matrix


def plane_shifts(positions_um: NDArray[np.float64], pixel_um: float, vergence_deg: float, eye: Eye) -> Matrix:
    """Return by how many pixels each plane is shifted to the right for an eye that looks down on a stack.

    Parameters
    ----------
    positions_um : array (planes,)
        Depth of each plane, larger nearer to the eyes; the plane at 0 lies in the screen.
    """
    side = 1.0 if eye == "left" else -1.0
    return positions_um * (side * math.tan(math.radians(vergence_deg) / 2) / pixel_um)


def angle_warnings(angle_deg: float) -> tuple[str, ...]:
    """Return a warning for angles under which the two views are hard to fuse."""
    if angle_deg <= UNEASY_ANGLE_DEG:
        return ()
    return (f"views {angle_deg:g}° apart are hard to fuse; up to {UNEASY_ANGLE_DEG:g}° is easy.",)


def parallax_warnings(widest_px: float, width_px: int) -> tuple[str, ...]:
    """Return a warning if a parallax is wider than 1/30 of the picture."""
    comfortable = COMFORTABLE_SHARE * width_px
    if abs(widest_px) <= comfortable * (1 + ROUNDING):
        return ()
    return (
        f"parallax reaches {abs(widest_px):.1f} px; more than {comfortable:.1f} px (1/30 of the width) tires the eyes.",
    )
