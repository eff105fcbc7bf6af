"""Sections of a specimen with everything that makes alignment hard, and the truth: for bench_align.py and the tests.

Cells and oblique vessels cut plane by plane, a texture that changes from section to section; each section turned,
shifted, compressed along the block's x, lit unevenly, noisy and dirty. Coordinates are those of the block: a section's
matrix leads from block pixel (x, y) to section pixel (x, y), both with (0, 0) at the first pixel's centre.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

MARGIN = 0.35  # of the side: what sections may show beyond the block's frame
LIKENESS = 0.9  # of the texture of one section to that of the next


@dataclass(frozen=True)
class Motion:
    """How sections were put out of place; each value the half width of a uniform distribution."""

    turn_deg: float = 4.0
    shift_px: float = 12.0
    compression: tuple[float, float] = (0.05, 0.20)


@dataclass(frozen=True)
class Sections:
    """Sections (n, y, x) uint8, their true matrices (n, 3, 3), compressions (n,), and marks (n, 4, 2) if there are."""

    images: np.ndarray
    matrices: np.ndarray
    compression: np.ndarray
    marks: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2)))


def fractal(rng: np.random.Generator, side: int, slope: float = 1.0) -> np.ndarray:
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    spectrum = (rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)) * frequency**-slope
    made = np.fft.irfft2(spectrum, s=(side, side))
    return (made / made.std()).astype(np.float32)


def disc(image: np.ndarray, x: float, y: float, radius: float, value: float) -> None:
    """Blend a disc with a soft rim into the image."""
    reach = int(radius + 3)
    x0, y0 = int(x) - reach, int(y) - reach
    if x0 < 0 or y0 < 0 or x0 + 2 * reach >= image.shape[1] or y0 + 2 * reach >= image.shape[0]:
        return
    part = image[y0 : y0 + 2 * reach, x0 : x0 + 2 * reach]
    yy, xx = np.mgrid[0 : 2 * reach, 0 : 2 * reach]
    cover = np.clip(radius + 0.5 - np.hypot(xx + x0 - x, yy + y0 - y), 0, 1)
    part += cover.astype(np.float32) * (value - part)


class Block:
    """A specimen that is cut at any depth, one section after the other."""

    def __init__(self, rng: np.random.Generator, side: int, count: int, lean_px: float = 0.0) -> None:
        self.rng, self.side, self.lean_px = rng, int(side * (1 + 2 * MARGIN)), lean_px
        cells = int(count * (self.side / 30) ** 2 / 6)
        self.cells = rng.random((cells, 3)) * (self.side, self.side, count + 30) - (0, 0, 15)
        self.radii = rng.uniform(6, 14, cells)
        self.values = rng.uniform(0.15, 0.45, cells)
        vessels = (self.side // 60) ** 2 // 2
        self.vessels = rng.random((vessels, 2)) * self.side
        self.slopes = rng.normal(0, 0.35, (vessels, 2))
        self.texture = fractal(rng, self.side)

    def cut(self, z: int) -> np.ndarray:
        """Return the next face, (side, side) float32 around 0 … 1; faces must be taken in order."""
        self.texture = LIKENESS * self.texture + np.sqrt(1 - LIKENESS**2) * fractal(self.rng, self.side)
        face = np.float32(0.62) + np.float32(0.06) * self.texture
        for (x, y, depth), radius, value in zip(self.cells, self.radii, self.values, strict=True):
            inside = radius**2 - 1.5 * (z - depth) ** 2
            if inside > 1:
                disc(face, x, y, np.sqrt(inside), value + 0.25)
                disc(face, x, y, np.sqrt(inside) * 0.45, value)
        for (x, y), (dx, dy) in zip(self.vessels, self.slopes, strict=True):
            disc(face, x + dx * z, y + dy * z, 7, 0.9)
        return cv2.GaussianBlur(face, (0, 0), 0.8)


def sections(
    seed: int,
    count: int,
    side: int = 512,
    motion: Motion | None = None,
    *,
    marks: bool = False,
    lean_px: float = 0.0,
    twist_deg: float = 0.0,
) -> Sections:
    """Make sections with the truth; ``lean_px`` and ``twist_deg`` per section are the specimen's own, not motion."""
    rng, motion = np.random.default_rng(seed), motion or Motion()
    block = Block(rng, side, count)
    places = np.array([(0.15, 0.14), (0.84, 0.18), (0.17, 0.83), (0.82, 0.86)]) * (side - 1)
    compression = rng.uniform(*motion.compression, count)
    matrices, images, seen = [], [], []
    for z in range(count):
        face = leaning(block.cut(z), lean_px * (z - count / 2), twist_deg * (z - count / 2))
        if marks:
            for x, y in places + int(MARGIN * side):
                disc(face, x, y, 5.0, 0.02)
        matrix = moved(rng, motion, float(compression[z]), side)
        images.append(photographed(rng, face, matrix, side))
        matrices.append(matrix)
        seen.append(places @ matrix[:2, :2].T + matrix[:2, 2])
    return Sections(np.stack(images), np.stack(matrices), compression, np.stack(seen))


def leaning(face: np.ndarray, shift: float, turn_deg: float) -> np.ndarray:
    if not shift and not turn_deg:
        return face
    middle = (face.shape[1] - 1) / 2
    matrix = cv2.getRotationMatrix2D((middle, middle), turn_deg, 1.0)
    matrix[0, 2] += shift
    return cv2.warpAffine(face, matrix, face.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def moved(rng: np.random.Generator, motion: Motion, compression: float, side: int) -> np.ndarray:
    angle = np.radians(rng.uniform(-1, 1) * motion.turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.full(2, (side - 1) / 2)
    matrix = np.eye(3)
    matrix[:2, :2] = turn @ np.diag([1 - compression, 1.0])
    matrix[:2, 2] = middle - matrix[:2, :2] @ middle + rng.uniform(-1, 1, 2) * motion.shift_px
    return matrix


def photographed(rng: np.random.Generator, face: np.ndarray, matrix: np.ndarray, side: int) -> np.ndarray:
    from_face = np.eye(3)
    from_face[:2, 2] = -float(int(MARGIN * side))
    whole = (matrix @ from_face)[:2]
    image = cv2.warpAffine(face, whole, (side, side), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    light = 1 + 0.08 * cv2.resize(
        rng.normal(size=(3, 3)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC
    )
    image = image * light * rng.uniform(0.92, 1.08) + rng.uniform(-0.04, 0.04)
    for _ in range(rng.poisson(3)):
        x, y = rng.uniform(20, side - 20, 2)
        disc(image, float(x), float(y), float(rng.uniform(2, 9)), float(rng.uniform(0, 0.15)))
    noise = rng.normal(0, 0.012, image.shape)
    return np.clip(np.rint(255 * (image * 0.8 + noise)), 0, 255).astype(np.uint8)
