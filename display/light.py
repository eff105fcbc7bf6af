"""Grey levels as files and screens have them (sRGB, IEC 61966-2-1), and the light they stand for. Pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear light, ITU-R BT.709
STEPS = 1 << 14  # of light: fine enough that every grey level has one of its own
LEVEL_OF_WHITE = 255


def encoded(light: Array) -> NDArray[np.uint8]:
    """Return the sRGB grey levels of linear light; what is outside 0 … 1 is clipped, NaN is black."""
    steps = np.fmin(np.fmax(light, 0.0), 1.0) * (STEPS - 1) + 0.5  # of a number and NaN these take the number
    return np.asarray(_LEVELS.take(steps.astype(np.uint16)), np.uint8)


def linear(levels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the linear light, 0 … 1, of sRGB grey levels."""
    return np.asarray(_LIGHT[levels], np.float32)


def linear_of(share: Array) -> NDArray[np.float64]:
    """Return the linear light of encoded values 0 … 1 by the standard's curve."""
    return np.where(share <= 0.04045, share / 12.92, ((np.maximum(share, 0.0) + 0.055) / 1.055) ** 2.4)


def encoded_share(light: Array) -> NDArray[np.float64]:
    """Return the encoded values, 0 … 1, of linear light by the standard's curve."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(np.maximum(light, 0.0), 1 / 2.4) - 0.055)


_LIGHT = linear_of(np.arange(LEVEL_OF_WHITE + 1) / LEVEL_OF_WHITE).astype(np.float32)
_LEVELS = np.rint(LEVEL_OF_WHITE * encoded_share(np.arange(STEPS) / (STEPS - 1))).astype(np.uint8)
