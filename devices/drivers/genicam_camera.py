"""Any camera with a GenTL producer, through Harvester. Needs the extra ``genicam``.

A camera without the features of a software trigger runs free and is untimed: the engine then keeps the first frame that
cannot have begun before the stage stood still.
"""

from __future__ import annotations

import importlib.util
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, TypeVar

from devices.drivers.cropping import Crop, centred, check_exposure
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

DRIVER = "genicam"
SIMULATED = "viky"  # a producer of three simulated cameras that comes with the package genicam
OPEN_S = 30.0
SETTING_S = 10.0
SHORTEST_FRAME_TIMEOUT_S = 2.0
EXPOSURES_PER_TIMEOUT = 5
FETCH_SLICE_S = 0.1
SLOWEST_READOUT_MS = 100.0
BUFFERS = 4
EXPOSURE_TOLERANCE = 0.1
EXPOSURE_NAMES = ("ExposureTime", "ExposureTimeAbs")  # both count µs; the second is of cameras before SFNC 2
SOFTWARE_TRIGGER = {"TriggerSelector": "FrameStart", "TriggerSource": "Software", "TriggerMode": "On"}
FORMATS = {
    "Mono8": (1, "uint8", 8),
    "Mono10": (1, "uint16", 10),
    "Mono12": (1, "uint16", 12),
    "Mono16": (1, "uint16", 16),
    "RGB8": (3, "uint8", 8),
    "RGBa8": (3, "uint8", 8),
}

T = TypeVar("T")


class GenicamCamera:
    """Frames of one camera, fetched in a thread of its own; incomplete ones are given back to it and counted.

    Parameters
    ----------
    harvester, acquirer : Harvester, ImageAcquirer
        With the camera opened.
    clock : Clock
        Time.

    Attributes
    ----------
    incomplete_frames : int
        Frames that came with holes since the camera was opened.
    """

    def __init__(self, harvester: Any, acquirer: Any, clock: Clock) -> None:
        self._harvester = harvester
        self._acquirer = acquirer
        self._nodes = acquirer.remote_device.node_map
        self._clock = clock
        self._sdk = SdkThread("the GenTL producer")
        self._timeout_s = SHORTEST_FRAME_TIMEOUT_S
        self._ending = Event()
        self._delivery: Future[None] | None = None
        self._failure: StereotomeError | None = None
        self.incomplete_frames = 0
        self._count_incomplete()
        self._triggered = _has(self._nodes, "TriggerSoftware") and all(_has(self._nodes, n) for n in SOFTWARE_TRIGGER)
        self._asked = Event()
        try:
            self._crop = Crop(self._call(self._read_caps, doing="looking at the camera"))
        except BaseException:
            self.close()
            raise

    def caps(self) -> CameraCaps:
        """Return what frames look like, as the camera is set now."""
        return self._crop.caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set exposure and part of the frame, which the driver cuts out.

        A camera without a feature for its exposure keeps its own, which its frame rate bounds.

        Raises
        ------
        LimitError
            The camera takes on another exposure.
        """
        check_exposure(exposure_ms)
        self._call(lambda: self._set_exposure(exposure_ms), doing="setting the exposure")
        self._timeout_s = max(SHORTEST_FRAME_TIMEOUT_S, EXPOSURES_PER_TIMEOUT * exposure_ms / 1000)
        self._crop.choose(roi)

    def apply_settings(self, settings: Mapping[str, Setting]) -> None:
        """Set features by name, as `devices.bands.BandSwitch` says; its part is kept while its size stays."""
        self._call(lambda: self._set_features(settings), doing="setting features")

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Deliver a number of frames, upon triggers or, if the camera has none, as they come."""
        self.stop(SETTING_S)
        self._ending.clear()
        self._asked.clear()
        started = Event()
        self._delivery = self._sdk.begin(lambda: self._deliver(frames, sink, started))
        if not started.wait(SETTING_S):
            raise CameraTimeout(f"camera: it did not start within {SETTING_S:g} s.")

    def trigger(self) -> None:
        """Ask for a frame; nothing for a camera that runs free. Raises the failure that ended the delivery."""
        if self._failure is not None:
            raise self._failure
        if self._triggered:
            self._asked.set()

    def stop(self, timeout_s: float) -> None:
        """End the delivery; raises `CameraTimeout` when the producer does not come back."""
        self._ending.set()
        self._sdk.wait(self._delivery or self._sdk.begin(_nothing), doing="ending", timeout_s=timeout_s)
        self._delivery, self._failure = None, None

    def close(self) -> None:
        """Release the camera; one that hangs is left to the end of the program."""
        if self._sdk.ended:
            return
        with suppress(DeviceError):
            self.stop(SETTING_S)
            self._call(self._release, doing="closing")
        self._sdk.end()

    def _release(self) -> None:
        self._acquirer.destroy()
        self._harvester.reset()

    def _count_incomplete(self) -> None:
        core = load_library("harvesters.core", driver=DRIVER, extra="genicam")
        self._acquirer.add_callback(self._acquirer.Events.INCOMPLETE_BUFFER, _counter(core.Callback, self._incomplete))

    def _incomplete(self) -> None:
        self.incomplete_frames += 1

    def _call(self, step: Callable[[], T], *, doing: str) -> T:
        return self._sdk.call(lambda: _told(step, doing), doing=doing, timeout_s=SETTING_S)

    def _read_caps(self) -> CameraCaps:
        bands, dtype, bits = self._format()
        return CameraCaps(
            name=f"genicam {self._acquirer.device.id_}",
            height=self._nodes.Height.value,
            width=self._nodes.Width.value,
            bands=bands,
            dtype=dtype,
            bit_depth=bits,
            timed=self._triggered,
            readout_ms=self._frame_ms(),
            triggers=frozenset({"software" if self._triggered else "free-run"}),
            numbered=True,
            buffered_frames=0 if self._triggered else BUFFERS,
            bit_depths=tuple(sorted({FORMATS[word][2] for word in self._formats()})),
        )

    def _format(self) -> tuple[int, str, int]:
        """Return bands, dtype and bits of the pixels; a format of no use is changed for the first that is of use."""
        node = self._nodes.PixelFormat
        if node.value not in FORMATS:
            usable = self._formats()
            if not usable:
                raise RigError(
                    f"camera: pixels of {node.value} are of no use here.",
                    fix=f"use a camera that does one of: {', '.join(FORMATS)}.",
                )
            node.value = usable[0]
        return FORMATS[node.value]

    def _formats(self) -> list[str]:
        return [word for word in FORMATS if word in self._nodes.PixelFormat.symbolics]

    def _frame_ms(self) -> float:
        """Return the longest time from the end of an exposure to its frame: no longer than between two frames."""
        for name in ("ResultingFrameRate", "AcquisitionFrameRate"):
            if _has(self._nodes, name) and getattr(self._nodes, name).value > 0:
                return float(1000 / getattr(self._nodes, name).value)
        return SLOWEST_READOUT_MS

    def _set_exposure(self, exposure_ms: float) -> None:
        names = [name for name in EXPOSURE_NAMES if _has(self._nodes, name)]
        if not names:
            return
        with suppress(*_value_errors()):
            getattr(self._nodes, names[0]).value = exposure_ms * 1000
        taken_ms = getattr(self._nodes, names[0]).value / 1000
        if abs(taken_ms - exposure_ms) > EXPOSURE_TOLERANCE * exposure_ms:
            raise LimitError(
                f"camera: it takes {taken_ms:g} ms for an exposure of {exposure_ms:g} ms.",
                fix="choose an exposure the camera can do.",
            )

    def _set_features(self, settings: Mapping[str, Setting]) -> None:
        known = [name for name in dir(self._nodes) if not name.startswith("_")]
        for name in settings:
            if name not in known or not hasattr(getattr(self._nodes, name), "value"):
                raise RigError(f"camera: it has no feature '{name}'{guess(name, known)}")
        for name, value in settings.items():
            self._set_feature(name, value)
        self._crop.renew(self._read_caps())

    def _set_feature(self, name: str, value: Setting) -> None:
        node = getattr(self._nodes, name)
        try:
            node.value = value
        except _value_errors() as cause:
            raise Refused(
                f"camera: {name} does not take {value!r}; it is {node.value!r}.", reason=str(cause)
            ) from cause

    def _deliver(self, frames: int | None, sink: FrameSink, started: Event) -> None:
        try:
            _told(lambda: self._stream(frames, sink, started), "an acquisition")
        except StereotomeError as failure:
            self._failure = failure
        finally:
            started.set()

    def _stream(self, frames: int | None, sink: FrameSink, started: Event) -> None:
        if self._triggered:
            for name, value in SOFTWARE_TRIGGER.items():
                getattr(self._nodes, name).value = value
        self._acquirer.start()
        started.set()
        try:
            self._fetch_all(frames, sink)
        finally:
            self._acquirer.stop()

    def _fetch_all(self, frames: int | None, sink: FrameSink) -> None:
        delivered = 0
        while not self._ending.is_set() and delivered != frames:
            start_ns = self._expose() if self._triggered else None
            if not self._triggered or start_ns is not None:
                delivered += self._fetch_one(sink, start_ns)

    def _expose(self) -> int | None:
        """Pass on a trigger, if one was asked for, and return the time before it."""
        if not self._asked.wait(FETCH_SLICE_S):
            return None
        self._asked.clear()
        start_ns = self._now_ns()
        self._nodes.TriggerSoftware.execute()
        return start_ns

    def _fetch_one(self, sink: FrameSink, start_ns: int | None) -> int:
        """Hand one frame to the sink; returns how many were.

        One that is late ends the delivery: it would be taken for that of the next trigger.
        """
        deadline = self._clock.now() + self._timeout_s
        while not self._ending.is_set():
            buffer = self._acquirer.try_fetch(timeout=FETCH_SLICE_S)
            if buffer is not None:
                with buffer:
                    self._hand_over(buffer, sink, start_ns)
                return 1
            if self._clock.now() > deadline:
                raise CameraTimeout(
                    f"camera: no whole frame within {self._timeout_s:g} s.",
                    why=f"{self.incomplete_frames} frames came with holes since the camera was opened.",
                    fix="check the camera's cable and network; a long exposure gets five times its length.",
                )
        return 0

    def _hand_over(self, buffer: Any, sink: FrameSink, start_ns: int | None) -> None:
        arrival_ns = self._now_ns()
        image = buffer.payload.components[0]
        if image.data_format not in FORMATS:
            raise DeviceError(f"camera: a frame of {image.data_format} came.", why="Its settings were changed.")
        pixels = image.data.reshape(image.height, image.width, -1)
        pixels = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels[:, :, :3]
        end_ns = None if start_ns is None else arrival_ns
        sink(self._crop(pixels), FrameStamp(arrival_ns, int(buffer.module.frame_id), start_ns, end_ns))

    def _now_ns(self) -> int:
        return round(self._clock.now() * 1e9)


def open_camera(table: CameraSpec, context: DeviceContext) -> GenicamCamera:
    """Open a camera of the producer ``source``: a ``.cti`` file, or ``"viky"`` for three simulated cameras.

    ``address`` is the camera's id or serial number; None takes the only one, or the first of the simulated.

    Raises
    ------
    RigError
        The extra or the producer is not installed, or the table names none.
    DeviceError
        device-missing: there is no such camera, or it is in use.
    """
    producer = _producer(table.source)
    harvester, acquirer = _opened(producer, table)
    camera = GenicamCamera(harvester, acquirer, context.clock)
    try:
        if table.size_px is not None:
            camera.configure(exposure_ms=table.exposure_ms, roi=centred(camera.caps(), table.size_px))
    except BaseException:
        camera.close()
        raise
    return camera


def _producer(source: str | None) -> Path:
    if source is None:
        raise RigError(f"camera: the driver '{DRIVER}' needs source, the .cti file of the camera's maker, or 'viky'.")
    if source != SIMULATED:
        producer = Path(source)
    else:
        load_library("genicam", driver=DRIVER, extra="genicam")
        found = importlib.util.find_spec("genicam")
        producer = Path(str(found.origin if found else "")).parent / "viky.cti"
    if not producer.is_file():
        raise RigError(f"camera: {producer}: no such file.", fix="correct source in the instrument file.")
    return producer


def _opened(producer: Path, table: CameraSpec) -> tuple[Any, Any]:
    """Open in a thread of its own, as producers may hang too."""
    core = load_library("harvesters.core", driver=DRIVER, extra="genicam")
    sdk = SdkThread("the GenTL producer")
    try:
        return sdk.call(
            lambda: _told(lambda: _open(core, producer, table), "opening"), doing="opening", timeout_s=OPEN_S
        )
    finally:
        sdk.end()


def _open(core: Any, producer: Path, table: CameraSpec) -> tuple[Any, Any]:
    harvester = core.Harvester()
    try:
        harvester.add_file(str(producer))
        harvester.update()
        acquirer = harvester.create({"id_": _chosen(harvester.device_info_list, table)})
    except BaseException:
        harvester.reset()
        raise
    acquirer.num_buffers = BUFFERS
    return harvester, acquirer


def _chosen(found: list[Any], table: CameraSpec) -> str:
    """Return the id of the camera the table means."""
    wanted = table.address
    for camera in found:
        if wanted in (camera.id_, camera.serial_number) or (wanted is None and table.source == SIMULATED):
            return str(camera.id_)
    if wanted is None and len(found) == 1:
        return str(found[0].id_)
    ids = ", ".join(str(camera.id_) for camera in found) or "none"
    raise DeviceError(
        f"camera: {table.source} has no camera {wanted}."
        if wanted
        else f"camera: {table.source} has {len(found)} cameras.",
        why=f"Cameras there now: {ids}.",
        fix="set address to the id of one of them, or check cable and power.",
        code="device-missing",
    )


def _counter(base: Any, count: Callable[[], None]) -> Any:
    """Return a callback of Harvester's kind that calls ``count``."""

    class Counter(base):  # type: ignore[misc]  # of a library without types
        def emit(self, context: Any) -> None:  # noqa: ARG002  Harvester's signature
            count()

    return Counter()


def _has(nodes: Any, name: str) -> bool:
    """Tell whether a camera has a feature and lets it be used now."""
    node = getattr(nodes, name, None)
    if node is None:
        return False
    genapi = load_library("genicam.genapi", driver=DRIVER, extra="genicam")
    return node.get_access_mode() in (genapi.EAccessMode.RW, genapi.EAccessMode.RO, genapi.EAccessMode.WO)


def _value_errors() -> tuple[type[Exception], ...]:
    """Return what a feature raises upon a value it does not take."""
    genapi = load_library("genicam.genapi", driver=DRIVER, extra="genicam")
    return (genapi.GenericException, TypeError)


def _told(step: Callable[[], T], doing: str) -> T:
    """Do a step; what the producer complains of becomes an error of ours."""
    try:
        return step()
    except _complaints() as cause:
        raise DeviceError(
            f"camera: the GenTL producer failed in {doing}.",
            why=" ".join(str(cause).split()),
            fix="check the camera's cable and power, then start again.",
        ) from cause


def _complaints() -> tuple[type[Exception], ...]:
    """Return what a producer, and Harvester on top of it, raise."""
    gentl = load_library("genicam.gentl", driver=DRIVER, extra="genicam")
    return (gentl.GenericException, *_value_errors(), OSError, ValueError, AttributeError, IndexError)


def _nothing() -> None:
    """Be done: whoever waits for it knows that all before it is."""
