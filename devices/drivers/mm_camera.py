"""Any camera that Micro-Manager has an adapter for, through its core library. Needs the extra ``mm``."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from devices.drivers.cropping import centred, check_exposure, check_frame
from devices.drivers.sdk_thread import SdkThread, guess, load_library
from devices.errors import CameraTimeout, DeviceError, LimitError, Refused, RigError, StereotomeError
from devices.values import CameraCaps, FrameStamp, Roi

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future

    from devices.bands import Setting
    from devices.protocols import Clock, FrameSink
    from devices.registry import DeviceContext
    from devices.rig import CameraSpec

DRIVER = "micro-manager"
LABEL = "camera"
OPEN_S = 30.0  # some makers' libraries load firmware into the camera
SETTING_S = 10.0
SHORTEST_FRAME_TIMEOUT_S = 2.0
EXPOSURES_PER_TIMEOUT = 5
POLL_S = 0.001
EXPOSURE_TOLERANCE = 0.1  # cameras count exposures in lines of their sensor
SLOWEST_READOUT_MS = 100.0
COMPONENTS = 4  # colours come as blue, green, red and nothing

T = TypeVar("T")


class MicroManagerCamera:
    """Snaps upon triggers, or runs free as a sequence whose image numbers are handed on.

    A snap begins after it was asked for: the time before that is the beginning of its exposure, and when the core comes
    back it has ended.

    Parameters
    ----------
    core : pymmcore.CMMCore
        With a camera chosen. Used in the driver's own thread only, so that `stop` is back in time even when an adapter
        hangs.
    clock : Clock
        Time.

    Raises
    ------
    DeviceError
        Micro-Manager has no camera here, or frames this program has no use for.
    """

    def __init__(self, core: Any, clock: Clock) -> None:
        self._core = core
        self._clock = clock
        self._sdk = SdkThread("Micro-Manager")
        self._timeout_s = SHORTEST_FRAME_TIMEOUT_S
        self._sink: FrameSink | None = None
        self._frames_left: int | None = None
        self._ending = Event()
        self._delivery: Future[None] | None = None
        self._failure: StereotomeError | None = None
        try:
            self._caps = self._call(self._read_caps, doing="looking at the camera")
        except BaseException:
            self.close()
            raise

    def caps(self) -> CameraCaps:
        """Return what frames look like, as the camera is set now."""
        return self._caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set exposure and part of the frame, which the camera cuts out itself; read back.

        Raises
        ------
        LimitError
            The camera takes on another exposure or part.
        """
        check_exposure(exposure_ms)
        self._call(lambda: self._set_exposure(exposure_ms), doing="setting the exposure")
        self._timeout_s = max(SHORTEST_FRAME_TIMEOUT_S, EXPOSURES_PER_TIMEOUT * exposure_ms / 1000)
        if roi is not None:
            self._call(lambda: self._set_roi(roi), doing="setting the part of the frame")

    def apply_settings(self, settings: Mapping[str, Setting]) -> None:
        """Set properties, ``"Device.Property"`` or ``"Property"`` of the camera, as `devices.bands.BandSwitch` says."""
        self._call(lambda: self._set_properties(settings), doing="setting properties")

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Get ready for a number of triggers."""
        self.stop(SETTING_S)
        self._sink, self._frames_left = sink, frames

    def trigger(self) -> None:
        """Snap a frame and hand it to the sink. When running free do nothing but tell of a failure.

        Raises
        ------
        CameraTimeout
            No frame within five exposures, or 2 s when that is longer.
        DeviceError
            The camera failed, or was not armed for another frame.
        """
        if self._failure is not None:
            raise self._failure
        if self._delivery is not None:
            return
        if self._sink is None or self._frames_left == 0:
            raise DeviceError("camera: triggered without being armed for another frame.")
        pixels, stamp = self._call(self._snap, doing="an exposure", timeout_s=self._timeout_s)
        self._frames_left = None if self._frames_left is None else self._frames_left - 1
        self._sink(pixels, stamp)

    def arm_free_run(self, frames: int | None, sink: FrameSink) -> None:
        """Deliver frames as they come, each with the core's image number as its ``hw_id``."""
        self.stop(SETTING_S)
        self._ending.clear()
        self._delivery = self._sdk.begin(lambda: self._deliver(frames, sink))

    def stop(self, timeout_s: float) -> None:
        """End the delivery; raises `CameraTimeout` when Micro-Manager does not come back."""
        self._sink, self._failure = None, None
        self._ending.set()
        delivery, doing = self._delivery, "ending"
        self._sdk.wait(delivery or self._sdk.begin(_nothing), doing=doing, timeout_s=timeout_s)
        self._delivery = None

    def close(self) -> None:
        """Release the camera; one that hangs is left to the end of the program."""
        if self._sdk.ended:
            return
        with suppress(DeviceError):
            self.stop(SETTING_S)
            self._call(self._core.reset, doing="closing")
        self._sdk.end()

    def _call(self, step: Callable[[], T], *, doing: str, timeout_s: float = SETTING_S) -> T:
        return self._sdk.call(lambda: _told(step, doing), doing=doing, timeout_s=timeout_s)

    def _read_caps(self) -> CameraCaps:
        core = self._core
        camera = core.getCameraDevice()
        if not camera:
            raise RigError("camera: Micro-Manager's configuration names no camera.", fix="set address to its label.")
        bits, components = core.getImageBitDepth(), core.getNumberOfComponents()
        if (core.getBytesPerPixel(), components) not in ((1, 1), (2, 1), (COMPONENTS, COMPONENTS)):
            raise RigError(
                f"camera: pixels of {core.getBytesPerPixel()} bytes and {components} components are of no use here.",
                fix="set its PixelType to 8 bit, 16 bit or 32 bit RGB.",
            )
        return CameraCaps(
            name=f"{core.getDeviceLibrary(camera)} {core.getDeviceName(camera)}",
            height=core.getImageHeight(),
            width=core.getImageWidth(),
            bands=1 if components == 1 else 3,
            dtype="uint16" if core.getBytesPerPixel() == 2 else "uint8",
            bit_depth=bits,
            timed=True,
            readout_ms=SLOWEST_READOUT_MS,
            triggers=frozenset({"software", "free-run"}),
            roi_in_camera=True,
            bit_depths=self._bit_depths(camera),
        )

    def _bit_depths(self, camera: str) -> tuple[int, ...]:
        if not self._core.hasProperty(camera, "BitDepth"):
            return ()
        words = self._core.getAllowedPropertyValues(camera, "BitDepth")
        return tuple(sorted(int(word) for word in words if word.isdigit() and 8 <= int(word) <= 16))

    def _set_exposure(self, exposure_ms: float) -> None:
        self._core.setExposure(exposure_ms)
        taken_ms = self._core.getExposure()
        if abs(taken_ms - exposure_ms) > EXPOSURE_TOLERANCE * exposure_ms:
            raise LimitError(
                f"camera: it takes {taken_ms:g} ms for an exposure of {exposure_ms:g} ms.",
                fix="choose an exposure the camera can do.",
            )

    def _set_roi(self, roi: Roi) -> None:
        before = self._core.getROI()
        self._core.clearROI()
        try:
            roi.check(self._read_caps())
        except LimitError:
            self._core.setROI(*before)
            raise
        self._core.setROI(roi.x, roi.y, roi.width, roi.height)
        self._caps = self._read_caps()
        if (taken := tuple(self._core.getROI())) != (roi.x, roi.y, roi.width, roi.height):
            raise LimitError(
                f"camera: it takes x, y, width, height = {taken} for {roi}.",
                fix="choose corners and sizes that are multiples of 16.",
            )

    def _set_properties(self, settings: Mapping[str, Setting]) -> None:
        places = [(self._place(name), value) for name, value in settings.items()]
        for (device, name), value in places:
            word = str(int(value)) if isinstance(value, bool) else str(value)
            self._core.setProperty(device, name, word)
            self._core.waitForDevice(device)
            taken = self._core.getProperty(device, name)
            if not _same(taken, word):
                raise Refused(f"camera: {device}.{name} is {taken}, not {word}.", reason=taken)
        self._caps = self._read_caps()

    def _place(self, name: str) -> tuple[str, str]:
        """Return device and property of a setting's name."""
        device, point, property_name = name.partition(".")
        if not point:
            device, property_name = self._core.getCameraDevice(), name
        devices = list(self._core.getLoadedDevices())
        if device not in devices:
            raise RigError(f"camera: Micro-Manager has no device '{device}'{guess(device, devices)}")
        known = list(self._core.getDevicePropertyNames(device))
        if property_name not in known:
            raise RigError(f"camera: {device} has no property '{property_name}'{guess(property_name, known)}")
        return device, property_name

    def _snap(self) -> tuple[np.ndarray, FrameStamp]:
        start_ns = self._now_ns()
        self._core.snapImage()
        end_ns = self._now_ns()
        pixels = self._checked(self._core.getImage())
        return pixels, FrameStamp(self._now_ns(), None, start_ns, end_ns)

    def _checked(self, pixels: np.ndarray) -> np.ndarray:
        """Return grey or RGB pixels, if they are as `caps` says."""
        pixels = _grey_or_rgb(pixels)
        check_frame(pixels, self._caps)
        return pixels

    def _now_ns(self) -> int:
        return round(self._clock.now() * 1e9)

    def _deliver(self, frames: int | None, sink: FrameSink) -> None:
        try:
            _told(lambda: self._run_sequence(frames, sink), "a sequence")
        except StereotomeError as failure:
            self._failure = failure

    def _run_sequence(self, frames: int | None, sink: FrameSink) -> None:
        self._core.startSequenceAcquisition(2**31 - 1 if frames is None else frames, 0.0, True)  # noqa: FBT003
        try:
            self._pop(frames, sink)
        finally:
            self._core.stopSequenceAcquisition()

    def _pop(self, frames: int | None, sink: FrameSink) -> None:
        delivered, last_s = 0, self._clock.now()
        while not self._ending.is_set() and delivered != frames:
            if self._core.isBufferOverflowed():
                raise DeviceError(f"camera: frames were lost after {delivered}: Micro-Manager's buffer ran over.")
            if self._core.getRemainingImageCount() > 0:
                sink(*self._next_image())
                delivered, last_s = delivered + 1, self._clock.now()
            elif self._clock.now() - last_s > self._timeout_s:
                raise CameraTimeout(f"camera: no frame after {delivered} within {self._timeout_s:g} s.")
            else:
                self._clock.sleep(POLL_S)

    def _next_image(self) -> tuple[np.ndarray, FrameStamp]:
        said = load_library("pymmcore", driver=DRIVER, extra="mm").Metadata()
        pixels = self._core.popNextImageMD(said)
        number = said.GetSingleTag("ImageNumber").GetValue() if said.HasTag("ImageNumber") else ""
        return self._checked(pixels), FrameStamp(self._now_ns(), int(number) if number.isdigit() else None)


def open_camera(table: CameraSpec, context: DeviceContext) -> MicroManagerCamera:
    """Open the camera of a configuration file (``source`` ends in ``.cfg``) or of an adapter.

    ``source = "DemoCamera"``, ``address = "DCam"`` are library and device of an adapter; for a configuration file
    ``address`` is the label of the camera, None takes the file's own.

    Raises
    ------
    RigError
        The extra or Micro-Manager's adapters are not installed, or the table names no source.
    DeviceError
        device-missing: the adapter or camera does not start.
    """
    if table.source is None:
        raise RigError(f"camera: the driver '{DRIVER}' needs source, a .cfg file or the name of an adapter.")
    camera = MicroManagerCamera(_loaded_core(table), context.clock)
    try:
        if table.size_px is not None:
            camera.configure(exposure_ms=table.exposure_ms, roi=centred(camera.caps(), table.size_px))
    except BaseException:
        camera.close()
        raise
    return camera


def _loaded_core(table: CameraSpec) -> Any:
    """Load adapters in a thread of their own, as they may hang too."""
    plus = load_library("pymmcore_plus", driver=DRIVER, extra="mm")
    folder = plus.find_micromanager()
    if folder is None:
        raise RigError("camera: Micro-Manager's device adapters are not installed.", fix="run: mmcore install")
    sdk = SdkThread("Micro-Manager")
    core = load_library("pymmcore", driver=DRIVER, extra="mm").CMMCore()
    core.setDeviceAdapterSearchPaths([str(folder)])
    try:
        sdk.call(lambda: _load(core, table), doing="opening the camera", timeout_s=OPEN_S)
    except (RuntimeError, ValueError) as cause:
        raise DeviceError(
            f"camera: Micro-Manager cannot open {table.source} {table.address or ''}".rstrip() + ".",
            why=str(cause),
            fix="check camera, cable and power; try the same in Micro-Manager itself.",
            code="device-missing",
        ) from cause
    finally:
        sdk.end()
    return core


def _load(core: Any, table: CameraSpec) -> None:
    source = str(table.source)
    if source.endswith(".cfg"):
        if not Path(source).is_file():
            raise RigError(f"camera: {source}: no such file.", fix="correct source in the instrument file.")
        core.loadSystemConfiguration(source)
        if table.address is not None:
            core.setCameraDevice(table.address)
        return
    core.loadDevice(LABEL, source, table.address or "")
    core.initializeDevice(LABEL)
    core.setCameraDevice(LABEL)


def _told(step: Callable[[], T], doing: str) -> T:
    """Do a step; what Micro-Manager complains of becomes an error of ours."""
    try:
        return step()
    except (RuntimeError, IndexError, ValueError) as cause:
        raise DeviceError(
            f"camera: Micro-Manager failed in {doing}.",
            why=" ".join(str(cause).split()),
            fix="check the camera's cable and power, then start again.",
        ) from cause


def _same(taken: str, word: str) -> bool:
    try:
        return taken == word or abs(float(taken) - float(word)) <= 1e-3 * abs(float(word))
    except ValueError:
        return False


def _grey_or_rgb(pixels: np.ndarray) -> np.ndarray:
    """Return grey as it is; four bytes a pixel as red, green, blue."""
    if pixels.dtype != np.uint32:
        return pixels
    four = pixels.view(np.uint8).reshape(*pixels.shape, COMPONENTS)
    return np.ascontiguousarray(four[:, :, 2::-1])


def _nothing() -> None:
    """Be done: whoever waits for it knows that all before it is."""
