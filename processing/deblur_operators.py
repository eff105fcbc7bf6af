"""Deblurring as operators: a point spread function from the optics, and three ways to use it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.deblur import noise_over_signal, richardson_lucy, van_cittert, wiener
from processing.operators import Layer, like, operator
from processing.psf import Optics, modelled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


@operator("deblur.psf", gives=[Layer("psf", dtype="float32")])
def psf(
    spacing_um: tuple[float, float, float],
    *,
    na: float,
    wavelength_um: float,
    index: float = 1.0,
    planes: int = 17,
    side_px: int = 31,
) -> Array:
    """Compute the point spread function of a widefield microscope.

    Parameters
    ----------
    spacing_um : (dz, dy, dx)
        Size of a voxel.
    na, wavelength_um, index : float
        As in `processing.psf.Optics`.
    planes, side_px : int
        Its size, odd.

    Returns
    -------
    array (planes, side_px, side_px) float32
        Sum 1.

    Raises
    ------
    InputError
        ``deblur-optics`` or ``deblur-psf``.
    """
    return modelled(Optics(na, wavelength_um, index), spacing_um, (planes, side_px, side_px))


@operator("deblur.richardson_lucy", gives=[like("volume", dtype="float32")])
def restore_richardson_lucy(
    volume: Array, psf: Array, *, noise: float, background: float = 0.0, most_steps: int = 30
) -> Array:
    """Restore fluorescence by the accelerated Richardson-Lucy iteration; the background is taken away.

    Parameters
    ----------
    volume, psf, noise, background, most_steps
        As in `processing.deblur.richardson_lucy`.

    Returns
    -------
    array float32
        Light of every voxel in grey levels, not negative.
    """
    return richardson_lucy(volume, psf, noise=noise, background=background, most_steps=most_steps).volume


@operator("deblur.van_cittert", gives=[like("volume", dtype="float32")])
def restore_van_cittert(
    volume: Array, psf: Array, *, noise: float, background: float = 0.0, neighbours: int = 2, most_steps: int = 15
) -> Array:
    """Restore by Van Cittert's relaxed iteration over neighbouring planes; the background is taken away.

    Parameters
    ----------
    volume, psf, noise, background, neighbours, most_steps
        As in `processing.deblur.van_cittert`.

    Returns
    -------
    array float32
        Grey levels, not negative.
    """
    options = {"noise": noise, "background": background, "neighbours": neighbours, "most_steps": most_steps}
    return van_cittert(volume, psf, **options).volume  # type: ignore[arg-type]


@operator("deblur.wiener", gives=[like("volume", dtype="float32")])
def restore_wiener(volume: Array, psf: Array, *, noise: float, background: float = 0.0) -> Array:
    """Restore by the Wiener inverse, noise over signal estimated from the volume; the background is taken away.

    Parameters
    ----------
    volume, psf, noise, background
        As in `processing.deblur.richardson_lucy`.

    Returns
    -------
    array float32
        Grey levels; may be negative beside bright features.
    """
    light = volume.astype(np.float32) - np.float32(background)
    return wiener(light, psf, noise_share=noise_over_signal(light, noise))
