"""What every camera must do, asked of every implementation there is."""

from __future__ import annotations

import threading
from contextlib import closing
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile
from small_twin import OnTcp, SmallBench

from devices.clock import SystemClock
from devices.drivers import folder_camera, genicam_camera, mm_camera, opencv_camera, sim_camera
from devices.errors import LimitError
from devices.protocols import Camera
from devices.registry import DeviceContext
from devices.rig import CameraSpec
from devices.values import CameraCaps, FrameStamp, Limits, Roi
from sim.camera import Replay, SimCamera
from sim.motion import Axis

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = (6, 8)


def context() -> DeviceContext:
    return DeviceContext(SystemClock(), None, lambda: 2.1)


def images(folder: Path) -> Path:
    for number in range(12):
        tifffile.imwrite(folder / f"z{number:02d}.tif", np.full(SHAPE, number * 300 + 1, np.uint16))
    return folder


def of_a_bench(folder: Path):
    with closing(OnTcp(SmallBench(folder, SHAPE).feed)) as far:
        yield sim_camera.open_camera(CameraSpec(driver="sim", address=far.address), context())


def of_a_folder(folder: Path):
    yield folder_camera.open_camera(CameraSpec(driver="folder", source=str(images(folder)), step_um=1.0), context())


def of_numbered_images(folder: Path):
    source = str(images(folder) / "z%02d.tif")
    yield opencv_camera.open_camera(CameraSpec(driver="opencv", source=source, exposure_ms=1.0), context())


def by_itself(folder: Path):
    clock = SystemClock()
    caps = CameraCaps("plain", *SHAPE, bands=1, dtype="uint16", bit_depth=12, timed=True, numbered=True)
    frames = np.arange(1, 4, dtype=np.uint16)[:, None, None] * np.ones(SHAPE, np.uint16)
    yield SimCamera(Replay(frames, caps), Axis(clock, Limits(-200.0, 200.0)), exposure_ms=1.0)


def of_micro_manager(folder: Path):
    table = CameraSpec(driver="micro-manager", source="DemoCamera", address="DCam", size_px=SHAPE[::-1])
    yield mm_camera.open_camera(table, context())


def of_genicam(folder: Path):
    yield genicam_camera.open_camera(CameraSpec(driver="genicam", source="viky", size_px=SHAPE[::-1]), context())


PAINTED = [by_itself, of_a_bench, of_a_folder, of_numbered_images]
SIMULATED_BY_OTHERS = [of_micro_manager, of_genicam]


@pytest.fixture(params=[*PAINTED, *SIMULATED_BY_OTHERS], ids=lambda make: make.__name__)
def camera(request: pytest.FixtureRequest, tmp_path: Path):
    opened = request.param(tmp_path)
    device = next(opened)
    device.painted = request.param in PAINTED
    yield device
    device.close()
    assert list(opened) == []


class Taken:
    """A sink that keeps copies and can be waited for."""

    def __init__(self) -> None:
        self.frames: list[tuple[np.ndarray, FrameStamp]] = []
        self.writeable: list[bool] = []
        self.grown = threading.Condition()

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        with self.grown:
            self.writeable.append(pixels.flags.writeable)
            self.frames.append((pixels.copy(), stamp))
            self.grown.notify_all()

    def wait_for(self, count: int) -> None:
        with self.grown:
            assert self.grown.wait_for(lambda: len(self.frames) >= count, 10)


def test_it_is_a_camera_whose_frames_are_as_it_says(camera: Camera):
    assert isinstance(camera, Camera)
    taken = Taken()
    camera.configure(exposure_ms=2.0)
    camera.arm(3, taken)
    for _ in range(3):
        camera.trigger()
    taken.wait_for(3)
    caps = camera.caps()
    assert caps.shape[:2] == SHAPE
    assert caps.triggers
    assert all(pixels.shape == caps.shape and str(pixels.dtype) == caps.dtype for pixels, _ in taken.frames)
    if camera.painted:
        assert all(pixels.min() == pixels.max() > 0 for pixels, _ in taken.frames), "a torn frame"


def test_frames_are_counted_if_it_says_so(camera: Camera):
    taken = Taken()
    camera.arm(3, taken)
    for number in range(3):
        camera.trigger()
        if "software" in camera.caps().triggers:
            taken.wait_for(number + 1)
    taken.wait_for(3)
    ids = [stamp.hw_id for _, stamp in taken.frames]
    if camera.caps().numbered:
        assert [number - ids[0] for number in ids] == [0, 1, 2]
    else:
        assert ids == [None] * 3


def test_a_part_of_the_frame_is_delivered_as_such(camera: Camera):
    camera.configure(exposure_ms=2.0, roi=Roi(1, 2, 5, 3))
    assert camera.caps().shape[:2] == (3, 5)
    taken = Taken()
    camera.arm(1, taken)
    camera.trigger()
    taken.wait_for(1)
    assert taken.frames[0][0].shape == camera.caps().shape
    assert camera.caps().frame_bytes == taken.frames[0][0].nbytes


@pytest.mark.parametrize("roi", [Roi(-1, 0, 4, 4), Roi(0, 0, 10**6, 2), Roi(0, 0, 0, 2), Roi(2, 10**6, 2, 2)])
def test_a_part_outside_the_frame_is_refused_and_changes_nothing(camera: Camera, roi: Roi):
    with pytest.raises(LimitError, match="is no part of a frame"):
        camera.configure(exposure_ms=2.0, roi=roi)
    assert camera.caps().shape[:2] == SHAPE
    taken = Taken()
    camera.arm(1, taken)
    camera.trigger()
    taken.wait_for(1)
    assert taken.frames[0][0].shape[:2] == SHAPE


def test_its_times_are_in_order(camera: Camera):
    taken = Taken()
    before_ns = int(SystemClock().now() * 1e9)
    camera.arm(None, taken)
    for _ in range(2):
        camera.trigger()
    taken.wait_for(2)
    camera.stop(5.0)
    arrivals = [stamp.arrival_ns for _, stamp in taken.frames]
    assert before_ns <= arrivals[0] <= arrivals[1] <= int(SystemClock().now() * 1e9)
    for _, stamp in taken.frames:
        assert (stamp.exposure_start_ns is not None) == camera.caps().timed
        if stamp.exposure_start_ns is not None:
            assert stamp.exposure_start_ns <= stamp.exposure_end_ns <= stamp.arrival_ns


def test_after_a_stop_nothing_is_delivered(camera: Camera):
    taken = Taken()
    camera.arm(None, taken)
    camera.trigger()
    taken.wait_for(1)
    camera.stop(5.0)
    count = len(taken.frames)
    again = Taken()
    camera.arm(1, again)
    camera.trigger()
    again.wait_for(1)
    camera.stop(5.0)
    assert len(taken.frames) == count


def test_no_more_frames_than_asked_for(camera: Camera):
    taken = Taken()
    camera.arm(1, taken)
    camera.trigger()
    taken.wait_for(1)
    camera.stop(5.0)
    assert len(taken.frames) == 1


@pytest.mark.parametrize("exposure_ms", [0.0, -1.0, float("nan")])
def test_an_exposure_that_is_none_is_refused(camera: Camera, exposure_ms: float):
    with pytest.raises(LimitError):
        camera.configure(exposure_ms=exposure_ms)


def test_stopping_and_closing_twice_is_fine(camera: Camera):
    camera.stop(1.0)
    camera.stop(1.0)
    camera.close()


def test_opencv_gives_16_bit_images_intact_and_in_rgb(tmp_path: Path):
    colours = np.arange(6 * 8 * 3, dtype=np.uint16).reshape(6, 8, 3) * 400
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"c{number}.tif"), np.ascontiguousarray(colours[:, :, ::-1]))
    spec = CameraSpec(driver="opencv", source=str(tmp_path / "c%d.tif"), exposure_ms=1.0)
    with closing(opencv_camera.open_camera(spec, context())) as camera:
        taken = Taken()
        camera.arm(1, taken)
        taken.wait_for(1)
    np.testing.assert_array_equal(taken.frames[0][0], colours)
