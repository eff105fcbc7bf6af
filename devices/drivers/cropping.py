"""What a driver does to each frame: see that it is one of its camera's, and cut out a part where the camera cannot."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from devices.errors import DeviceError, LimitError
from devices.values import Roi

if TYPE_CHECKING:
    import numpy as np

    from devices.values import CameraCaps


def check_exposure(exposure_ms: float) -> None:
    """Raise `LimitError` unless it is a length of time."""
    if not 0 < exposure_ms < math.inf:
        raise LimitError(f"camera: an exposure of {exposure_ms:g} ms is none.")


def check_frame(pixels: np.ndarray, caps: CameraCaps) -> None:
    """Raise `DeviceError` (camera-frame) unless a frame is as large and as deep as ``caps`` says."""
    if pixels.shape == caps.shape and str(pixels.dtype) == caps.dtype:
        return
    raise DeviceError(
        f"camera: a frame of {words_of(pixels.shape)} {pixels.dtype} came, not of {words_of(caps.shape)} {caps.dtype}.",
        why="Its settings were changed by another program, or the frame came in part.",
        fix="let no other program set the camera, then start again.",
        code="camera-frame",
    )


def words_of(shape: tuple[int, ...]) -> str:
    """Return the shape of a frame as people say it: width x height, then bands if there are several."""
    return " x ".join(str(length) for length in (*shape[1::-1], *shape[2:])) + " px"


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
        """Return the part as a view; raises camera-frame for a frame of another size or type."""
        check_frame(pixels, self.whole)
        return pixels if self._roi is None else self._roi.of(pixels)
