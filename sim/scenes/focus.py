"""A relief with everything that makes focus measurement hard, and its focal stack, with the truth.

Hills, tilt, terraces and pits; fractal, grainy and speckled albedo with patches of 6 % contrast; bright spikes on dark;
every layer of depth scattered through a pillbox that grows with the distance from focus, then a Gaussian; shot, read
and gain noise. Behind an edge the light is normalised by the sum of the covers, as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.fft import irfft2, rfft2

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[Any]

PSF_PX = 0.7
CONE_PX = 0.75  # pillbox radius per plane
LAYER = 0.25  # planes
MARGIN = 32  # pixels mirrored around, so that nothing wraps


@dataclass(frozen=True)
class Scene:
    """Planes (n, y, x) uint8, truth of the range in planes, and the noise-free picture in focus everywhere."""

    planes: NDArray[np.uint8]
    depth: NDArray[np.float64]
    sharp: NDArray[np.float64]


def scene(seed: int, side: int = 512, planes: int = 40, *, spikes: int = 0) -> Scene:
    """Make a scene; the same seed gives the same one.

    Parameters
    ----------
    seed : int
    side : int
        Of the square planes, in pixels.
    planes : int
        From 8 on.
    spikes : int
        Bright needles standing out of the surface on a dark patch.
    """
    rng = np.random.default_rng(seed)
    depth, surface = relief(rng, side, planes), albedo(rng, side)
    if spikes:
        needles(rng, depth, surface, spikes)
    layers = np.rint(depth / LAYER) * LAYER
    clean = np.array(list(photographed(layers, surface, planes)))
    gain = 1 + 0.003 * rng.normal(size=(planes, 1, 1))
    seen = clean * gain + rng.normal(size=clean.shape) * np.sqrt(6e-5 * np.maximum(clean, 0) + 4e-5)
    grey = np.clip(np.rint(255 * seen), 0, 255).astype(np.uint8)
    return Scene(grey, depth, 255 * cv2.GaussianBlur(surface, (0, 0), PSF_PX).astype(np.float64))


def fractal(rng: np.random.Generator, side: int, slope: float) -> Array:
    """Field of unit deviation whose spectrum falls with the frequency to the power of ``slope``."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    spectrum = (rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)) * frequency**-slope
    field = np.fft.irfft2(spectrum, s=(side, side))
    return np.asarray(field / field.std())


def relief(rng: np.random.Generator, side: int, planes: int) -> Array:
    """Depth in planes: hills, tilt, terraces, pits."""
    y, x = np.mgrid[0:side, 0:side] / side
    depth = planes * (0.3 + 0.06 * fractal(rng, side, 2.0) + 0.25 * x)
    depth += np.where((y > 0.65) & (x < 0.5), 2 * np.floor(x * 8), 0)
    for cy, cx, size in rng.random((8, 3)):
        depth -= 6 * np.clip(1 - np.hypot(y - cy, x - cx) / (0.03 + 0.06 * size), 0, 1)
    return np.asarray(np.clip(depth, 3, planes - 4))


def albedo(rng: np.random.Generator, side: int) -> Array:
    """Reflected light, 0 to 1, with patches of little contrast."""
    grain = cv2.GaussianBlur(rng.normal(size=(side, side)), (0, 0), 1)
    specks = cv2.GaussianBlur((rng.random((side, side)) > 0.995).astype(float), (0, 0), 0.8)
    contrast = np.ones((side, side))
    for cy, cx in (rng.random((6, 2)) * side).astype(int):
        contrast[cy : cy + side // 10, cx : cx + side // 8] = 0.06
    texture = 0.6 * fractal(rng, side, 1.0) + 1.5 * grain + 3 * specks
    return np.asarray(np.clip(0.45 + 0.13 * texture * cv2.GaussianBlur(contrast, (0, 0), 2), 0.02, 0.98))


def needles(rng: np.random.Generator, depth: Array, surface: Array, count: int) -> None:
    """Darken a patch and let bright needles two pixels wide stand out of it, into ``depth`` and ``surface``."""
    side = depth.shape[0]
    cy, cx = (rng.random(2) * side * 0.6).astype(int)
    patch = np.s_[cy : cy + side // 3, cx : cx + side // 3]
    surface[patch] *= 0.15
    for fy, fx, lift in rng.random((count, 3)):
        y, x = cy + int(fy * side // 3), cx + int(fx * side // 3)
        surface[y : y + 2, x : x + 2] = 0.98
        depth[y : y + 2, x : x + 2] = np.clip(depth[y, x] - 3 - 5 * lift, 3, None)


def photographed(layers: Array, surface: Array, planes: int) -> Iterator[Array]:
    """Yield the planes: every layer scattered by its distance from focus, the sum over the sum of the covers."""
    fields = {float(v): _spectra(layers == v, surface) for v in np.unique(layers)}
    height, width = (n + 2 * MARGIN for n in surface.shape)
    distances = np.unique([abs(k - v) for v in fields for k in range(planes)])
    transfer = {float(d): rfft2(_disc(d * CONE_PX, (height, width))).astype(np.complex64) for d in distances}
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for k in range(planes):
        light, cover = (
            irfft2(sum(fields[v][part] * transfer[abs(k - v)] for v in fields), (height, width))[inner]
            for part in (0, 1)
        )
        yield cv2.GaussianBlur(light / np.maximum(cover, 1e-6), (0, 0), PSF_PX)


def _spectra(there: Array, surface: Array) -> tuple[Array, Array]:
    cover = np.pad(there.astype(np.float32), MARGIN, mode="symmetric")
    light = cover * np.pad(surface.astype(np.float32), MARGIN, mode="symmetric")
    return rfft2(light), rfft2(cover)


def _disc(radius: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Pillbox of unit sum around the origin of a periodic field, a smooth rim."""
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    disc = np.clip(radius + 0.5 - np.hypot(x, y[:, np.newaxis]), 0, 1)
    return np.asarray(disc / disc.sum(), np.float32)
