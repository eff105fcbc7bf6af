"""The simulated camera: sees the true axis while it exposes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from devices.drivers.cropping import Crop
from devices.errors import CameraTimeout, DeviceError, LimitError
from devices.values import FrameStamp

if TYPE_CHECKING:
    from devices.protocols import FrameSink
    from devices.values import CameraCaps, Roi
    from sim.faults import Faults
    from sim.motion import Axis

SHORTEST_MS, LONGEST_MS = 0.01, 10_000.0
NS = 1_000_000_000
LOSING = {"camera.drop", "camera.hang"}


class FrameMaker(Protocol):
    """What fills a frame: a `sim.sensor.Sensor`, or recorded frames for those who measure something else."""

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        ...

    def expose(self, path_um: np.ndarray, exposure_ms: float, out: np.ndarray) -> None:
        """Fill ``out`` with one exposure along ``path_um``."""
        ...


class Replay:
    """Hands out the frames it was given, in turn, whatever is exposed."""

    def __init__(self, frames: np.ndarray, caps: CameraCaps) -> None:
        self._frames = frames
        self._caps = caps
        self._next = 0

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        return self._caps

    def expose(self, path_um: np.ndarray, exposure_ms: float, out: np.ndarray) -> None:  # noqa: ARG002  a FrameMaker's
        """Copy the next frame to ``out``."""
        np.copyto(out, self._frames[self._next % len(self._frames)])
        self._next += 1


class Shutter:
    """Opens for an exposure, and computes the picture while it is open: a frame costs the longer of the two."""

    def __init__(self, maker: FrameMaker, axis: Axis) -> None:
        self._maker = maker
        self._axis = axis
        self._clock = axis.clock

    def expose(self, exposure_ms: float, out: np.ndarray) -> tuple[int, int]:
        """Fill ``out`` and return start and end of the exposure in ns of the clock.

        The path of the axis is known ahead unless it gets another command meanwhile; then the picture is made again.
        """
        start_s = self._clock.now()
        end_s = start_s + exposure_ms / 1000
        known = self._axis.commanded
        self._maker.expose(self._axis.path_um(start_s, end_s), exposure_ms, out)
        self._clock.sleep(end_s - self._clock.now())
        if self._axis.commanded is not known:
            self._maker.expose(self._axis.path_um(start_s, end_s), exposure_ms, out)
        return round(start_s * NS), round(end_s * NS)


def check_exposure(exposure_ms: float) -> None:
    """Raise `LimitError` for an exposure no camera of this kind can do."""
    if not SHORTEST_MS <= exposure_ms <= LONGEST_MS:
        raise LimitError(
            f"camera: an exposure of {exposure_ms:g} ms is outside {SHORTEST_MS:g} … {LONGEST_MS:g} ms.",
            fix="choose an exposure inside these limits.",
        )


def spoil(frame: np.ndarray, before: np.ndarray, kinds: set[str]) -> None:
    """Do to a frame what faults of these kinds do: repeat the one before, or leave the lower half out."""
    if "camera.freeze" in kinds:
        np.copyto(frame, before)
    if "camera.partial" in kinds:
        frame[len(frame) // 2 :] = 0


class SimCamera:
    """A `devices.protocols.Camera` in the same process as the axis; `trigger` returns after its frame was delivered.

    Parameters
    ----------
    maker : FrameMaker
        Makes the pictures.
    axis : Axis
        The axis it looks along.
    exposure_ms : float
        Until `configure` says otherwise.
    faults : Faults, optional
        What goes wrong with frames.

    Raises
    ------
    CameraTimeout
        From `trigger`: a fault let the frame get lost.
    """

    def __init__(
        self, maker: FrameMaker, axis: Axis, *, exposure_ms: float = 10.0, faults: Faults | None = None
    ) -> None:
        whole = maker.caps()
        self._crop = Crop(whole)
        self._shutter = Shutter(maker, axis)
        self._clock = axis.clock
        self._exposure_ms = exposure_ms
        self._faults = faults
        self._pixels = np.empty(whole.shape, whole.dtype)
        self._last = np.zeros_like(self._pixels)
        self._view = self._pixels.view()
        self._view.flags.writeable = False
        self._sink: FrameSink | None = None
        self._frames_left: float = 0
        self._exposed = 0

    def caps(self) -> CameraCaps:
        """Return what frames look like."""
        return self._crop.caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set exposure and part of the frame; raises `LimitError` for impossible ones."""
        check_exposure(exposure_ms)
        self._crop.choose(roi)
        self._exposure_ms = exposure_ms

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Deliver the next ``frames`` frames to ``sink``."""
        self._sink = sink
        self._frames_left = float("inf") if frames is None else frames

    def trigger(self) -> None:
        """Expose a frame and deliver it; raises `DeviceError` when not armed for it, or when it is lost."""
        if self._sink is None or self._frames_left < 1:
            raise DeviceError("camera: triggered without being armed for another frame.")
        start_ns, end_ns = self._shutter.expose(self._exposure_ms, self._pixels)
        self._frames_left -= 1
        self._exposed += 1
        if self._faults is not None:
            self._spoil(self._faults.strike("camera"))
        self._sink(self._crop(self._view), FrameStamp(round(self._clock.now() * NS), self._exposed, start_ns, end_ns))

    def _spoil(self, kinds: set[str]) -> None:
        spoil(self._pixels, self._last, kinds)
        np.copyto(self._last, self._pixels)
        if kinds & LOSING:
            raise CameraTimeout("camera: the frame did not come.", fix="switch the fault off.")

    def stop(self, timeout_s: float) -> None:  # noqa: ARG002  nothing to wait for
        """Deliver no more."""
        self._sink = None

    def close(self) -> None:
        """Deliver no more."""
        self._sink = None
