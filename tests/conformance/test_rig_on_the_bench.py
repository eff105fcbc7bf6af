"""A whole instrument, opened from the file that the simulated bench writes, over its real wires."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from devices.clock import SystemClock
from devices.drivers import polled
from devices.errors import DeviceBusy, DeviceError, LimitError, LinkLost
from devices.registry import DeviceContext, factory
from devices.rig import load_rig, open_rig

SMALL = """schema = 1
name = "small"
camera = { driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 2.0 }
optics = { magnification = 20.0, na = 0.45 }
[stage.z]
driver = "asi-ms2000"
port = "written by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
speed_um_s = 5000.0
"""
PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve", "--follow-stdin"]


@contextmanager
def served(folder: Path, *options: str):
    (folder / "small.toml").write_text(SMALL)
    command = [*PROGRAM, str(folder / "small.toml"), "--dir", str(folder), *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        yield process, Path(json.loads(process.stdout.readline())["instrument"])
        process.communicate()


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory):
    with served(tmp_path_factory.mktemp("bench")) as (_, path):
        yield path


def test_planes_are_taken_and_the_conversation_recorded(instrument: Path, tmp_path: Path):
    seen = []
    with open_rig(load_rig(instrument), clock=SystemClock(), transcript=tmp_path) as rig:
        rig.camera.configure(exposure_ms=2.0)
        rig.camera.arm(3, lambda pixels, stamp: seen.append((pixels.copy(), stamp)))
        for z_um in (-5.0, 0.0, 5.0):
            rig.stage.move_to(z_um)
            assert rig.stage.settle(5.0) == pytest.approx(z_um, abs=0.1)
            settled_ns = int(SystemClock().now() * 1e9)
            rig.camera.trigger()
            assert seen[-1][1].exposure_start_ns >= settled_ns
    assert [pixels.shape for pixels, _ in seen] == [(48, 64)] * 3
    ids = [stamp.hw_id for _, stamp in seen]
    assert [later - earlier for earlier, later in pairwise(ids)] == [1, 1]
    assert (seen[0][0] != seen[2][0]).any()
    assert "M Z=50.000" in (tmp_path / "stage-z.jsonl").read_text()


def test_what_is_taken_is_said_to_be(instrument: Path):
    spec = load_rig(instrument)
    with open_rig(spec, clock=SystemClock()):
        with pytest.raises(DeviceBusy, match="in use by another program"), open_rig(spec, clock=SystemClock()):
            pytest.fail("two programs drive one stage")
        with pytest.raises(DeviceBusy, match="another program uses the camera"):
            factory("sim", "camera")(spec.camera, DeviceContext(SystemClock()))


def test_a_wrong_baud_rate_is_seen_in_what_comes_back(instrument: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(polled, "REPLY_TIMEOUT_S", 0.1)
    spec = load_rig(instrument, ["stage.z.baud=9600"])
    with pytest.raises(DeviceError, match="no valid answer") as caught, open_rig(spec, clock=SystemClock()):
        pytest.fail("it opened")
    assert caught.value.code == "device-garbled"
    assert "opened at 9600 baud but unreadable data came back" in caught.value.why


def test_an_exposure_the_bench_refuses(instrument: Path):
    with open_rig(load_rig(instrument), clock=SystemClock()) as rig, pytest.raises(LimitError, match="1e\\+06 ms"):
        rig.camera.configure(exposure_ms=1e6)


def test_a_bench_that_dies(tmp_path: Path):
    with served(tmp_path) as (process, path), open_rig(load_rig(path), clock=SystemClock()) as rig:
        rig.stage.move_to(50.0)
        process.kill()
        process.wait()
        with pytest.raises(LinkLost):
            rig.stage.settle(5.0)
        rig.camera.arm(1, lambda pixels, stamp: None)
        with pytest.raises(LinkLost):
            rig.camera.trigger()
