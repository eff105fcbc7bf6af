"""What is followed through the planes for every pixel: sharpness, brightness, or the first value over a threshold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypedDict

import cv2
import numpy as np
from scipy.stats import binom

from devices.errors import InputError
from processing.focus_kernels import first_above, gradient_energy, halve, nearest_plane
from processing.focus_windows import CONFIDENT, NOISE_ENERGY, WINDOWS, PeakTrack, doubled, guarded, half_shape, merge

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

Method = Literal["brightfield", "transparent", "confocal", "threshold"]

PEAK_OF_NOISE = 6.0  # standard deviations that noise reaches above its mean somewhere in a stack, and some more
BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32) / 16
AROUND = 2  # pixels to either side whose brightest planes must agree
BY_CHANCE = 0.01  # of the pixels may have so many that agree by chance
NOWHERE = -9
FEW_PLANES = 12  # in fewer, neighbouring planes agree too often by chance to count
MOST_GAIN = 2.0  # larger changes of brightness are no flicker


class Options(TypedDict, total=False):
    """How focus is measured, as in `processing.focus.FocusSweep`; what is left out has its default there."""

    method: Method
    threshold: float | None
    band: int | None


class Measured(NamedTuple):
    """What a track says at the end, arrays (height, width): see `processing.focus.RangeImage`."""

    position: Array
    confidence: Array
    width: Array
    plane: Array


class Track(Protocol):
    """What follows a stack plane by plane."""

    @property
    def nbytes(self) -> int:
        """Bytes held between planes."""

    def add(self, plane: Array, k: int, light: float) -> None:
        """Take plane ``k``, (height, width[, 3]) uint8 or uint16, read-only; ``light`` is the mean of all of it."""

    def measured(self, z: NDArray[np.float64], noise: float) -> Measured:
        """Return what is known of planes at ``z``; ``noise`` of the camera in grey levels."""


def track_for(method: Method, shape: tuple[int, int], threshold: float | None) -> Track:
    """Return the track of a method; raises `InputError` when a threshold is missing, or given and not used."""
    if (threshold is not None) != (method == "threshold"):
        raise InputError(
            f"the method {method} {'needs a' if threshold is None else 'knows no'} threshold.",
            fix="give both or none: --method threshold --threshold 120",
            code="focus-threshold",
        )
    if threshold is not None:
        return FirstTrack(shape, threshold)
    return BrightTrack(shape) if method == "confocal" else SharpTrack(shape)


class SharpTrack:
    """Sharpness in four windows, each twice as wide as the one before."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._windows: list[PeakTrack] = []
        self._energy: list[Array] = []
        self._first_light = 0.0

    @property
    def nbytes(self) -> int:
        """Bytes held between planes, work space included."""
        return sum(w.nbytes for w in self._windows) + sum(2 * e.nbytes for e in self._energy)

    def add(self, plane: Array, k: int, light: float) -> None:
        """Take plane ``k``."""
        if not self._windows:
            self._make_windows()
        bands = 1 if plane.ndim == 2 else plane.shape[2]
        gradient_energy(plane.reshape(plane.shape[0], -1), bands, self._lamp_gain(light), self._energy[0])
        for energy, window, coarser in zip(self._energy, self._windows, [*self._energy[1:], None], strict=True):
            smooth = cv2.sepFilter2D(energy, -1, BINOMIAL, BINOMIAL, borderType=cv2.BORDER_REPLICATE)
            window.add(smooth, k)
            if coarser is not None:
                halve(smooth, coarser)

    def _make_windows(self) -> None:
        shape = self._shape
        for _ in WINDOWS:
            shape = half_shape(shape)
            self._windows.append(PeakTrack(shape, np.float32))
            self._energy.append(np.empty(shape, np.float32))

    def _lamp_gain(self, light: float) -> float:
        """Gain that gives the plane the brightness of the first one: a flickering lamp must not look like focus."""
        self._first_light = self._first_light or light
        return float(np.clip(self._first_light / light, 1 / MOST_GAIN, MOST_GAIN)) if light else 1.0

    def measured(self, z: NDArray[np.float64], noise: float) -> Measured:
        """Return position, confidence, width and plane of the sharpest focus."""
        merged = guarded(merge([window.fit(z) for window in self._windows], NOISE_ENERGY * noise**2, z.size))
        position, confidence, width = (doubled(a, self._shape) for a in merged[:3])
        plane = np.empty(self._shape, np.uint16)
        nearest_plane(position.reshape(-1), z, plane.reshape(-1))
        return Measured(position, confidence, width, plane)


class BrightTrack:
    """Brightness of optical sections."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._peak: PeakTrack | None = None
        self._gain = 1

    @property
    def nbytes(self) -> int:
        """Bytes held between planes."""
        return self._peak.nbytes if self._peak else 0

    def add(self, plane: Array, k: int, light: float) -> None:
        """Take plane ``k``."""
        del light
        seen, self._gain = brightness(plane)
        self._peak = self._peak or PeakTrack(self._shape, seen.dtype.type)
        self._peak.add(seen, k)

    def measured(self, z: NDArray[np.float64], noise: float) -> Measured:
        """Brightness of a pixel nothing shines in peaks somewhere, too: noise counts against the confidence.

        The noise of few photons is no cloud about a mean: what is left of it peaks in any plane, whatever the
        neighbours do, and is not sure for that.
        """
        assert self._peak is not None
        fit, plane = self._peak.fit(z), self._peak.plane
        mean = fit.top / (1 + fit.confidence)
        confidence = (fit.top - mean) / np.maximum(mean + PEAK_OF_NOISE * self._gain * noise, 1e-6)
        agree = agreement(np.where(confidence > 0, plane.astype(np.int32), NOWHERE), z.size)
        judged = np.where(agree < 1, np.minimum(confidence, CONFIDENT) * agree, confidence)
        return Measured(fit.position, judged.astype(np.float32), fit.width, plane)


def agreement(plane: Array, planes: int) -> NDArray[np.float32]:
    """How many of 24 pixels around have their peak where a pixel has, over what chance would make of them.

    Parameters
    ----------
    plane : array (height, width) int
        Where every pixel has its peak, of ``planes``; `NOWHERE` without one.

    Returns
    -------
    array float32
        1 and more where chance does so in less than `BY_CHANCE` of the pixels.
    """
    reach = max(planes // (2 * FEW_PLANES), int(planes >= FEW_PLANES))
    needed = 1 + binom.ppf(1 - BY_CHANCE, (2 * AROUND + 1) ** 2 - 1, min(1.0, (2 * reach + 1) / planes))
    alike = np.zeros(plane.shape, np.uint8)
    height, width = plane.shape
    for down, right in [(a, b) for a in range(AROUND + 1) for b in range(-AROUND, AROUND + 1) if (a, b) > (0, 0)]:
        here = np.s_[: height - down, max(0, -right) : min(width, width - right)]
        there = np.s_[down:, max(0, right) : min(width, width + right)]
        same = np.abs(plane[here] - plane[there]) <= reach
        alike[here] += same
        alike[there] += same
    return (alike / np.float32(needed)).astype(np.float32)


class FirstTrack:
    """The first plane in which a pixel is at least as bright as the threshold."""

    def __init__(self, shape: tuple[int, int], threshold: float) -> None:
        self._shape = shape
        self._threshold = threshold
        self._gain = 1
        size = shape[0] * shape[1]
        self._plane = np.zeros(size, np.uint16)
        self._fraction = np.full(size, np.nan, np.float32)
        self._before = np.zeros(size, np.float32)
        self._top = np.zeros(size, np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes held between planes."""
        return sum(a.nbytes for a in (self._plane, self._fraction, self._before, self._top))

    def add(self, plane: Array, k: int, light: float) -> None:
        """Take plane ``k``."""
        del light
        seen, self._gain = brightness(plane)
        state = (self._plane, self._fraction, self._before, self._top)
        first_above(seen.reshape(-1), self._gain * self._threshold, k, *state)

    def measured(self, z: NDArray[np.float64], noise: float) -> Measured:
        """Return where the threshold is passed, between planes; NaN where it never is."""
        plane = self._plane.reshape(self._shape).copy()
        back = self._fraction.reshape(self._shape) * (z - np.concatenate([z[:1], z[:-1]]))[plane]
        passed = (self._top.reshape(self._shape) / self._gain - self._threshold) / (PEAK_OF_NOISE * noise)
        confidence = np.where(np.isnan(back), 0, np.maximum(passed, 0)).astype(np.float32)
        return Measured((z[plane] - back).astype(np.float32), confidence, np.zeros(self._shape, np.float32), plane)


def mean_light(plane: Array) -> float:
    """Return the mean grey level of a plane, over all its bands."""
    return float(np.mean(cv2.mean(plane)[: 1 if plane.ndim == 2 else 3]))


def one_band(plane: Array, band: int | None) -> Array:
    """Return the band that decides, or the plane as it is."""
    if band is None or plane.ndim == 2:
        return plane
    return read_only(plane[..., band])


def brightness(plane: Array) -> tuple[Array, int]:
    """Return grey values or luminance with their gain: 8-bit colours are weighed in 16 bit, so faint blue counts."""
    if plane.ndim == 2:
        return plane, 1
    gain = 256 if plane.dtype == np.uint8 else 1
    return read_only(cv2.cvtColor(plane.astype(np.uint16) * np.uint16(gain), cv2.COLOR_RGB2GRAY)), gain


def read_only(plane: Array) -> Array:
    """Return a contiguous view that cannot be written: one type of array, so every kernel is compiled once."""
    view = np.ascontiguousarray(plane).view()
    view.flags.writeable = False
    return view
