"""Compression from the looks of single sections, for a specimen whose features have no preferred direction.

A shortening by c along d turns round features into ellipses and makes edges across d steeper. Summed over many, second
moments of features come out as C M C with M a multiple of the unit matrix, and the structure tensor (sum of ∇I ∇Iᵀ) as
the inverse: in both cases 1 − c is the root of the ratio of the eigenvalues. The point spread of the instrument and
noise are round themselves and make the answer somewhat too small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from processing.align_mismatch import binaries
from processing.align_pair import grey

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

Isotropic = Literal["texture", "features"]
TILES = 6  # along each side: the scatter between tiles gives the error
GRADIENT_SIGMA_PX = 1.2  # finer texture than a few of it looks rounder than it is
SMALLEST_FEATURE_PX = 20
FEWEST_FEATURES = 8


@dataclass(frozen=True)
class Elongation:
    """A shortening along one direction, with standard errors.

    Attributes
    ----------
    compression, compression_error : float
        0.1 is ten per cent shorter than across.
    direction_deg, direction_error_deg : float
        Axis of the shortening, 0 … 180, from x towards y.
    """

    compression: float
    compression_error: float
    direction_deg: float
    direction_error_deg: float


def tensors(section: Array, kind: Isotropic) -> Array:
    """Return what a section says of its anisotropy, (parts, 2, 2), in such a form that shortening makes it larger.

    Parameters
    ----------
    section : array (h, w) or (h, w, 3)
        The section as taken.
    kind : {"texture", "features"}
        Structure tensors of tiles, or inverse second moments of dark or bright features.

    Returns
    -------
    array (parts, 2, 2) float64
        Under p_section = L p these become Lᵀ T L. Empty where a section shows too little.
    """
    picture = grey(section)
    return texture_tensors(picture) if kind == "texture" else feature_tensors(picture)


def texture_tensors(picture: Array) -> Array:
    """Return the structure tensors of 6×6 tiles, each over the strength of its texture: strong edges do not reign."""
    smooth = cv2.GaussianBlur(picture, (0, 0), GRADIENT_SIGMA_PX)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *way, ksize=3) for way in ((1, 0), (0, 1)))
    inside = (slice(8, -8), slice(8, -8))
    sums = [_tiles(product[inside]) for product in (x * x, x * y, y * y)]
    found = np.stack([np.stack(sums[:2], -1), np.stack(sums[1:], -1)], -2)
    trace = found[:, 0, 0] + found[:, 1, 1]
    return np.asarray(found[trace > 0] / trace[trace > 0, None, None], np.float64)


def _tiles(product: Array) -> Array:
    return np.asarray(cv2.resize(product, (TILES, TILES), interpolation=cv2.INTER_AREA), np.float64).ravel()


def feature_tensors(picture: Array) -> Array:
    """Return the inverse second moments, each over its area, of all features inside; they add up as inverses."""
    mask, _ = binaries(picture, picture)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    x, y, width, height, area = stats[1:count].T
    inside = (x > 0) & (y > 0) & (x + width < mask.shape[1]) & (y + height < mask.shape[0])
    whole = 1 + np.flatnonzero(inside & (area >= SMALLEST_FEATURE_PX))
    if whole.size < FEWEST_FEATURES:
        return np.empty((0, 2, 2))
    return np.linalg.inv([_moments(labels, int(k), stats[k]) for k in whole])


def _moments(labels: Array, k: int, box: Array) -> Array:
    x, y, width, height, area = (int(v) for v in box)
    rows, columns = np.nonzero(labels[y : y + height, x : x + width] == k)
    return (np.cov(np.stack([columns, rows])) + np.eye(2) / 12) / area


def mapped(parts: Array, matrix: Array) -> Array:
    """Return tensors (parts, 2, 2) of a section in the coordinates that ``matrix`` leads from."""
    linear = matrix[:2, :2]
    return np.asarray(linear.T @ parts @ linear)


def elongation(groups: Sequence[Array], kind: Isotropic) -> Elongation | None:
    """Return the common shortening of groups of tensors, its error from leaving out one group at a time (jackknife)."""
    filled = [group for group in groups if len(group)]
    if len(filled) < 3:
        return None
    sums = np.array([_added(group, kind) for group in filled])
    whole, total = sums.sum(axis=0), len(sums)
    vectors = np.array([_vector(whole - one, kind) for one in sums])
    spread = float(np.sqrt((total - 1) / total * ((vectors - vectors.mean(axis=0)) ** 2).sum() / 2))
    vector = _vector(whole, kind)
    found = float(np.hypot(*vector))
    direction = float(np.degrees(np.arctan2(vector[1], vector[0])) / 2 % 180)
    return Elongation(found, spread, direction, min(float(np.degrees(spread / max(2 * found, 1e-9))), 90.0))


def _added(group: Array, kind: Isotropic) -> Array:
    """Return the sum of what adds up: structure tensors, or moments, the inverses of their kind."""
    return np.asarray((group if kind == "texture" else np.linalg.inv(group)).sum(axis=0))


def _vector(added: Array, kind: Isotropic) -> Array:
    """Return compression times (cos 2θ, sin 2θ)."""
    values, axes = np.linalg.eigh(added)
    across = axes[:, 1 if kind == "texture" else 0]
    angle = 2 * np.arctan2(across[1], across[0])
    return np.asarray((1 - np.sqrt(values[0] / values[1])) * np.array([np.cos(angle), np.sin(angle)]))


def shortened(found: Elongation) -> Array:
    """Return the linear map (2, 2) that shortens by this much."""
    angle = np.radians(found.direction_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(np.eye(2) - found.compression * np.outer(along, along))
