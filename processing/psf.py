"""Point spread functions: how one point of the specimen appears in the planes of a stack.

Modelled from the optics, or measured on beads. All are (planes, rows, columns) float32, odd sides, the point in the
middle, sum 1; spacings are (dz, dy, dx) in µm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter, label, maximum_position, shift
from scipy.special import j0

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Spacing = tuple[float, float, float]

PUPIL_STEPS = 200
RADIAL_STEPS = 4  # per pixel
SUB_PIXELS = 3  # a pixel is the mean of 3×3 points
MOST_SIDE = 201
BEAD_OVER_NOISE = 10.0


@dataclass(frozen=True)
class Optics:
    """What a scalar point spread function is made of.

    Attributes
    ----------
    na : float
        Numerical aperture.
    wavelength_um : float
        Of the light that is seen, in vacuum.
    index : float
        Refractive index of the immersion that the objective is made for.
    specimen_index : float, optional
        Index of what the point lies in; that of the immersion when left out.
    depth_um : float
        How deep in the specimen below the cover glass the point lies.

    Raises
    ------
    InputError
        ``deblur-optics``: values that no objective has.
    """

    na: float
    wavelength_um: float
    index: float = 1.0
    specimen_index: float | None = None
    depth_um: float = 0.0

    def __post_init__(self) -> None:
        values = (self.na, self.wavelength_um, self.index, self.specimen_index or 1.0, self.depth_um)
        if not np.isfinite(values).all() or not 0 < self.na < self.index or not 0.1 < self.wavelength_um < 10:
            raise InputError(
                f"no objective has NA {self.na:g} in index {self.index:g} at {self.wavelength_um:g} µm.",
                why="The aperture must be positive and below the index, the wavelength in µm.",
                fix="for example --na 0.8 --wavelength-um 0.525 --index 1.0",
                code="deblur-optics",
            )


def modelled(optics: Optics, spacing_um: Spacing, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Compute the scalar point spread function of a widefield microscope.

    Parameters
    ----------
    optics : Optics
    spacing_um : (dz, dy, dx)
        Of the result.
    shape : (planes, rows, columns)
        Odd numbers.

    Returns
    -------
    array float32
        Sum 1.

    Notes
    -----
    h(r, z) = |∫₀¹ J₀(k NA r ρ) exp(i k W(ρ, z)) ρ dρ|². W = z √(n² − NA² ρ²) is the defocus in the immersion; a point d
    deep in another index adds d √(nₛ² − NA² ρ²), less the focus that it shifts (Gibson and Lanni 1992, J. Opt. Soc.
    Am. A 9:154). For equal indices this is Born and Wolf's function without the small-angle approximation.
    """
    if min(shape) < 1 or any(n % 2 == 0 for n in shape):
        raise InputError(f"a point spread function of {shape} has no middle.", fix="odd numbers", code="deblur-psf")
    dz, dy, dx = spacing_um
    planes, rows, columns = shape
    inner = (np.arange(SUB_PIXELS) - (SUB_PIXELS - 1) / 2) / SUB_PIXELS
    y = dy * ((np.arange(rows) - rows // 2)[:, np.newaxis] + inner)
    x = dx * ((np.arange(columns) - columns // 2)[:, np.newaxis] + inner)
    distance = np.hypot(y.reshape(-1, 1), x.reshape(1, -1))
    radii = np.arange(0, distance.max() + dx, dx / RADIAL_STEPS / SUB_PIXELS)
    profile = radial(optics, radii, dz * (np.arange(planes) - planes // 2))
    sampled = np.array([np.interp(distance, radii, line) for line in profile])
    psf = sampled.reshape(planes, rows, SUB_PIXELS, columns, SUB_PIXELS).mean((2, 4))
    return np.asarray(psf / psf.sum(), np.float32)


def radial(optics: Optics, radii_um: Array, defocus_um: Array) -> NDArray[np.float64]:
    """Intensity at distances from the axis for every defocus, (planes, radii)."""
    wave = 2 * np.pi / optics.wavelength_um
    rho, weight = (np.asarray(a) for a in np.polynomial.legendre.leggauss(PUPIL_STEPS))
    rho, weight = (rho + 1) / 2, weight / 2
    immersion = np.sqrt(optics.index**2 - (optics.na * rho) ** 2)
    phase = np.outer(defocus_um, immersion - optics.index) + aberration(optics, rho)
    pupil = np.exp(1j * wave * phase) * (rho * weight)
    amplitude = pupil @ j0(wave * optics.na * np.outer(rho, radii_um))
    return np.asarray(np.abs(amplitude) ** 2)


def aberration(optics: Optics, rho: Array) -> NDArray[np.float64]:
    """Path difference in µm of a point deep in another index, without piston and without the defocus it also makes."""
    if optics.specimen_index is None or not optics.depth_um:
        return np.zeros_like(rho)
    outside = np.sqrt(optics.index**2 - (optics.na * rho) ** 2)
    path = optics.depth_um * np.sqrt(np.maximum(optics.specimen_index**2 - (optics.na * rho) ** 2, 0))
    columns = np.stack([np.ones_like(rho), outside], 1) * np.sqrt(rho)[:, np.newaxis]
    focus = np.linalg.lstsq(columns, path * np.sqrt(rho), rcond=None)[0]
    return np.asarray(path - focus[0] - focus[1] * outside)


def support(optics: Optics, spacing_um: Spacing, planes: int) -> tuple[int, int, int]:
    """Shape that holds nearly all of the light: the cone over half of the stack's planes, and some rings."""
    dz, dy, dx = spacing_um
    half = min(planes // 2, max(2, int(np.ceil(6 * optics.wavelength_um * optics.index / optics.na**2 / dz))))
    angle = np.tan(np.arcsin(optics.na / optics.index))
    reach = half * dz * angle + 2 * optics.wavelength_um / optics.na
    sides = [min(MOST_SIDE, 2 * int(np.ceil(reach / d)) + 1) for d in (dy, dx)]
    return 2 * half + 1, sides[0], sides[1]


def from_beads(volume: Array, half: tuple[int, int, int]) -> tuple[NDArray[np.float32], int]:
    """Measure the point spread function on beads: found, centred to a fraction of a voxel, summed.

    Parameters
    ----------
    volume : array (planes, rows, columns)
        Small bright beads, apart from each other, on dark.
    half : (planes, rows, columns)
        Half of the size wanted.

    Returns
    -------
    array float32, int
        Sum 1, and the number of beads.

    Raises
    ------
    InputError
        ``deblur-beads``: no bead lies alone and whole within the volume.
    """
    data = volume.astype(np.float32)
    ground = float(np.median(data))
    places = bead_places(data - ground, half)
    whole = [centred(data - ground, place, half) for place in places]
    if not whole:
        raise InputError(
            "no bead lies alone and whole in the stack.",
            why=f"Beads need {half[0]} planes above and below, and {half[1]}×{half[2]} pixels around.",
            fix="a stack of few beads, brightest not saturated, that goes well beyond their focus",
            code="deblur-beads",
        )
    mean = np.maximum(np.mean([bead / bead.sum() for bead in whole], 0), 0)
    return (mean / mean.sum()).astype(np.float32), len(whole)


def bead_places(data: Array, half: Sequence[int]) -> list[tuple[int, ...]]:
    """Brightest voxels of all beads that have no other one within their box, and whose box lies in the volume."""
    smooth = gaussian_filter(data, 1)
    noise = 1.4826 * float(np.median(np.abs(smooth - np.median(smooth))))
    parts, count = label(smooth > max(0.25 * float(smooth.max()), BEAD_OVER_NOISE * noise))
    found = [tuple(int(i) for i in p) for p in maximum_position(smooth, parts, range(1, count + 1))] if count else []
    return [p for p in found if fits(p, data.shape, half) and alone(p, found, half)]


def fits(place: Sequence[int], shape: Sequence[int], half: Sequence[int]) -> bool:
    """Tell whether the box around a place lies in the volume."""
    return all(h <= p < n - h for p, n, h in zip(place, shape, half, strict=True))


def alone(place: Sequence[int], others: Sequence[Sequence[int]], half: Sequence[int]) -> bool:
    """Tell whether no other place lies within the box around one."""
    near = [o for o in others if all(abs(a - b) <= h for a, b, h in zip(place, o, half, strict=True))]
    return len(near) == 1


def centred(data: Array, place: Sequence[int], half: Sequence[int]) -> NDArray[np.float32]:
    """Cut a bead out, its centre of mass moved to the middle voxel."""
    box = data[tuple(slice(p - h, p + h + 1) for p, h in zip(place, half, strict=True))]
    core = np.where(box > 0.5 * box.max(), box, 0)
    away = np.array(center_of_mass(core)) - np.array(half)
    return np.asarray(shift(box, -away, order=3, mode="nearest"), np.float32)


def checked_psf(psf: Array) -> NDArray[np.float32]:
    """Return a point spread function from a file, made to sum 1.

    Raises
    ------
    InputError
        ``deblur-psf``: no volume of odd sides, or no light.
    """
    if psf.ndim != 3 or any(n % 2 == 0 for n in psf.shape) or not np.isfinite(psf).all() or not psf.sum() > 0:
        raise InputError(
            f"a point spread function of shape {psf.shape} cannot be used.",
            why="It must be a volume of odd sides, of finite numbers, with light in it.",
            fix="measure it: stereotome process psf BEADS -o DIR",
            code="deblur-psf",
        )
    positive = np.maximum(psf.astype(np.float64), 0)
    return np.asarray(positive / positive.sum(), np.float32)
