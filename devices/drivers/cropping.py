"""A part of each frame, cut out by the driver where the camera cannot do it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from devices.errors import LimitError
from devices.values import Roi

if TYPE_CHECKING:
    import numpy as np

    from devices.values import CameraCaps


def check_exposure(exposure_ms: float) -> None:
    """Raise `LimitError` unless it is a length of time."""
    if not 0 < exposure_ms < math.inf:
        raise LimitError(f"camera: an exposure of {exposure_ms:g} ms is none.")


def centred(caps: CameraCaps, size_px: tuple[int, int]) -> Roi:
    """Return the middle of a frame, ``size_px`` (width, height) large; `LimitError` when the frame is smaller."""
    width, height = size_px
    roi = Roi((caps.width - width) // 2, (caps.height - height) // 2, width, height)
    roi.check(caps)
    return roi


class Crop:
    """Cuts the chosen part out of whole frames.

    Attributes
    ----------
    caps, whole : CameraCaps
        Of the part, and of whole frames.
    """

    def __init__(self, whole: CameraCaps) -> None:
        self.whole = whole
        self._roi: Roi | None = None
        self.caps = whole

    def choose(self, roi: Roi | None) -> None:
        """Cut out this part from now on; None leaves it as it is."""
        if roi is not None:
            roi.check(self.whole)
            self._roi = roi
            self.caps = replace(self.whole, width=roi.width, height=roi.height)

    def renew(self, whole: CameraCaps) -> None:
        """Take on what frames look like now; the part is kept as long as their size stays."""
        roi = self._roi if whole.shape[:2] == self.whole.shape[:2] else None
        self.caps = self.whole = whole
        self._roi = None
        self.choose(roi)

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Return the part as a view."""
        return pixels if self._roi is None else self._roi.of(pixels)
