"""Which frame belongs to which plane: the one whose exposure began after the stage had settled there."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from devices.errors import DeviceError, StereotomeError

if TYPE_CHECKING:
    import numpy as np

    from acquire.frame import FrameHeader
    from devices.values import CameraCaps, FrameStamp


class TakesFrames(Protocol):
    """Whatever a frame can be handed to."""

    def put(self, pixels: np.ndarray, header: FrameHeader) -> None:
        """Take over one frame; the pixels are copied."""
        ...


class FrameGate:
    """Lets through the one frame that belongs to the plane being exposed.

    A frame belongs to a plane if its exposure began after the stage had settled there. Where the camera cannot say
    when that was, the latest possible beginning is not enough: the earliest is taken, arrival less exposure less
    readout. Everything else a free-running camera delivers is counted and let go.
    """

    def __init__(self, out: TakesFrames, caps: CameraCaps, exposure_ms: float) -> None:
        self._out = out
        self._caps = caps
        self._before_arrival_ns = round((exposure_ms + caps.readout_ms) * 1e6)
        self._header: FrameHeader | None = None
        self._settled_ns = 0
        self._error: StereotomeError | None = None
        self.discarded = 0

    def expect(self, header: FrameHeader, settled_ns: int) -> None:
        """Open for the frame of one plane."""
        self._error = None
        self._settled_ns = settled_ns
        self._header = header

    def forget(self) -> None:
        """Close: what comes now belongs to no plane."""
        self._header = None

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        """Take a frame from the camera, in whatever thread it comes."""
        start_ns = stamp.exposure_start_ns
        if start_ns is None:
            start_ns = stamp.arrival_ns - self._before_arrival_ns
        header = self._header
        if header is None or start_ns < self._settled_ns:
            self.discarded += 1
            return
        try:
            self._check_shape(pixels)
            self._out.put(pixels, _stamped(header, stamp))
        except StereotomeError as error:
            self._error = error
        self._header = None

    def _check_shape(self, pixels: np.ndarray) -> None:
        if pixels.shape != self._caps.shape or pixels.dtype.name != self._caps.dtype:
            raise DeviceError(
                f"camera: a frame of {pixels.shape} {pixels.dtype} came, "
                f"{self._caps.shape} {self._caps.dtype} was expected.",
                why="The camera's settings were changed while it was armed.",
            )

    def passed(self) -> bool:
        """Tell whether the expected frame was taken; raises what went wrong with it."""
        if self._error is not None:
            raise self._error
        return self._header is None


def _stamped(header: FrameHeader, stamp: FrameStamp) -> FrameHeader:
    return replace(
        header,
        exposure_start_ns=stamp.exposure_start_ns or 0,
        exposure_end_ns=stamp.exposure_end_ns or 0,
        arrival_ns=stamp.arrival_ns,
        hw_id=-1 if stamp.hw_id is None else stamp.hw_id,
    )
