"""What can be read off one picture, or off two of the same place, to judge whether it is a good one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

PREBLUR_PX = 1.0
NOISE_BLUR_PX = 2.0
FACE_BLUR_PX = 1.5
COHERENT_BLUR_PX = 4.0
RANGE_QUANTILE = 0.002
RANGE_MARGIN = 0.03
LARGEST_FACE_PX = 512


@dataclass(frozen=True)
class Look:
    """What one picture says of itself.

    Attributes
    ----------
    mean, sd : float
        Brightness, and its standard deviation after noise was smoothed away; grey values.
    sharpness : float
        Energy of gradients over variance: independent of lamp and stain, falls with defocus.
    energy : float
        Energy of gradients over the square of the mean: of the planes of a stack the sharpest has most.
    saturated : float
        Share of pixels at the top of the scale.
    empty_rows : int
        Rows at the upper or lower end in which all pixels are equal: those a camera did not fill.
    """

    mean: float
    sd: float
    sharpness: float
    energy: float
    saturated: float
    empty_rows: int


def grey(pixels: np.ndarray) -> np.ndarray:
    """Return a picture as float32, bands averaged."""
    return np.asarray(pixels.mean(axis=2) if pixels.ndim == 3 else pixels, np.float32)


def look_at(pixels: np.ndarray, top: int) -> Look:
    """Measure a picture whose scale ends at ``top``."""
    picture = grey(pixels)
    mean, variance = float(picture.mean()), float(_smooth(picture, NOISE_BLUR_PX).var())
    energy = gradient_energy(picture)
    return Look(
        mean=mean,
        sd=variance**0.5,
        sharpness=energy / variance if variance else 0.0,
        energy=energy / mean**2 if mean else 0.0,
        saturated=float((pixels >= top).mean()),
        empty_rows=_empty_rows(pixels),
    )


def focus_energy(pixels: np.ndarray) -> float:
    """Return the energy of gradients over the square of the mean; of the planes of a stack the sharpest has most."""
    picture = grey(pixels)
    mean = float(picture.mean())
    return gradient_energy(picture) / mean**2 if mean else 0.0


def gradient_energy(picture: np.ndarray) -> float:
    """Return the mean square of the gradient after a slight blur, in (grey values / px)².

    Gradient energy ("tenengrad") is among the measures that bear noise best once it is smoothed (Pertuz, Puig, Garcia,
    Pattern Recognition 46, 2013).
    """
    smooth = _smooth(picture, PREBLUR_PX)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return float((across**2 + down**2).mean())


def face_of(pixels: np.ndarray) -> np.ndarray:
    """Return a picture for comparing faces: float32, binned to at most `LARGEST_FACE_PX`, of median 1."""
    picture = grey(pixels)
    factor = max(1, max(picture.shape) // LARGEST_FACE_PX)
    size = (max(1, picture.shape[1] // factor), max(1, picture.shape[0] // factor))
    binned = picture if factor == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(binned / max(float(np.median(binned)), 1.0), np.float32)


def grey_range(face: np.ndarray) -> tuple[float, float]:
    """Return between which brightnesses nearly all of a face lies."""
    low, high = np.quantile(_smooth(face, FACE_BLUR_PX), [RANGE_QUANTILE, 1 - RANGE_QUANTILE])
    return float(low), float(high)


def out_of_range(face: np.ndarray, low: float, high: float) -> float:
    """Return how much of a face is darker or brighter than anything before: an area in px, its square root.

    Parts of a pixel count by how far they are out, in units of the whole range, less a margin.
    """
    smooth = _smooth(face, FACE_BLUR_PX)
    beyond = np.maximum(smooth - high, low - smooth) / max(high - low, 1e-6) - RANGE_MARGIN
    return float(np.sqrt(np.maximum(beyond, 0).sum()))


def coherent_change(face: np.ndarray, before: np.ndarray) -> float:
    """Return the largest change that neighbouring pixels have in common, in standard deviations of the face before.

    Structures that moved a little change in both directions side by side, and cancel; what lies on them does not.
    """
    spread = float(before.std())
    return float(np.abs(_smooth(face - before, COHERENT_BLUR_PX)).max()) / spread if spread else 0.0


def shared_change(face: np.ndarray, before: np.ndarray) -> float:
    """Return which share of the difference of two faces is coarse: 0.005 of noise, a few times that of defocus.

    Smoothing leaves 1/(4πσ²) of the variance of noise that is independent from pixel to pixel, much of a structure's.
    """
    difference = face - before
    variance = float(difference.var())
    return float(_smooth(difference, COHERENT_BLUR_PX).var()) / variance if variance else 0.0


def _smooth(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px))


def _empty_rows(pixels: np.ndarray) -> int:
    """Return the longer of the two runs of uniform rows at the ends of a picture."""
    rows = pixels.reshape(len(pixels), -1)
    filled = np.flatnonzero(rows.min(axis=1) != rows.max(axis=1))
    return int(max(filled[0], len(rows) - 1 - filled[-1])) if filled.size else len(rows)
