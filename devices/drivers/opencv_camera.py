"""Any source that OpenCV opens: UVC cameras, video files, numbered images. It runs free and carries no times."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING

import cv2
import numpy as np

from devices.drivers.cropping import Crop, check_exposure
from devices.errors import CameraTimeout, DeviceError, LimitError, LinkLost, RigError, StereotomeError
from devices.values import CameraCaps, FrameStamp

if TYPE_CHECKING:
    from devices.protocols import Clock, FrameSink
    from devices.registry import DeviceContext
    from devices.rig import CameraSpec
    from devices.values import Roi

BUFFERED_FRAMES = 4  # V4L2 and Media Foundation queue about this many; older frames come first
SLOWEST_READOUT_MS = 100.0
CLOSE_S = 2.0
MANUAL_EXPOSURE = 1  # V4L2's name for "not automatic"
EXPOSURE_UNITS_PER_MS = 10.0  # V4L2 counts 100 µs


class OpenCvCamera:
    """Delivers frames as they come, from a thread of its own that never lets them pile up.

    `trigger` asks for nothing; it only tells of a camera that is gone. The frames of a file or of numbered images come
    one per exposure.

    Parameters
    ----------
    spec : CameraSpec
        ``source`` is an index, a device, a file, or a pattern such as ``"z%03d.tif"``.
    clock : Clock
        Time.

    Raises
    ------
    DeviceError
        The source does not open (device-missing), or frames are not as the file says.
    """

    def __init__(self, spec: CameraSpec, clock: Clock) -> None:
        self._spec = spec
        self._clock = clock
        self._exposure_s = spec.exposure_ms / 1000
        self._recorded = not _is_device(str(spec.source))
        self._capture = _opened(spec)
        self._crop = Crop(self._caps_of_first_frame())
        self._thread: Thread | None = None
        self._ending = Event()
        self._failure: StereotomeError | None = None

    def caps(self) -> CameraCaps:
        """Return what frames look like; nothing is known of their times but the arrival."""
        return self._crop.caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set exposure and part of the frame; raises `LimitError` when the camera insists on its own exposure."""
        check_exposure(exposure_ms)
        self._crop.choose(roi)
        self._exposure_s = exposure_ms / 1000
        if self._recorded:
            return
        self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, exposure_ms * EXPOSURE_UNITS_PER_MS):
            raise LimitError(
                f"camera: {self._spec.source} does not let its exposure be set to {exposure_ms:g} ms.",
                why="Frames of unknown exposure cannot be told from frames exposed while the stage moved.",
                fix="use a camera with manual exposure.",
            )

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Deliver a number of frames to ``sink``, from now on, as they arrive."""
        self.stop(timeout_s=1.0)
        self._ending.clear()
        self._failure = None
        self._thread = Thread(target=self._deliver, args=(frames, sink), name="opencv-camera", daemon=True)
        self._thread.start()

    def trigger(self) -> None:
        """Do nothing, for the camera runs free; raises what ended the delivery: `LinkLost` once it is gone."""
        if self._failure is not None:
            raise self._failure

    def stop(self, timeout_s: float) -> None:
        """End the delivery; raises `CameraTimeout` when the camera's driver does not come back."""
        self._ending.set()
        if self._thread is None:
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise CameraTimeout(f"camera: {self._spec.source} did not stop within {timeout_s:g} s.")
        self._thread = None

    def close(self) -> None:
        """Release the camera; one that hangs is left to the end of the program."""
        with suppress(CameraTimeout):
            self.stop(CLOSE_S)
            self._capture.release()

    def _deliver(self, frames: int | None, sink: FrameSink) -> None:
        try:
            self._deliver_all(frames, sink)
        except StereotomeError as failure:
            self._failure = failure

    def _deliver_all(self, frames: int | None, sink: FrameSink) -> None:
        number = 0
        while not self._ending.is_set() and number != frames:
            found, pixels = self._read()
            arrival_ns = int(self._clock.now() * 1e9)
            if not found:
                raise _gone(self._spec, number)
            number += 1
            sink(self._crop(_rgb(pixels)), FrameStamp(arrival_ns))
            if self._recorded:
                self._clock.sleep(self._exposure_s)

    def _read(self) -> tuple[bool, np.ndarray]:
        try:
            return self._capture.read()
        except cv2.error:  # a frame that does not decode: as good as none
            return False, np.empty(0)

    def _caps_of_first_frame(self) -> CameraCaps:
        found, pixels = self._read()
        if not found:
            raise DeviceError(f"camera: {self._spec.source} opens, but gives no frame.", code="device-silent")
        if self._recorded:
            self._capture.release()
            self._capture = _opened(self._spec)
        height, width = pixels.shape[:2]
        wanted = self._spec.size_px
        if wanted is not None and wanted != (width, height):
            raise RigError(f"camera: {self._spec.source} gives {width} x {height} px, but size_px is {list(wanted)}.")
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        return CameraCaps(
            name=f"opencv {self._spec.source}",
            height=height,
            width=width,
            bands=1 if pixels.ndim == 2 else 3,
            dtype=str(pixels.dtype),
            bit_depth=8 if pixels.dtype == np.uint8 else max(self._spec.bit_depth, 9),
            timed=False,
            readout_ms=1000 / rate_hz if rate_hz > 0 else SLOWEST_READOUT_MS,
            buffered_frames=0 if self._recorded else BUFFERED_FRAMES,
            triggers=frozenset({"free-run"}),
        )


def open_camera(table: CameraSpec, context: DeviceContext) -> OpenCvCamera:
    """Open the camera named by ``source``; raises as `OpenCvCamera` does."""
    return OpenCvCamera(table, context.clock)


def _is_device(source: str) -> bool:
    return source.isdigit() or source.startswith("/dev/")


def _opened(spec: CameraSpec) -> cv2.VideoCapture:
    source = str(spec.source)
    cv2.utils.logging.setLogLevel(
        cv2.utils.logging.LOG_LEVEL_SILENT
    )  # OpenCV prints its own account of every failure; ours is enough
    if "%" in source:
        capture = cv2.VideoCapture(source, cv2.CAP_IMAGES)
    elif source.startswith("/dev/"):
        capture = cv2.VideoCapture(str(Path(source).resolve()))  # a name by-id is a link, which OpenCV does not follow
    else:
        capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    if not capture.isOpened():
        raise DeviceError(
            f"camera: {source} does not open.",
            why="There is no such camera or file, another program uses it, or its format is unknown to OpenCV.",
            fix="see what is connected: stereotome devices list",
            code="device-missing",
        )
    if spec.size_px is not None and _is_device(source):
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, spec.size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, spec.size_px[1])
    return capture


def _rgb(pixels: np.ndarray) -> np.ndarray:
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, 2::-1])


def _gone(spec: CameraSpec, number: int) -> LinkLost:
    return LinkLost(
        f"camera: {spec.source} gave no more frames after {number}.",
        why="The camera was unplugged, or the recording ended.",
        fix="check the cable, then start again.",
    )
