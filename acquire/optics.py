"""Steps between planes from the optics."""

from __future__ import annotations

import math

from devices.errors import PlanError


def nyquist_step_um(na: float, wavelength_um: float, medium_index: float = 1.0) -> float:
    """Return the axial Nyquist step in µm: half the inverse of the axial cut-off of a widefield microscope.

    ``λ / (2 n (1 - cos α))`` with ``sin α = NA / n``: the axial extent of the missing-cone transfer function is
    ``n (1 - cos α) / λ`` (Streibl, J. Opt. Soc. Am. A 2, 121, 1985).
    """
    return wavelength_um / (2 * medium_index * (1 - math.cos(_half_angle(na, medium_index))))


def depth_of_field_um(
    na: float, wavelength_um: float, medium_index: float = 1.0, magnification: float = 1.0, pixel_um: float = 0.0
) -> float:
    """Return the depth of field in µm: wave term plus the blur of one sensor pixel.

    ``λ n / NA² + n e / (M NA)`` (Inoué & Spring, Video Microscopy, 2nd ed., §2.5).
    """
    _half_angle(na, medium_index)
    return wavelength_um * medium_index / na**2 + medium_index * pixel_um / (magnification * na)


def _half_angle(na: float, medium_index: float) -> float:
    if not 0 < na < medium_index:
        raise PlanError(
            f"numerical aperture {na:g} is impossible in a medium of index {medium_index:g}.",
            fix="correct optics.na or optics.medium_index in the instrument file.",
        )
    return math.asin(na / medium_index)
