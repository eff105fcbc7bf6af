"""Cameras × faults: each ends in an error of ours or in the right frame, never in a frame that is another's."""

from __future__ import annotations

import json
import os
import shutil
import threading
from contextlib import closing, suppress
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.clock import SystemClock
from devices.drivers import folder_camera, genicam_camera, mm_camera, opencv_camera, sim_camera
from devices.errors import CameraTimeout, DeviceError, IncompleteFrame, LinkLost, StereotomeError
from devices.registry import DeviceContext
from devices.rig import CameraSpec
from devices.values import CameraCaps, FrameStamp, Limits
from sim.camera import Replay
from sim.camera_server import LATE_FRAME_S, CameraServer
from sim.clock import SimClock
from sim.faults import Faults, parse_fault
from sim.motion import Axis

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SHAPE = (6, 8)
PLENTY_S = 20.0
SHORT_S = 0.05


class Taken:
    """A sink that keeps copies and can be waited for."""

    def __init__(self) -> None:
        self.frames: list[tuple[np.ndarray, FrameStamp]] = []
        self.grown = threading.Condition()

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        with self.grown:
            self.frames.append((pixels.copy(), stamp))
            self.grown.notify_all()

    def wait_for(self, count: int) -> None:
        with self.grown:
            assert self.grown.wait_for(lambda: len(self.frames) >= count, PLENTY_S)

    @property
    def ids(self) -> list[int | None]:
        return [stamp.hw_id for _, stamp in self.frames]


def fails(do: Callable[[], object]) -> StereotomeError:
    with pytest.raises(StereotomeError) as caught:
        do()
    return caught.value


class Held:
    """A call that hangs until it is let go."""

    def __init__(self) -> None:
        self.begun, self.let_go = threading.Event(), threading.Event()

    def __call__(self, *_: object) -> None:
        self.begun.set()
        assert self.let_go.wait(PLENTY_S)


class Wrapped:
    """Something of another maker, with a part of it replaced."""

    def __init__(self, inner: object, **replaced: object) -> None:
        self.__dict__.update(replaced, _inner=inner)

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)


# -- the bench's camera ----------------------------------------------------------------------------------------------


class LateWhenLet(SystemClock):
    """A clock on which a late frame is late until it is let come."""

    def __init__(self) -> None:
        self.held = Held()

    def sleep(self, seconds: float) -> None:
        self.held() if seconds >= LATE_FRAME_S else super().sleep(seconds)


class OverTcp:
    """The simulated camera, its driver, and the faults between them."""

    def __init__(self) -> None:
        self.clock = LateWhenLet()
        self.faults = Faults((), self.clock)
        caps = CameraCaps("replay", *SHAPE, bands=1, dtype="uint16", bit_depth=16, timed=True)
        frames = np.arange(1, 9, dtype=np.uint16)[:, None, None] * np.ones(SHAPE, np.uint16)
        axis = Axis(self.clock, Limits(-100.0, 100.0))
        self.server = CameraServer(Replay(frames, caps), axis, self.faults, exposure_ms=0.1)
        self.thread = threading.Thread(target=self.server.serve, daemon=True)
        self.thread.start()
        self.camera = self.opened()

    def opened(self) -> sim_camera.SimCamera:
        return sim_camera.open_camera(CameraSpec(driver="sim", address=self.server.address), context())

    def strike(self, fault: str) -> None:
        self.faults.switch_on(parse_fault(fault))

    def close(self) -> None:
        self.camera.close()
        self.server.close()
        self.thread.join()


def context(z_um: float = 0.0) -> DeviceContext:
    return DeviceContext(SystemClock(), None, lambda: z_um)


@pytest.fixture
def bench():
    with closing(OverTcp()) as bench:
        yield bench


def hurry(camera, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let a camera give up at once, upon a frame that comes only when it is let; return what gives it time again."""
    with monkeypatch.context() as hurried:
        for module in (sim_camera, mm_camera, genicam_camera):
            hurried.setattr(module, "SHORTEST_FRAME_TIMEOUT_S", SHORT_S)
        camera.configure(exposure_ms=2.0)
    return lambda: camera.configure(exposure_ms=2.0)


@pytest.mark.parametrize(("fault", "error"), [("camera.drop@1", CameraTimeout), ("camera.half@1", IncompleteFrame)])
def test_sim_a_frame_does_not_come_whole_and_the_next_is_the_next(bench: OverTcp, monkeypatch, fault: str, error: type):
    taken = Taken()
    bench.camera.arm(None, taken)
    bench.strike(fault)
    relax = hurry(bench.camera, monkeypatch) if error is CameraTimeout else bench.camera.caps
    assert isinstance(fails(bench.camera.trigger), error)
    relax()
    bench.camera.trigger()
    assert taken.ids == [2]
    assert np.ptp(taken.frames[0][0]) == 0


def test_sim_a_late_frame_is_not_taken_for_the_next(bench: OverTcp, monkeypatch):
    taken = Taken()
    bench.camera.arm(None, taken)
    bench.strike("camera.late@1")
    relax = hurry(bench.camera, monkeypatch)
    assert isinstance(fails(bench.camera.trigger), CameraTimeout)
    bench.clock.held.let_go.set()
    relax()
    bench.camera.trigger()
    assert taken.ids == [2]
    assert taken.frames[0][0].max() == 2


def test_sim_no_frame_comes_any_more(bench: OverTcp, monkeypatch):
    bench.camera.arm(None, Taken())
    bench.strike("camera.hang")
    relax = hurry(bench.camera, monkeypatch)
    for _ in range(3):
        assert isinstance(fails(bench.camera.trigger), CameraTimeout)
    bench.faults.switch_off("camera.hang")
    relax()
    bench.camera.trigger()


def test_sim_the_camera_is_gone_and_comes_again(bench: OverTcp):
    taken = Taken()
    bench.camera.arm(None, taken)
    bench.strike("camera.die")
    assert isinstance(fails(bench.camera.trigger), LinkLost)
    assert isinstance(fails(bench.camera.trigger), LinkLost)
    bench.camera.stop(1.0)
    bench.camera.close()
    bench.faults.switch_off("camera.die")
    bench.camera = bench.opened()
    bench.camera.arm(1, taken)
    bench.camera.trigger()
    assert taken.ids == [2]


def test_sim_frames_whose_file_was_shortened_are_not_looked_at(bench: OverTcp):
    bench.camera.arm(None, Taken())
    bench.camera.trigger()
    path = bench.server._frames.path
    os.truncate(path, 4096)
    with suppress(OSError):
        answer = {"slot": 0, "hw_id": 9, "exposure_start_ns": 1, "exposure_end_ns": 2}
        error = fails(lambda: bench.camera._hand_over(answer))
    assert isinstance(error, LinkLost)
    os.truncate(path, 4096 * 5)


def test_sim_a_sink_that_does_not_come_back_does_not_hold_the_stop():
    held = Held()

    class Pulsed:
        """A bench whose camera delivers a frame as soon as it is armed for pulses."""

        def __init__(self) -> None:
            self.queue: list[dict] = []

        def send(self, message: dict) -> None:
            if message["do"] != "taken":
                caps = {"name": "x", "height": 1, "width": 1, "bands": 1, "dtype": "uint8", "bit_depth": 8}
                frames = {"path": __file__, "slots": 1, "offset_bytes": 0, "stride_bytes": 1}
                times = {"slot": 0, "hw_id": 1, "exposure_start_ns": 1, "exposure_end_ns": 2, "first_hw_id": 1}
                said = {"id": message["id"], "ok": True, "caps": caps, "frames": frames, **times}
                self.queue += [said, said] if message["do"] == "arm" else [said]

        def receive(self, wait_s: float) -> dict | None:
            return self.queue.pop(0) if self.queue else None

        def close(self) -> None: ...

    with closing(sim_camera.SimCamera(Pulsed(), SystemClock())) as camera:
        camera.arm_external(1, held)
        assert held.begun.wait(PLENTY_S)
        assert isinstance(fails(lambda: camera.stop(SHORT_S)), CameraTimeout)
        held.let_go.set()
        camera.stop(PLENTY_S)


@pytest.mark.parametrize(
    "said",
    [
        b"\xff\xfe nonsense\n",
        b"[]\n",
        json.dumps({"ok": True, "slot": 77}).encode() + b"\n",
        b'{"ok": true, "slot": 0, "hw_id": 1e400}\n',
    ],
)
def test_sim_an_answer_that_makes_no_sense(bench: OverTcp, said: bytes):
    bench.camera.arm(None, Taken())
    bench.camera._wire._received = said
    assert isinstance(fails(bench.camera.trigger), DeviceError)
    taken = Taken()
    bench.camera.arm(None, taken)
    bench.camera.trigger()
    assert taken.ids[0] is not None


# -- a folder of images ----------------------------------------------------------------------------------------------

IMAGE = np.random.default_rng(3).integers(1, 4000, (12, 16), np.uint16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for number in range(3):
        tifffile.imwrite(tmp_path / "images" / f"z{number}.tif", IMAGE + number)
    return tmp_path / "images"


def shortened(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-200])


SPOILT_IMAGE: dict[str, Callable[[Path], object]] = {
    "the image is gone": lambda folder: (folder / "z1.tif").unlink(),
    "the folder is gone": shutil.rmtree,
    "the image is cut off": lambda folder: shortened(folder / "z1.tif"),
    "the image is empty": lambda folder: (folder / "z1.tif").write_bytes(b""),
    "the image is no image": lambda folder: (folder / "z1.tif").write_bytes(b"II*\0" + bytes(900)),
    "the image has another size": lambda folder: tifffile.imwrite(folder / "z1.tif", IMAGE[:8]),
    "the image has another depth": lambda folder: tifffile.imwrite(folder / "z1.tif", IMAGE.astype(np.uint8)),
    "the image has colours": lambda folder: tifffile.imwrite(folder / "z1.tif", np.dstack([IMAGE] * 3)),
}


@pytest.mark.parametrize("fault", SPOILT_IMAGE)
def test_folder_an_image_changes_after_the_camera_was_opened(folder: Path, fault: str):
    spec = CameraSpec(driver="folder", source=str(folder), step_um=1.0)
    place = {"z_um": 1.0}
    camera = folder_camera.open_camera(spec, DeviceContext(SystemClock(), None, lambda: place["z_um"]))
    taken = Taken()
    camera.arm(None, taken)
    SPOILT_IMAGE[fault](folder)
    fails(camera.trigger)
    assert taken.frames == []
    if folder.exists():
        place["z_um"] = 2.0
        camera.trigger()
        np.testing.assert_array_equal(taken.frames[0][0], IMAGE + 2)


def test_folder_the_stage_cannot_say_where_it_is(folder: Path):
    def lost() -> float:
        raise LinkLost("z stage: gone.")

    spec = CameraSpec(driver="folder", source=str(folder), step_um=1.0)
    camera = folder_camera.open_camera(spec, DeviceContext(SystemClock(), None, lost))
    camera.arm(None, Taken())
    assert isinstance(fails(camera.trigger), LinkLost)


# -- OpenCV ----------------------------------------------------------------------------------------------------------


class Usb:
    """Stands in for `cv2.VideoCapture` on a device: gives what it is given, in turn, and then hangs."""

    def __init__(self, source: object) -> None:
        self.frames: list[object] = [np.zeros((*SHAPE, 3), np.uint8)]
        self.held = Held()
        self.released = False

    def isOpened(self) -> bool:  # noqa: N802  OpenCV's name
        return True

    def read(self) -> tuple[bool, object]:
        if not self.frames:
            self.held()
            return False, None
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame is not None, frame

    def set(self, name: int, value: float) -> bool:
        return True

    def get(self, name: int) -> float:
        return 0.0

    def release(self) -> None:
        self.released = True


@pytest.fixture
def usb(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cv2, "VideoCapture", Usb)
    camera = opencv_camera.open_camera(CameraSpec(driver="opencv", source="0"), context())
    yield camera
    camera._capture.held.let_go.set()
    camera.close()
    assert camera._capture.released


WHOLE = np.ones((*SHAPE, 3), np.uint8)
SPOILT_CAPTURE = {
    "the camera is gone": (None, "device-lost"),
    "a frame does not decode": (cv2.error("bad frame"), "device-lost"),
    "another size": (WHOLE[:4], "camera-frame"),
    "another depth": (WHOLE.astype(np.uint16), "camera-frame"),
    "no colours": (WHOLE[:, :, 0], "camera-frame"),
}


@pytest.mark.parametrize("fault", SPOILT_CAPTURE)
def test_opencv_what_comes_is_no_frame(usb: opencv_camera.OpenCvCamera, fault: str):
    frame, code = SPOILT_CAPTURE[fault]
    usb._capture.frames = [WHOLE, frame, WHOLE]
    taken = Taken()
    usb.arm(None, taken)
    usb._thread.join(PLENTY_S)
    assert len(taken.frames) == 1, "nothing is delivered after it"
    assert fails(usb.trigger).code == code


def test_opencv_a_frame_that_never_comes_does_not_hold_the_stop(usb: opencv_camera.OpenCvCamera):
    usb.arm(None, Taken())
    assert usb._capture.held.begun.wait(PLENTY_S)
    assert isinstance(fails(lambda: usb.stop(SHORT_S)), CameraTimeout)
    usb._capture.held.let_go.set()
    usb.stop(PLENTY_S)


def test_opencv_a_camera_that_hangs_is_left_to_the_end_of_the_program(usb: opencv_camera.OpenCvCamera, monkeypatch):
    monkeypatch.setattr(opencv_camera, "CLOSE_S", SHORT_S)
    usb.arm(None, Taken())
    assert usb._capture.held.begun.wait(PLENTY_S)
    usb.close()
    assert not usb._capture.released


@pytest.mark.parametrize("fault", ["z1.tif is gone", "z1.tif is cut off"])
def test_opencv_numbered_images_end(folder: Path, fault: str):
    spec = CameraSpec(driver="opencv", source=str(folder / "z%d.tif"), exposure_ms=0.01)
    with closing(opencv_camera.open_camera(spec, context())) as camera:
        (folder / "z1.tif").unlink() if "gone" in fault else shortened(folder / "z1.tif")
        taken = Taken()
        camera.arm(None, taken)
        camera._thread.join(PLENTY_S)
        assert len(taken.frames) == 1
        assert isinstance(fails(camera.trigger), LinkLost)


# -- Micro-Manager ---------------------------------------------------------------------------------------------------


@pytest.fixture
def snapping():
    spec = CameraSpec(driver="micro-manager", source="DemoCamera", address="DCam", size_px=SHAPE[::-1])
    with closing(mm_camera.open_camera(spec, context())) as camera:
        yield camera


def broken(*_: object) -> None:
    raise RuntimeError("Error in device 'camera': camera not connected")


SPOILT_CORE: dict[str, tuple[dict[str, object], str]] = {
    "the camera is gone": ({"snapImage": broken}, "device-failed"),
    "the picture is lost": ({"getImage": broken}, "device-failed"),
    "another size": ({"getImage": lambda: np.zeros((3, 8), np.uint8)}, "camera-frame"),
    "another depth": ({"getImage": lambda: np.zeros(SHAPE, np.uint16)}, "camera-frame"),
    "colours": ({"getImage": lambda: np.zeros(SHAPE, np.uint32)}, "camera-frame"),
}


@pytest.mark.parametrize("fault", SPOILT_CORE)
def test_mm_what_a_snap_brings_is_no_frame(snapping: mm_camera.MicroManagerCamera, fault: str):
    replaced, code = SPOILT_CORE[fault]
    core, taken = snapping._core, Taken()
    snapping.arm(None, taken)
    snapping._core = Wrapped(core, **replaced)
    assert fails(snapping.trigger).code == code
    assert taken.frames == []
    snapping._core = core
    snapping.trigger()
    assert len(taken.frames) == 1


def test_mm_a_late_frame_is_not_taken_for_the_next(snapping: mm_camera.MicroManagerCamera, monkeypatch):
    core, taken, held, snapped = snapping._core, Taken(), Held(), []

    def late() -> None:
        held()
        core.snapImage()
        snapped.append(snapping._now_ns())

    snapping.arm(None, taken)
    relax = hurry(snapping, monkeypatch)
    snapping._core = Wrapped(core, snapImage=late)
    assert isinstance(fails(snapping.trigger), CameraTimeout)
    assert isinstance(fails(lambda: snapping.stop(SHORT_S)), CameraTimeout), "the stop is bounded"
    snapping._core = core
    held.let_go.set()
    relax()
    snapping.arm(None, taken)
    snapping.trigger()
    assert len(taken.frames) == 1
    assert taken.frames[0][1].exposure_start_ns > snapped[0]


SPOILT_SEQUENCE: dict[str, tuple[dict[str, object], str]] = {
    "the camera is gone": ({"popNextImageMD": broken}, "device-failed"),
    "it does not start": ({"startSequenceAcquisition": broken}, "device-failed"),
    "the buffer ran over": ({"isBufferOverflowed": lambda: True}, "device-failed"),
    "no frames come": ({"getRemainingImageCount": lambda: 0}, "camera-timeout"),
    "another size": ({"popNextImageMD": lambda said: np.zeros((3, 8), np.uint8)}, "camera-frame"),
    "another depth": ({"popNextImageMD": lambda said: np.zeros(SHAPE, np.uint16)}, "camera-frame"),
}


@pytest.mark.parametrize("fault", SPOILT_SEQUENCE)
def test_mm_a_sequence_goes_wrong(snapping: mm_camera.MicroManagerCamera, monkeypatch, fault: str):
    replaced, code = SPOILT_SEQUENCE[fault]
    relax = hurry(snapping, monkeypatch) if code == "camera-timeout" else lambda: None
    core, taken = snapping._core, Taken()
    snapping._core = Wrapped(core, **replaced)
    snapping.arm_free_run(None, taken)
    snapping._delivery.exception(PLENTY_S)
    assert fails(snapping.trigger).code == code
    assert taken.frames == []
    snapping._core = core
    relax()
    snapping.stop(PLENTY_S)
    snapping.arm_free_run(2, taken)
    taken.wait_for(2)


# -- GenICam ---------------------------------------------------------------------------------------------------------


class Acquirer(Wrapped):
    """The producer's own acquirer, whose next fetches go wrong."""

    def try_fetch(self, **timeout: float) -> object:
        return self.wrong(lambda: self._inner.try_fetch(**timeout))


@pytest.fixture
def streaming():
    spec = CameraSpec(driver="genicam", source="viky", size_px=SHAPE[::-1])
    with closing(genicam_camera.open_camera(spec, context())) as camera:
        camera.apply_settings({"AcquisitionFrameRate": 100.0})
        yield camera


def spoil(camera: genicam_camera.GenicamCamera, wrong: Callable[[Callable[[], object]], object]) -> Callable[[], None]:
    inner = camera._acquirer
    camera._acquirer = Acquirer(inner, wrong=wrong)
    return lambda: setattr(camera, "_acquirer", inner)


def with_image(**changed: object) -> Callable[[Callable[[], object]], object]:
    """Let a fetched frame say other things of itself."""

    def wrong(fetch: Callable[[], object]) -> object:
        buffer = fetch()
        if buffer is None:
            return None
        components = [] if changed.get("nothing") else [Wrapped(buffer.payload.components[0], **changed)]

        class Spoilt(Wrapped):
            def __enter__(self) -> object:
                self._inner.__enter__()
                return self

            def __exit__(self, *left: object) -> None:
                self._inner.__exit__(*left)

        return Spoilt(buffer, payload=Wrapped(buffer.payload, components=components))

    return wrong


def producer_fails(_: Callable[[], object]) -> object:
    from genicam.gentl import InvalidHandleException

    raise InvalidHandleException("the device was removed")


SPOILT_FETCH: dict[str, tuple[Callable[[Callable[[], object]], object], str]] = {
    "the camera is gone": (producer_fails, "device-failed"),
    "no frame comes": (lambda fetch: None, "camera-timeout"),
    "another size": (with_image(height=10, width=400, data=np.zeros(10 * 400 * 4, np.uint8)), "camera-frame"),
    "another depth": (with_image(data=np.zeros(400 * 400 * 4, np.uint16)), "camera-frame"),
    "another format": (with_image(data_format="BayerRG8"), "device-failed"),
    "half a frame": (with_image(data=np.zeros(4001, np.uint8)), "device-failed"),
    "no picture in it": (with_image(nothing=True), "device-failed"),
}


@pytest.mark.parametrize("fault", SPOILT_FETCH)
def test_genicam_what_comes_is_no_frame(streaming: genicam_camera.GenicamCamera, monkeypatch, fault: str):
    wrong, code = SPOILT_FETCH[fault]
    relax, taken = hurry(streaming, monkeypatch), Taken()
    relax() if code != "camera-timeout" else None
    mend = spoil(streaming, wrong)
    streaming.arm(None, taken)
    with suppress(StereotomeError):
        streaming._delivery.result(PLENTY_S)
    assert fails(streaming.trigger).code == code
    assert taken.frames == []
    mend()
    relax()
    streaming.arm(2, taken)
    taken.wait_for(2)


def test_genicam_frames_lost_and_incomplete_show_in_the_numbers(streaming: genicam_camera.GenicamCamera):
    fetched = 0

    def every_second(fetch: Callable[[], object]) -> object:
        nonlocal fetched
        buffer = fetch()
        if buffer is None:
            return None
        fetched += 1
        if fetched % 2:
            return buffer
        streaming._incomplete()  # as the producer tells of one with holes, which it keeps back
        buffer.queue()
        return None

    spoil(streaming, every_second)
    taken = Taken()
    streaming.arm(3, taken)
    taken.wait_for(3)
    streaming.stop(PLENTY_S)
    assert all(later - earlier >= 2 for earlier, later in zip(taken.ids, taken.ids[1:], strict=False))
    assert streaming.incomplete_frames >= 2


def test_genicam_a_producer_that_hangs_does_not_hold_the_stop(streaming: genicam_camera.GenicamCamera):
    held = Held()
    mend = spoil(streaming, lambda fetch: held())
    streaming.arm(None, Taken())
    assert held.begun.wait(PLENTY_S)
    assert isinstance(fails(lambda: streaming.stop(SHORT_S)), CameraTimeout)
    mend()
    held.let_go.set()
    streaming.stop(PLENTY_S)
    taken = Taken()
    streaming.arm(1, taken)
    taken.wait_for(1)


class TriggeredNodes:
    """Features of a camera with a software trigger, which counts the triggers."""

    def __init__(self) -> None:
        self.executed = 0
        for name in (*genicam_camera.SOFTWARE_TRIGGER, "AcquisitionFrameRate"):
            setattr(self, name, Wrapped(None, value="", get_access_mode=_readable))
        self.TriggerSoftware = Wrapped(None, execute=self._count, get_access_mode=_readable)

    def _count(self) -> None:
        self.executed += 1


def _readable() -> object:
    from genicam.genapi import EAccessMode

    return EAccessMode.RW


def test_genicam_a_late_frame_ends_the_delivery_and_is_not_the_next(streaming: genicam_camera.GenicamCamera):
    """A frame upon a trigger that comes too late would be that of the next: the delivery ends, to be armed anew."""
    nodes, taken, come = TriggeredNodes(), Taken(), threading.Event()
    streaming._nodes, streaming._triggered = nodes, True
    streaming._clock = Hasty(SimClock())
    mend = spoil(streaming, lambda fetch: fetch() if come.is_set() else None)
    streaming.arm(None, taken)
    streaming.trigger()
    with suppress(StereotomeError):
        streaming._delivery.result(PLENTY_S)
    assert isinstance(fails(streaming.trigger), CameraTimeout)
    come.set()
    assert taken.frames == []
    assert nodes.executed == 1
    streaming._clock = SystemClock()
    streaming.arm(None, taken)
    streaming.trigger()
    taken.wait_for(1)
    assert nodes.executed == 2
    mend()


class Hasty:
    """A clock that goes on each time it is looked at: waiting ends without anybody waiting."""

    def __init__(self, clock: SimClock) -> None:
        self._clock = clock

    def now(self) -> float:
        self._clock.sleep(0.5)
        return self._clock.now()

    def sleep(self, seconds: float) -> None:
        self._clock.sleep(seconds)
