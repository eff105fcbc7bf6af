"""Frames to look at while nothing is recorded: through a ring of their own, which nobody can hold up."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import TYPE_CHECKING

from acquire.frame import FrameHeader
from acquire.replies import Picture
from acquire.ring import RingFull, RingWriter
from acquire.snap import snap
from acquire.taker import FIRST_FRAME_S
from devices.errors import StereotomeError
from devices.protocols import FreeRunningCamera

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from devices.protocols import Camera, Clock
    from devices.values import CameraCaps, FrameStamp, Roi

log = logging.getLogger(__name__)
SLOTS = 4
NOT_A_PLANE = -1
TRIES = 3
CAMERA_STOP_S = 2.0


class LiveView:
    """The camera between runs. Used by one thread at a time; `ring_path` and `running` may be read by any.

    Parameters
    ----------
    camera : callable
        Returns the camera: a run may have opened it anew.
    z_um : callable
        Where the stage was read last; NaN before.
    """

    def __init__(
        self, camera: Callable[[], Camera], clock: Clock, exposure_ms: float, z_um: Callable[[], float]
    ) -> None:
        self.exposure_ms = exposure_ms
        self.frames_per_s = 30.0
        self._current = camera
        self._clock = clock
        self._z_um = z_um
        self._ring: RingWriter | None = None
        self._arrived = threading.Event()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self.caps = camera().caps()

    @property
    def _camera(self) -> Camera:
        return self._current()

    @property
    def running(self) -> bool:
        """Whether frames are shown."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def ring_path(self) -> str:
        """The ring's file; empty before the first frame."""
        ring = self._ring
        return "" if ring is None else str(ring.path)

    def start(self, frames_per_s: float) -> None:
        """Show frames as they come, at most so many; one that cannot be taken ends it after some tries."""
        self.stop()
        self.frames_per_s = frames_per_s
        self._over.clear()
        self._begin()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Show no more."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._over.set()
            thread.join()

    def configure(self, exposure_ms: float, roi: Roi | None) -> None:
        """Set exposure and part of the frame, also while frames are shown."""
        with_live = self.running
        self.stop()
        try:
            self._camera.configure(exposure_ms=exposure_ms, roi=roi)
            self.exposure_ms = exposure_ms
            self.caps = self._camera.caps()
        finally:
            if with_live:
                self.start(self.frames_per_s)

    def snap(self, z_um: float) -> Picture:
        """Take one frame, show it, and return it."""
        with_live = self.running
        self.stop()
        try:
            self._begin()
            pixels, header = snap(self._camera, self._clock, self.exposure_ms, z_um)
            self._show(pixels, header)
        finally:
            if with_live:
                self.start(self.frames_per_s)
        return Picture(
            shape=pixels.shape,
            dtype="uint8" if pixels.dtype.name == "uint8" else "uint16",
            pixels=pixels.tobytes(),
            z_um=header.z_um,
            exposure_ms=header.exposure_ms,
            utc_ns=header.utc_ns,
        )

    def close(self) -> None:
        """Show no more and give up the ring."""
        self.stop()
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    def _begin(self) -> None:
        """Have the camera set as here, and a ring for its frames: a run may have set it otherwise meanwhile."""
        self._camera.configure(exposure_ms=self.exposure_ms)
        self.caps = caps = self._camera.caps()
        if self._ring is None or not _fits(self._ring, caps):
            before, self._ring = self._ring, RingWriter.create("live", caps.shape, caps.dtype, SLOTS, clock=self._clock)
            if before is not None:
                before.close()

    def _run(self) -> None:
        try:
            self._stream()
        except StereotomeError as error:
            log.warning("live: %s", error.what)
        finally:
            self._camera.stop(CAMERA_STOP_S)

    def _stream(self) -> None:
        free = isinstance(self._camera, FreeRunningCamera)
        if isinstance(self._camera, FreeRunningCamera):
            self._camera.arm_free_run(None, self._take)
        else:
            self._camera.arm(None, self._take)
        missed = 0
        while not self._over.is_set() and missed < TRIES:
            due_s = self._clock.now() + 1 / self.frames_per_s
            self._arrived.clear()
            if not free:
                self._camera.trigger()
            missed = 0 if self._arrived.wait(max(FIRST_FRAME_S, 5 * self.exposure_ms / 1000)) else missed + 1
            self._over.wait(max(0.0, due_s - self._clock.now()))

    def _take(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        """Take a frame from the camera, in whatever thread it comes."""
        z_um = self._z_um()
        header = FrameHeader(
            plane=NOT_A_PLANE,
            setpoint_um=z_um,
            z_um=z_um,
            exposure_ms=self.exposure_ms,
            exposure_start_ns=stamp.exposure_start_ns or 0,
            exposure_end_ns=stamp.exposure_end_ns or 0,
            arrival_ns=stamp.arrival_ns,
            utc_ns=time.time_ns(),
            hw_id=-1 if stamp.hw_id is None else stamp.hw_id,
        )
        self._show(pixels, header)

    def _show(self, pixels: np.ndarray, header: FrameHeader) -> None:
        if self._ring is not None and pixels.shape == self._ring.geometry.shape:
            with contextlib.suppress(RingFull):  # a reader that claims every frame has no claim on the live view
                self._ring.push(pixels, header, timeout_s=0)
        self._arrived.set()


def _fits(ring: RingWriter, caps: CameraCaps) -> bool:
    return (ring.geometry.shape, ring.geometry.dtype) == (caps.shape, caps.dtype)
