"""Micro-Manager's camera, its own simulated one from `mm-test-adapters`: alone, and in a run."""

from __future__ import annotations

import threading
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np
import pytest
from wires import stereotome

from acquire.store import open_run
from devices.bands import BandSpec, BandSwitch, switch_band
from devices.clock import SystemClock
from devices.drivers import mm_camera
from devices.errors import DeviceError, LimitError, Refused, RigError
from devices.protocols import FreeRunningCamera
from devices.registry import DeviceContext
from devices.rig import CameraSpec, load_rig

if TYPE_CHECKING:
    from pathlib import Path

CONFIGURATION = """
Property,Core,Initialize,0
Device,Cam,DemoCamera,DCam
Device,Filter,DemoCamera,DWheel
Property,Core,Initialize,1
Property,Core,Camera,Cam
Label,Filter,0,Empty
Label,Filter,1,GFP
"""
RIG = """
schema = 1
name = "small"
[camera]
driver = "sim"
size_px = [96, 80]
pixel_um = 3.45
exposure_ms = 2.0
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "filled in by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
speed_um_s = 5000.0
"""
RECIPE = """
schema = 1
name = "t"
[output]
keep_free_gb = 0.001
[stack]
top_um = 10.0
bottom_um = -10.0
step = 2.0
"""


class Deaf:
    """A core that passes over one thing it is told."""

    def __init__(self, core, passed_over: str) -> None:
        self._core, self._passed_over = core, passed_over

    def __getattr__(self, name: str):
        return (lambda *_: None) if name == self._passed_over else getattr(self._core, name)


def opened(**table: object) -> mm_camera.MicroManagerCamera:
    spec = CameraSpec(driver="micro-manager", **({"source": "DemoCamera", "address": "DCam"} | table))
    return mm_camera.open_camera(spec, DeviceContext(SystemClock()))


@pytest.fixture
def camera():
    with closing(opened(size_px=(64, 48))) as camera:
        yield camera


@pytest.fixture
def whole(tmp_path: Path):
    (tmp_path / "scope.cfg").write_text(CONFIGURATION)
    with closing(opened(source=str(tmp_path / "scope.cfg"), address=None)) as camera:
        yield camera


def snapped(camera: mm_camera.MicroManagerCamera) -> np.ndarray:
    seen: list[np.ndarray] = []
    camera.arm(1, lambda pixels, stamp: seen.append(pixels))
    camera.trigger()
    return seen[0]


def test_it_says_what_it_can(camera: mm_camera.MicroManagerCamera):
    caps = camera.caps()
    assert caps.triggers == {"software", "free-run"}
    assert (caps.timed, caps.roi_in_camera) == (True, True)
    assert caps.bit_depths == (8, 10, 11, 12, 14, 16)
    assert isinstance(camera, FreeRunningCamera)
    assert isinstance(camera, BandSwitch)


def test_running_free_every_image_number_comes(camera: mm_camera.MicroManagerCamera):
    ids: list[int] = []
    full = threading.Event()

    def take(pixels: np.ndarray, stamp) -> None:
        ids.append(stamp.hw_id)
        if len(ids) == 20:
            full.set()

    camera.configure(exposure_ms=1.0)
    camera.arm_free_run(None, take)
    assert full.wait(10)
    camera.trigger()
    camera.stop(5.0)
    count = len(ids)
    assert ids == list(range(count))
    assert snapped(camera).shape == (48, 64)
    assert len(ids) == count


@pytest.mark.parametrize(
    ("kind", "shape", "dtype"),
    [("8bit", (512, 512), "uint8"), ("16bit", (512, 512), "uint16"), ("32bitRGB", (512, 512, 3), "uint8")],
)
def test_grey_and_colour(kind: str, shape: tuple, dtype: str):
    with closing(opened()) as camera:
        camera.apply_settings({"PixelType": kind})
        caps = camera.caps()
        assert (caps.shape, caps.dtype) == (shape, dtype)
        pixels = snapped(camera)
        assert (pixels.shape, str(pixels.dtype)) == (shape, dtype)


def test_colours_come_as_red_green_blue():
    bgra = np.array([[[1, 2, 3, 0]]], np.uint8).view(np.uint32)[:, :, 0]
    np.testing.assert_array_equal(mm_camera._grey_or_rgb(bgra), [[[3, 2, 1]]])


def test_pixels_of_no_use_are_refused(camera: mm_camera.MicroManagerCamera):
    with pytest.raises(RigError, match="are of no use here"):
        camera.apply_settings({"PixelType": "64bitRGB"})


def test_an_exposure_it_does_not_take(camera: mm_camera.MicroManagerCamera, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(camera, "_core", Deaf(camera._core, "setExposure"))
    with pytest.raises(LimitError, match="it takes 10 ms for an exposure of 30 ms"):
        camera.configure(exposure_ms=30.0)


def test_a_band_sets_camera_and_filter(whole: mm_camera.MicroManagerCamera):
    switch_band(whole, BandSpec(name="GFP", exposure_ms=4.0, settings={"Filter.Label": "GFP", "Gain": 2}), 10.0)
    core = whole._core
    assert (core.getProperty("Filter", "Label"), core.getProperty("Cam", "Gain"), core.getExposure()) == ("GFP", "2", 4)
    switch_band(whole, BandSpec(name="white", settings={"Filter.Label": "Empty"}), 10.0)
    assert (core.getProperty("Filter", "Label"), core.getExposure()) == ("Empty", 10)


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"Gain": 1, "Filtre.Label": "GFP"}, RigError, "no device 'Filtre'; did you mean 'Filter'?"),
        ({"Gain": 1, "Filter.Lable": "GFP"}, RigError, "no property 'Lable'; did you mean 'Label'?"),
        ({"Filter.Label": "none such"}, DeviceError, "failed in setting properties"),
        ({"PixelType": "nothing"}, DeviceError, "failed in setting properties"),
    ],
)
def test_a_setting_it_does_not_take(whole: mm_camera.MicroManagerCamera, settings: dict, error: type, words: str):
    gain = whole._core.getProperty("Cam", "Gain")
    with pytest.raises(error) as caught:
        whole.apply_settings(settings)
    assert words in caught.value.what
    assert whole._core.getProperty("Cam", "Gain") == gain


def test_a_value_that_reads_back_differently_is_refused(whole: mm_camera.MicroManagerCamera, monkeypatch):
    monkeypatch.setattr(whole, "_core", Deaf(whole._core, "setProperty"))
    with pytest.raises(Refused, match=r"Filter\.Label is Empty, not GFP"):
        whole.apply_settings({"Filter.Label": "GFP"})


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ({"source": "NoSuchAdapter"}, "device-missing"),
        ({"address": "NoSuchCamera"}, "device-missing"),
        ({"source": "nowhere.cfg"}, "config"),
        ({"source": None}, "config"),
        ({"size_px": (4000, 4000)}, "limit"),
        ({"address": "DStage"}, "device-missing"),
    ],
)
def test_what_does_not_open(table: dict, code: str):
    with pytest.raises((DeviceError, RigError)) as caught:
        opened(**table)
    assert caught.value.code == code


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch):
    def without(name: str, *rest: object, **named: object):
        raise ImportError(f"no {name}")

    monkeypatch.setattr("importlib.import_module", without)
    with pytest.raises(RigError, match="needs pymmcore_plus, which is not installed") as caught:
        opened()
    assert caught.value.fix == ("install it: pip install 'stereotome[mm]'",)


def test_a_stack_lands_on_disk(start_bench, tmp_path: Path):
    (tmp_path / "rig.toml").write_text(RIG)
    bench = start_bench(tmp_path / "rig.toml")
    rig = load_rig(bench.instrument)
    text = RIG.replace('driver = "sim"', 'driver = "micro-manager"\nsource = "DemoCamera"\naddress = "DCam"')
    (tmp_path / "mm.toml").write_text(text.replace("filled in by the bench", rig.stage.z.port))
    (tmp_path / "recipe.toml").write_text(RECIPE)
    done = stereotome("run", tmp_path / "recipe.toml", "-i", tmp_path / "mm.toml", "--out", tmp_path / "run")
    assert done.code == 0, done.err
    assert "11 of 11 planes are durable and verified" in done.err
    run = open_run(tmp_path / "run")
    headers = [run.planes[number].header for number in range(11)]
    assert [header.z_um for header in headers] == pytest.approx([-10.0 + 2 * k for k in range(11)], abs=0.2)
    assert all(0 < header.exposure_start_ns < header.exposure_end_ns <= header.arrival_ns for header in headers)
    assert run.read(0).shape == (80, 96)
