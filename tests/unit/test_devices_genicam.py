"""The simulated GenICam cameras that come with the package `genicam`: alone, and in a run."""

from __future__ import annotations

import threading
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquire.engine import Run, RunState
from acquire.plan import StackPlan
from devices.bands import BandSpec, BandSwitch, switch_band
from devices.clock import SystemClock
from devices.drivers import genicam_camera
from devices.errors import DeviceError, Refused, RigError
from devices.registry import DeviceContext
from devices.rig import CameraSpec
from devices.values import Limits
from sim.motion import Axis
from sim.stage import SimStage

if TYPE_CHECKING:
    from acquire.store import RunEnd
    from devices.values import FrameStamp

CAMERAS = ("VikyTL_DEV_red", "VikyTL_DEV_green", "VikyTL_DEV_blue")


def opened(**table: object) -> genicam_camera.GenicamCamera:
    spec = CameraSpec(driver="genicam", **({"source": "viky"} | table))
    return genicam_camera.open_camera(spec, DeviceContext(SystemClock()))


@pytest.fixture
def camera():
    with closing(opened(size_px=(160, 120))) as camera:
        camera.apply_settings({"AcquisitionFrameRate": 100.0})
        yield camera


def frames_of(camera: genicam_camera.GenicamCamera, count: int) -> list[tuple[np.ndarray, FrameStamp]]:
    frames: list[tuple[np.ndarray, FrameStamp]] = []
    full = threading.Event()

    def take(pixels: np.ndarray, stamp: FrameStamp) -> None:
        frames.append((pixels.copy(), stamp))
        if len(frames) == count:
            full.set()

    camera.arm(count, take)
    assert full.wait(10)
    camera.stop(5.0)
    return frames


@pytest.mark.parametrize("address", CAMERAS)
def test_frames_arrive_from_each_of_the_three(address: str):
    with closing(opened(address=address)) as camera:
        frames = frames_of(camera, 3)
        assert camera.caps().name == f"genicam {address}"
    assert [stamp.hw_id for _, stamp in frames] == [1, 2, 3]
    assert all(pixels.shape == (400, 400, 3) and pixels.any() for pixels, _ in frames)


def test_a_camera_goes_by_its_serial_number_too():
    with closing(opened(address="1")) as camera:
        assert camera.caps().name == "genicam VikyTL_DEV_green"


def test_without_features_for_exposure_and_trigger_it_runs_free_and_untimed(camera: genicam_camera.GenicamCamera):
    camera.configure(exposure_ms=3.0)
    caps = camera.caps()
    assert (caps.triggers, caps.timed, caps.numbered) == ({"free-run"}, False, True)
    assert caps.readout_ms == 10.0, "no frame takes longer than the time between two"
    assert [stamp.exposure_start_ns for _, stamp in frames_of(camera, 2)] == [None, None]


def test_grey_is_a_feature_of_a_band(camera: genicam_camera.GenicamCamera):
    assert isinstance(camera, BandSwitch)
    camera.apply_settings({"PixelFormat": "Mono8"})
    assert camera.caps().shape == (120, 160), "the part of the frame is kept"
    assert frames_of(camera, 1)[0][0].shape == (120, 160)
    with pytest.raises(RigError, match=r"band 'colour': frames of \(120, 160, 3\)"):
        switch_band(camera, BandSpec(name="colour", settings={"PixelFormat": "RGBa8"}), 5.0)


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"AcquisitionFrameRat": 5.0}, RigError, "no feature 'AcquisitionFrameRat'; did you mean"),
        ({"TriggerMode": "On"}, RigError, "no feature 'TriggerMode'"),
        ({"AcquisitionFrameRate": 1e6}, Refused, "AcquisitionFrameRate does not take 1000000.0; it is 100.0"),
        ({"PixelFormat": "Mono7"}, Refused, "PixelFormat does not take 'Mono7'; it is 'RGBa8'"),
        ({"Width": "wide"}, Refused, "Width does not take 'wide'; it is 400"),
    ],
)
def test_a_setting_it_does_not_take(camera: genicam_camera.GenicamCamera, settings: dict, error: type, words: str):
    with pytest.raises(error) as caught:
        camera.apply_settings(settings)
    assert words in caught.value.what


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ({"source": None}, "config"),
        ({"source": "none.cti"}, "config"),
        ({"source": __file__}, "device-missing"),
        ({"address": "VikyTL_DEV_pink"}, "device-missing"),
        ({"size_px": (4000, 4000)}, "limit"),
    ],
)
def test_what_does_not_open(table: dict, code: str):
    with pytest.raises((DeviceError, RigError)) as caught:
        opened(**table)
    assert caught.value.code == code


def test_a_camera_in_use_is_said_to_be(camera: genicam_camera.GenicamCamera):
    with pytest.raises(DeviceError):
        opened()


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch):
    def without(name: str):
        raise ImportError(f"no {name}")

    monkeypatch.setattr("importlib.import_module", without)
    with pytest.raises(RigError, match="needs genicam, which is not installed") as caught:
        opened()
    assert caught.value.fix == ("install it: pip install 'stereotome[genicam]'",)


class Memory:
    """Keeps what a run puts out."""

    def __init__(self) -> None:
        self.headers, self.gaps = [], []

    @property
    def durable(self) -> int:
        return len(self.headers)

    def check(self) -> None: ...

    def put(self, pixels: np.ndarray, header) -> None:
        self.headers.append((header, pixels.shape))

    def missed(self, missed) -> None:
        self.gaps.append(missed)

    def finish(self, end: RunEnd, reason: str = "") -> RunEnd:
        return end


def test_a_stack_keeps_only_frames_begun_after_the_stage_stood(camera: genicam_camera.GenicamCamera):
    clock = SystemClock()
    axis = Axis(clock, Limits(-50.0, 50.0))
    out = Memory()
    plan = StackPlan(start_nm=-3000, step_nm=1000, count=6, exposure_ms=2.0, overshoot_nm=500, return_nm=0)
    run = Run(plan, SimStage(axis), camera, out, clock)
    assert run.execute() is RunState.COMPLETED
    headers = [header for header, _ in out.headers]
    assert [header.plane for header in headers] == list(range(6))
    ids = [header.hw_id for header in headers]
    assert ids == sorted(set(ids))
    for header in headers:
        start_s = header.arrival_ns / 1e9 - 0.002 - camera.caps().readout_ms / 1000
        path_um = axis.path_um(start_s, header.arrival_ns / 1e9)
        assert np.ptp(path_um) == 0, "the stage moved while this frame may have been exposed"
