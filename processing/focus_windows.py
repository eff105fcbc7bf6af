"""Peaks of sharpness in windows of several sizes, and the choice between them.

A small window keeps the relief and the edges, a wide one still sees the peak where the texture is faint. Every pixel is
measured in the smallest window whose peak stands out of the camera's noise and is not the blur of a stronger neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from processing.focus_kernels import SAMPLES, explained, fit_peaks, track_peak, widen

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


@dataclass(frozen=True)
class Window:
    """What the peak of a window must show before it is believed; the widest window always has a say.

    Attributes
    ----------
    significance : float
        Rise of the peak above the mean, in units of the sharpness that the camera's noise alone makes.
    contrast : float
        The same rise in units of the mean without that noise.
    scatter : float
        Standard deviation of the sharpness of white noise from plane to plane, in units of its mean.
    """

    significance: float
    contrast: float
    scatter: float

    def noise_peak(self, planes: int) -> float:
        """Confidence that the highest of so many planes of noise reaches in one pixel of a thousand, and some more.

        Noise of 99.9 % of the pixels stays below (2.7 + 0.95 ln planes) times the scatter (a fit to made noise of 10 to
        60 planes); the noise of few photons, cut off at zero, or along the border scatters up to 1.5 times as much.
        """
        return 1.5 * self.scatter * (2.7 + 0.95 * float(np.log(planes)))


# Each window is twice as wide as the one before: about 2, 4, 8 and 16 pixels rms.
WINDOWS = (
    Window(1.2, 2.0, 0.24),
    Window(0.65, 1.2, 0.113),
    Window(0.4, 0.8, 0.057),
    Window(0.0, 0.0, 0.029),
)
CONFIDENT = 0.8  # confidence from which a range counts as sure
HALO = 0.25  # a peak weaker than this share of its wider window's is the blurred image of a neighbour
WIDEST_REACH = np.ones((9, 9), np.uint8)  # bins of the widest window over which what is sharp has a say
BLUR_REACH = 8.0  # pixels of the plane over which an edge is spread a focus curve's width away from its focus
HALVED = 2  # pixels of the plane in one of the finest window
NOISE_ENERGY = 0.375  # mean squared Sobel gradient of white noise of variance 1, both directions


class Fit(NamedTuple):
    """The peaks of one window, arrays of its shape, float32: position, confidence, width of the curve, top value."""

    position: Array
    confidence: Array
    width: Array
    top: Array


class PeakTrack:
    """Running peak through the planes for every pixel of one window: the peak, two samples on either side, the sum."""

    def __init__(self, shape: tuple[int, int], dtype: type[Any]) -> None:
        self._shape = shape
        size = shape[0] * shape[1]
        self._samples = np.zeros((SAMPLES, size), dtype)
        self._recent = [np.zeros(size, dtype) for _ in range(2)]
        self._plane = np.zeros(size, np.uint16)
        self._total = np.zeros(size, np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes held between planes."""
        arrays = (self._samples, self._plane, self._total, *self._recent)
        return sum(a.nbytes for a in arrays)

    @property
    def plane(self) -> NDArray[np.uint16]:
        """Plane of the peak so far."""
        return self._plane.reshape(self._shape).copy()

    def add(self, value: Array, k: int) -> None:
        """Take the values of plane ``k``."""
        flat = value.reshape(-1)
        before, earlier = self._recent
        track_peak(flat, before, earlier, k, self._plane, self._samples, self._total)
        earlier[:] = flat
        self._recent = [earlier, before]

    def fit(self, z: NDArray[np.float64]) -> Fit:
        """Place the peaks between the planes at ``z``."""
        fit = Fit(*(np.empty(self._shape, np.float32) for _ in Fit._fields))
        fit_peaks(self._samples, self._total, self._plane, z, *(a.reshape(-1) for a in fit))
        return fit


def half_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Shape at half resolution, odd sizes rounded up."""
    return (shape[0] + 1) // 2, (shape[1] + 1) // 2


def judged(fit: Fit, window: Window, noise_energy: float, planes: int) -> Fit:
    """Let no peak count as sure that the noise of so many planes may make alone."""
    mean = fit.top / (1 + fit.confidence)
    share = (fit.top - mean) / (np.float32(window.noise_peak(planes)) * np.maximum(mean, np.float32(noise_energy)))
    return fit._replace(confidence=np.where(share < 1, np.minimum(fit.confidence, CONFIDENT) * share, fit.confidence))


def own(fit: Fit) -> Fit:
    """Take the confidence from what the widest window only sees because something sharp lies far off within it."""
    strongest = cv2.dilate(fit.top, WIDEST_REACH)
    return fit._replace(confidence=np.where(fit.top < HALO * strongest, np.float32(0), fit.confidence))


def merge(fits: list[Fit], noise_energy: float, planes: int) -> Fit:
    """Take every pixel from the smallest window that is to be believed, then remove single outliers."""
    chosen = [believed(fit, window, noise_energy) for fit, window in zip(fits, WINDOWS, strict=True)]
    fits = [judged(fit, window, noise_energy, planes) for fit, window in zip(fits, WINDOWS, strict=True)]
    merged = own(fits[-1])
    for fit, good in zip(fits[-2::-1], chosen[-2::-1], strict=True):
        wider = Fit(*(doubled(a, fit.top.shape) for a in merged))
        sure = good & (fit.top >= HALO * wider.top)
        merged = Fit(*(np.where(sure, fine, coarse) for fine, coarse in zip(fit, wider, strict=True)))
    return merged._replace(position=cv2.medianBlur(merged.position, 5))


def guarded(fit: Fit) -> Fit:
    """Take the confidence from peaks that a stronger neighbour's blur explains: haloes around edges out of focus."""
    step = 2
    top, position, width = (np.ascontiguousarray(a[::step, ::step]) for a in (fit.top, fit.position, fit.width))
    halo = np.empty(top.shape, np.bool_)
    explained(top, position, width, RINGS, BLUR_REACH / (step * HALVED), HALO, halo)
    marked = cv2.medianBlur(halo.astype(np.float32), 3)
    spread = doubled(marked, fit.top.shape)
    return fit._replace(confidence=fit.confidence * (1 - spread))


def rings() -> NDArray[np.int64]:
    """Offsets of neighbours in eight directions, at distances that grow by half."""
    distances = (1, 2, 3, 4, 6, 9, 13, 19)
    directions = [(np.sin(a), np.cos(a)) for a in np.arange(16) * np.pi / 8]
    return np.unique(np.rint([(d * y, d * x) for d in distances for y, x in directions]).astype(np.int64), axis=0)


RINGS = rings()


def believed(fit: Fit, window: Window, noise_energy: float) -> NDArray[np.bool_]:
    """Where a window's peak rises enough above the noise, and above the rest of the focus curve."""
    mean = fit.top / (1 + fit.confidence)
    rise = fit.top - mean
    textured = np.maximum(mean - 0.9 * noise_energy, 0.1 * mean)
    sure: NDArray[np.bool_] = (rise >= window.significance * noise_energy) & (rise >= window.contrast * textured)
    return sure


def doubled(coarse: Array, shape: tuple[int, ...]) -> Array:
    """Enlarge by two to ``shape``."""
    fine = np.empty(shape, np.float32)
    widen(coarse, fine)
    return fine
