"""A relief with everything that makes focus measurement hard, and its focal stack with the truth: for bench_focus.py.

Hills, tilt, terraces and pits; fractal, grainy and speckled albedo with patches of 6 % contrast; every depth layer
scattered through a pillbox that grows with the distance from focus, then a Gaussian; shot, read and gain noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

PSF_PX = 0.7
CONE_PX = 0.75  # pillbox radius per plane
LAYER = 0.25  # planes


@dataclass(frozen=True)
class Scene:
    """Planes (n, y, x) uint8, truth of the range in planes, and the noise-free picture in focus everywhere."""

    planes: np.ndarray
    depth: np.ndarray
    sharp: np.ndarray


def fractal(rng: np.random.Generator, side: int, slope: float) -> np.ndarray:
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    spectrum = (rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)) * frequency**-slope
    field = np.fft.irfft2(spectrum, s=(side, side))
    return field / field.std()


def relief(rng: np.random.Generator, side: int, planes: int) -> np.ndarray:
    y, x = np.mgrid[0:side, 0:side] / side
    depth = planes * (0.3 + 0.06 * fractal(rng, side, 2.0) + 0.25 * x)
    depth += np.where((y > 0.65) & (x < 0.5), 2 * np.floor(x * 8), 0)
    for cy, cx, size in rng.random((8, 3)):
        depth -= 6 * np.clip(1 - np.hypot(y - cy, x - cx) / (0.03 + 0.06 * size), 0, 1)
    return np.clip(depth, 3, planes - 4)


def albedo(rng: np.random.Generator, side: int) -> np.ndarray:
    grain = cv2.GaussianBlur(rng.normal(size=(side, side)), (0, 0), 1)
    specks = cv2.GaussianBlur((rng.random((side, side)) > 0.995).astype(float), (0, 0), 0.8)
    contrast = np.ones((side, side))
    for cy, cx in (rng.random((6, 2)) * side).astype(int):
        contrast[cy : cy + side // 10, cx : cx + side // 8] = 0.06
    texture = 0.6 * fractal(rng, side, 1.0) + 1.5 * grain + 3 * specks
    return np.clip(0.45 + 0.13 * texture * cv2.GaussianBlur(contrast, (0, 0), 2), 0.02, 0.98)


def scattered(light: np.ndarray, radius: float) -> np.ndarray:
    reach = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1)
    return cv2.filter2D(light, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT)


def plane_at(k: int, layers: np.ndarray, surface: np.ndarray) -> np.ndarray:
    light, cover = np.zeros_like(surface), np.zeros_like(surface)
    distance = np.abs(layers - k)
    for value in np.unique(distance):
        layer = (distance == value).astype(float)
        light += scattered(surface * layer, CONE_PX * value)
        cover += scattered(layer, CONE_PX * value)
    return cv2.GaussianBlur(light / np.maximum(cover, 1e-6), (0, 0), PSF_PX)


def scene(seed: int, side: int = 512, planes: int = 40) -> Scene:
    rng = np.random.default_rng(seed)
    depth, surface = relief(rng, side, planes), albedo(rng, side)
    layers = np.rint(depth / LAYER) * LAYER
    clean = np.array([plane_at(k, layers, surface) for k in range(planes)])
    gain = 1 + 0.003 * rng.normal(size=(planes, 1, 1))
    seen = clean * gain + rng.normal(size=clean.shape) * np.sqrt(6e-5 * clean + 4e-5)
    grey = np.clip(np.rint(255 * seen), 0, 255).astype(np.uint8)
    return Scene(grey, depth, 255 * cv2.GaussianBlur(surface, (0, 0), PSF_PX))
