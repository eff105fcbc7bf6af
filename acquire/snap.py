"""One picture, begun after it was asked for."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.frame import FrameHeader
from acquire.gate import FrameGate
from acquire.taker import FIRST_FRAME_S, POLL_S
from devices.errors import CameraTimeout

if TYPE_CHECKING:
    from devices.protocols import Camera, Clock


@dataclass
class _Picture:
    """Keeps the one frame a gate lets through."""

    pixels: np.ndarray
    header: FrameHeader

    def put(self, pixels: np.ndarray, header: FrameHeader) -> None:
        self.pixels, self.header = pixels.copy(), header


def snap(camera: Camera, clock: Clock, exposure_ms: float, z_um: float) -> tuple[np.ndarray, FrameHeader]:
    """Arm, take one frame whose exposure begins from now on, and disarm.

    Raises
    ------
    CameraTimeout
        None came.
    """
    header = FrameHeader(plane=-1, setpoint_um=z_um, z_um=z_um, exposure_ms=exposure_ms, utc_ns=time.time_ns())
    picture = _Picture(np.empty(0), header)
    gate = FrameGate(picture, camera.caps(), exposure_ms)
    camera.arm(None, gate)
    try:
        gate.expect(header, round(clock.now() * 1e9))
        camera.trigger()
        deadline = clock.now() + max(FIRST_FRAME_S, 5 * exposure_ms / 1000)
        while not gate.passed():
            if clock.now() > deadline:
                raise CameraTimeout("camera: no frame came.", fix="stereotome doctor")
            clock.sleep(POLL_S)
    finally:
        gate.forget()
        camera.stop(2.0)
    return picture.pixels, picture.header
