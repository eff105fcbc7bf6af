"""Extended focus of transparent and filamentous specimens: a pyramid of detail, each kept from where it is strong.

One depth for each pixel is no help where a sharp hair crosses a dark leg, or where there is no texture at all. Here
every plane is split into bands of detail (Burt and Adelson 1983), and of each band the mean over the planes is taken,
weighted by the fourth power of its local energy above the camera's noise. The strongest plane alone would be noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from processing.compiled import compiled
from processing.focus_kernels import halve

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

LEVELS = 6
COARSEST_SIDE = 8
SIGMA = 2.0  # pixels of the level over which its energy is averaged
# Share of white noise's variance that each level holds; a test measures it anew.
NOISE_SHARE = (0.889, 0.0531, 0.0101, 0.0024, 0.0006, 0.00015)
FAINT = 0.05  # energy over noise that every plane is given: without any detail, the mean of all planes remains
STRONG = 1e8  # no more counts, so that the fourth power stays a number


class SoftPyramid:
    """Running weighted means of every level; none of the planes is kept.

    Parameters
    ----------
    shape : (height, width)
        Of a plane.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self._sums: list[Array] = []
        self._weights: list[Array] = []
        self._dtype = np.dtype(np.uint8)
        self._bands: tuple[int, ...] = ()

    @property
    def nbytes(self) -> int:
        """Bytes held between planes."""
        return sum(a.nbytes for a in (*self._sums, *self._weights))

    def add(self, plane: Array, noise: float) -> None:
        """Take the next plane, (height, width[, 3]) uint8 or uint16; ``noise`` of the camera in grey levels."""
        levels = laplacian_pyramid(plane)
        if not self._sums:
            self._dtype, self._bands = plane.dtype, plane.shape[2:]
            self._sums = [np.zeros_like(level) for level in levels]
            self._weights = [np.zeros(level.shape[:2], np.float32) for level in levels]
        for level, strength, total, weight in zip(
            levels, strengths(levels, noise), self._sums, self._weights, strict=True
        ):
            take(level, strength, total, weight)

    def picture(self) -> Array:
        """Return the extended focus of the planes so far, like a plane; more may be added afterwards."""
        levels = [total / weight[..., np.newaxis] for total, weight in zip(self._sums, self._weights, strict=True)]
        return as_plane(collapsed(levels), self._dtype).reshape(self.shape + self._bands)


def laplacian_pyramid(plane: Array) -> list[Array]:
    """Bands of detail from fine to coarse, then what is left; arrays (h, w, bands) float32."""
    here = plane.reshape(*plane.shape[:2], -1).astype(np.float32)
    levels: list[Array] = []
    while len(levels) < LEVELS and min(here.shape[:2]) >= 2 * COARSEST_SIDE:
        coarse = _with_bands(cv2.pyrDown(here))
        levels.append(here - _up(coarse, here.shape))
        here = coarse
    return [*levels, here]


@compiled
def take(level: Array, strength: Array, sums: Array, weights: Array) -> None:
    """Add a level, (h, w, bands), to the sums with the fourth power of its strength, (h, w), as weight."""
    height, width, bands = level.shape
    for i in range(height):
        for j in range(width):
            s = np.float32(min(max(strength[i, j], np.float32(0)), STRONG) + FAINT)
            weight = s * s * s * s
            weights[i, j] += weight
            for b in range(bands):
                sums[i, j, b] += weight * level[i, j, b]


def strengths(levels: list[Array], noise: float) -> list[Array]:
    """Local energy of every level over that of the noise; what is left at the end follows the coarsest detail."""
    found = []
    for level, share in zip(levels[:-1], NOISE_SHARE, strict=False):
        bands = level.shape[2]
        energy = cv2.multiply(level, level, scale=1 / (share * bands * noise**2))
        energy = energy if bands == 1 else energy.sum(-1)
        found.append(cv2.GaussianBlur(energy, (0, 0), SIGMA) - 1)
    last = np.zeros(levels[-1].shape[:2], np.float32)
    if found:
        halve(found[-1], last)
    return [*found, last]


def collapsed(levels: list[Array]) -> Array:
    """Put the bands of detail together again."""
    picture = levels[-1]
    for level in levels[-2::-1]:
        picture = _up(picture, level.shape) + level
    return picture


def as_plane(picture: Array, dtype: np.dtype[Any]) -> Array:
    """Round to whole grey levels within the type's range."""
    return np.clip(np.rint(picture), 0, np.iinfo(dtype).max).astype(dtype)


def _up(coarse: Array, shape: tuple[int, ...]) -> Array:
    return _with_bands(cv2.pyrUp(coarse, dstsize=(shape[1], shape[0])))


def _with_bands(image: Array) -> Array:
    """Give a grey image the axis of bands that OpenCV drops."""
    return image if image.ndim == 3 else image[..., np.newaxis]
