"""The simulated bench as its own process: started as a user starts it, asked over its real wires."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.drivers.asi import open_stage
from devices.errors import DeviceError, InputError, RigError
from devices.registry import DeviceContext
from devices.rig import load_rig
from devices.values import CameraCaps, Limits
from sim.bench import build_bench
from sim.camera import Replay
from sim.camera_server import CameraServer, FrameFile
from sim.clock import SimClock
from sim.faults import Faults
from sim.motion import Axis
from sim.serve import DEFAULT_INSTRUMENT, serve

PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve"]
SMALL = """\
schema = 1
name = "a \\"small\\" bench"
camera = {{ driver = "sim", size_px = [96, 64], bit_depth = {bit_depth}, pixel_um = 3.45, exposure_ms = 5.0 }}
optics = {{ magnification = 20.0, na = 0.45 }}
[stage.z]
driver = "asi-ms2000"
port = "none yet"
baud = 115200
limits = {{ min_um = -100.0, max_um = 100.0 }}
settle_ms = 5
backlash_um = 0.5
[sim]
specimen = "{specimen}"
"""


def small(tmp_path: Path, *, bit_depth: int = 12, specimen: str = "relief") -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL.format(bit_depth=bit_depth, specimen=specimen), encoding="utf-8")
    return path


@contextlib.contextmanager
def serving(*arguments: object):
    """Run a bench; gives the process and what it told on its first line."""
    process = subprocess.Popen([*PROGRAM, *map(str, arguments)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.terminate()
        process.communicate()


class Camera:
    """A client of the camera's wire, written from its description alone."""

    def __init__(self, address: str) -> None:
        host, _, port = address.partition(":")
        self.socket = socket.create_connection((host, int(port)), timeout=10)
        self.lines = self.socket.makefile("rb")
        self.asked = 0

    def send(self, **words: object) -> None:
        self.socket.sendall(json.dumps(words).encode() + b"\n")

    def ask(self, do: str, **words: object) -> dict:
        self.asked += 1
        self.send(id=self.asked, do=do, **words)
        answer = self.hear()
        assert answer.pop("id") == self.asked
        return answer

    def hear(self) -> dict:
        return json.loads(self.lines.readline())

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


@contextlib.contextmanager
def camera_of(told: dict):
    with contextlib.closing(Camera(told["camera"])) as camera:
        yield camera


def pixels(camera: Camera) -> tuple[dict, np.ndarray]:
    """Trigger and return the answer and a copy of the frame."""
    told = camera.ask("caps")
    caps, frames = told["caps"], told["frames"]
    answer = camera.ask("trigger")
    shape, offset = (caps["height"], caps["width"]), frames["offset_bytes"] + answer["slot"] * frames["stride_bytes"]
    with Path(frames["path"]).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as memory:
        return answer, np.frombuffer(memory[offset:], caps["dtype"], shape[0] * shape[1]).reshape(shape)


def frame_files(pid: int) -> list[Path]:
    return list(Path("/dev/shm").glob(f"stereotome-bench-{pid}-*"))


def ask(port: serial.SerialBase, command: bytes) -> bytes:
    port.write(command + b"\r")
    return port.read_until(b"\r\n")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    with serving(small(folder), "--dir", folder) as (process, told):
        yield process, told


def test_it_writes_an_instrument_file_that_connects_to_itself(bench):
    process, told = bench
    spec = load_rig(Path(told["instrument"]))
    assert (spec.name, spec.camera.driver, spec.stage.z.driver) == ('a "small" bench', "sim", "asi-ms2000")
    assert (spec.camera.address, spec.stage.z.port) == (told["camera"], told["stage_pty"])
    assert (spec.camera.size_px, spec.stage.z.limits.max_um, told["pid"]) == ((96, 64), 100.0, process.pid)
    with np.load(told["truth"]) as truth:
        assert truth["height_um"].shape == (64, 96)
        assert float(truth["pixel_um"]) == pytest.approx(3.45 / 20)


def test_both_wires_drive_the_one_axis(bench):
    _, told = bench
    with (
        serial.Serial(told["stage_pty"], 115200, timeout=5, exclusive=True) as pty,
        serial.serial_for_url(told["stage_tcp"], timeout=5) as tcp,
    ):
        assert ask(pty, b"M Z=-130") == b":A \r\n"
        while ask(tcp, b"/") == b"B\r\n":
            pass
        assert ask(tcp, b"W Z") == ask(pty, b"W Z") == b":A -130 \r\n"
        ask(pty, b"M Z=0")


def test_camera_tells_its_frames_and_exposes_as_long_as_asked(bench):
    _, told = bench
    with camera_of(told) as camera:
        caps = camera.ask("caps")
        assert caps["caps"] | {"name": ""} == {
            "name": "", "height": 64, "width": 96, "bands": 1, "dtype": "uint16", "bit_depth": 12,
        }  # fmt: skip
        assert caps["frames"]["slots"] == 4
        assert caps["frames"]["stride_bytes"] % 4096 == 0
        assert camera.ask("configure", exposure_ms=7.5) == {"ok": True}
        first, _ = pixels(camera)
        second, frame = pixels(camera)
        assert first["exposure_end_ns"] - first["exposure_start_ns"] == pytest.approx(7.5e6, abs=2000)
        assert second["exposure_start_ns"] >= first["exposure_end_ns"]
        assert second["hw_id"] == first["hw_id"] + 1
        assert second["slot"] == (first["slot"] + 1) % 4
        assert 100 < frame.mean() < 4000
        assert frame.std() > 10


def test_camera_proves_what_moved_during_an_exposure(bench):
    _, told = bench
    with camera_of(told) as camera, serial.serial_for_url(told["stage_tcp"], timeout=5) as stage:
        camera.ask("configure", exposure_ms=30.0)
        while ask(stage, b"/") == b"B\r\n":
            pass
        ask(stage, b"M Z=400")
        moving = camera.ask("trigger")
        while ask(stage, b"/") == b"B\r\n":
            pass
        camera.ask("trigger")  # lets it ring out
        still = camera.ask("trigger")
        went = camera.ask("truth", start_ns=moving["exposure_start_ns"], end_ns=moving["exposure_end_ns"])
        stood = camera.ask("truth", start_ns=still["exposure_start_ns"], end_ns=still["exposure_end_ns"])
        assert went["z_max_um"] - went["z_min_um"] > 1.0
        assert stood == {"ok": True, "z_min_um": 40.0, "z_max_um": 40.0}
        ask(stage, b"M Z=0")


def test_no_frame_of_a_settled_stage_was_exposed_while_moving(bench):
    """The driver's arrival, the engine's one-sided approach and the bench's truth agree over the real wires."""
    _, told = bench
    table = load_rig(Path(told["instrument"])).stage.z
    with camera_of(told) as camera, contextlib.closing(open_stage(table, DeviceContext(SystemClock()))) as stage:
        stage.move_to(-12.0)
        stage.settle(5.0)
        for z_um in np.arange(-10.0, 10.0, 4.0):
            stage.move_to(z_um)
            read_um = stage.settle(5.0)
            frame = camera.ask("trigger")
            truth = camera.ask("truth", start_ns=frame["exposure_start_ns"], end_ns=frame["exposure_end_ns"])
            assert truth["z_max_um"] == truth["z_min_um"] == pytest.approx(z_um)
            assert read_um == pytest.approx(z_um, abs=0.05)
        stage.move_to(0.0)  # from above: the load trails by the lost motion, which no encoder tells
        assert stage.settle(5.0) == pytest.approx(0.0, abs=0.05)
        frame = camera.ask("trigger")
        truth = camera.ask("truth", start_ns=frame["exposure_start_ns"], end_ns=frame["exposure_end_ns"])
        assert truth["z_min_um"] == pytest.approx(table.backlash_um)


def test_second_client_hears_busy_and_the_next_is_served(bench):
    _, told = bench
    with camera_of(told) as first:
        first.ask("caps")
        with camera_of(told) as second:
            assert second.hear() == {"ok": False, "error": "busy"}
            assert second.lines.read() == b""
        assert first.ask("caps")["ok"]


@pytest.mark.parametrize("line", [b"nonsense", b"[]", b"{}", b'{"id":1,"do":"dance"}', b'"caps"', b"\xff\xfe", b"17"])
def test_what_the_camera_does_not_understand_it_says(bench, line):
    _, told = bench
    with camera_of(told) as camera:
        camera.socket.sendall(line + b"\n")
        assert camera.hear()["error"].startswith("not understood")
        assert camera.ask("caps")["ok"]


values = st.none() | st.integers() | st.floats() | st.text(max_size=5) | st.lists(st.integers(), max_size=2)
keys = st.sampled_from(["do", "id", "exposure_ms", "start_ns", "end_ns"])
actions = st.sampled_from(["caps", "configure", "trigger", "truth"])
questions = st.builds(lambda do, asked: {**asked, "do": do}, actions | values, st.dictionaries(keys, values))


@given(st.lists(questions.map(json.dumps).map(str.encode) | st.binary(max_size=20), max_size=5))
def test_any_line_gets_an_answer_and_does_no_harm(lines):
    axis = Axis(SimClock(), Limits(-1.0, 1.0))
    maker = Replay(np.zeros((1, 4, 4), np.uint8), CameraCaps("replay", 4, 4, 1, "uint8", 8, timed=True))
    with contextlib.closing(CameraServer(maker, axis, Faults((), axis.clock), exposure_ms=1.0)) as camera:
        for line in lines:
            assert camera.answer(line)["ok"] in (True, False)
        assert camera.answer(b'{"id": 5, "do": "trigger"}')["id"] == 5


@pytest.mark.parametrize("exposure_ms", [0, -1, 1e9, float("nan")])
def test_an_impossible_exposure_is_refused_with_words(bench, exposure_ms):
    _, told = bench
    with camera_of(told) as camera:
        answer = camera.ask("configure", exposure_ms=exposure_ms)
        assert not answer["ok"]
        assert "exposure" in answer["error"]


@pytest.mark.parametrize(("end", "code"), [(signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGINT, 0)])
def test_a_signal_ends_it_and_nothing_stays(tmp_path, end, code):
    with serving(small(tmp_path)) as (process, told), camera_of(told) as camera:
        camera.ask("trigger")
        assert len(frame_files(process.pid)) == 1
        process.send_signal(end)
        assert process.wait(timeout=100) == code
    assert not frame_files(process.pid)
    assert not Path(told["instrument"]).parent.exists()  # a folder it made itself goes with it
    with pytest.raises(OSError, match=r"refused|reset"):
        Camera(told["camera"])


def test_it_ends_with_the_standard_input_of_its_starter(tmp_path):
    with serving(small(tmp_path), "--follow-stdin", "--dir", tmp_path) as (process, told):
        process.communicate(timeout=20)  # closes its standard input
        assert process.returncode == 0
    assert not frame_files(process.pid)
    assert Path(told["truth"]).exists()


HOLD = "import sys; from sim.camera_server import FrameFile; f = FrameFile((4, 4), 'uint8'); print(f.path, flush=True)"


def test_what_a_killed_bench_left_is_removed_by_the_next_and_a_living_ones_is_not():
    process = subprocess.Popen(
        [sys.executable, "-c", f"{HOLD}; sys.stdin.read()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    left = Path(process.stdout.readline().strip())
    with contextlib.closing(FrameFile((4, 4), "uint8")):
        assert left.exists()
    process.kill()
    process.communicate()
    with contextlib.closing(FrameFile((4, 4), "uint8")) as own:
        assert not left.exists()
        assert own.path.exists()
    assert not own.path.exists()


def test_the_same_seed_shows_the_same_specimen_at_any_depth_of_bits(tmp_path):
    frames = {}
    for bit_depth, dtype in ((8, np.uint8), (12, np.uint16)):
        bench = build_bench(load_rig(small(tmp_path, bit_depth=bit_depth)), SimClock())
        frames[bit_depth] = np.empty((64, 96), dtype)
        bench.sensor.expose(np.zeros(1), 5.0, frames[bit_depth])
    assert np.abs(frames[8] / 255 - frames[12] / 4095).max() < 1 / 250


def test_depth_and_faults_and_tcp_are_options(tmp_path):
    rig, faults = small(tmp_path, specimen="depth"), ["--fault", "camera.drop@2", "--fault", "z.stall@3um"]
    with serving(rig, "--dir", tmp_path, "--tcp", *faults) as (_, told):
        assert load_rig(Path(told["instrument"])).stage.z.port == told["stage_tcp"]
        with np.load(told["truth"]) as truth:
            assert str(truth["kind"]) == "depth"
        with camera_of(told) as camera:
            camera.ask("trigger")
            camera.send(id="lost", do="trigger")
            assert camera.ask("trigger")["hw_id"] == 3
        with serial.serial_for_url(told["stage_tcp"], timeout=5) as stage:
            ask(stage, b"M Z=50")
            while ask(stage, b"W Z") != b":A 30 \r\n":
                pass
            assert ask(stage, b"/") == b"B\r\n"
            assert ask(stage, b"\\") == b":N-21\r\n"


def test_no_room_for_frames_is_said_before_any_is_taken():
    with pytest.raises(DeviceError, match=r"no room for \d+ MB of frames"):
        FrameFile((60_000, 60_000, 1000), "uint16")
    assert not frame_files(os.getpid())


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"folder": Path("/dev/null")}, InputError, "--dir /dev/null: File exists"),
        ({"fault": ("z.lat",)}, RigError, "no fault 'z.lat'; did you mean 'z.late'"),
        ({"instrument": Path("no-such.toml")}, RigError, "no-such.toml: no such file"),
    ],
)
def test_what_it_cannot_start_with_it_says(tmp_path, settings, error, words):
    with pytest.raises(error, match=re.escape(words)):
        serve(**{"instrument": small(tmp_path), **settings})


def test_the_shipped_instrument_is_valid():
    assert load_rig(DEFAULT_INSTRUMENT).camera.size_px == (512, 512)


def test_what_an_instrument_leaves_open_is_as_on_the_default_bench(tmp_path):
    path = tmp_path / "sparse.toml"
    sparse = (
        SMALL.format(bit_depth=8, specimen="relief").replace("size_px = [96, 64],", "").replace("pixel_um = 3.45,", "")
    )
    path.write_text(sparse.replace("min_um = -100.0", "min_um = 90.0"), encoding="utf-8")
    bench = build_bench(load_rig(path), SimClock())
    assert bench.sensor.caps().shape == (512, 512)
    assert bench.specimen.pixel_um == pytest.approx(3.45 / 20)
    assert bench.axis.encoder_um() == 95.0  # no room around 0: all moves to the middle of the limits
    assert bench.specimen.range_um == pytest.approx((91.0, 99.0), abs=1e-3)
