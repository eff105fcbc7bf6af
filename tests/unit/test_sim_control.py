"""The bench from outside: faults, plugs, power, pulses, over the control socket and over the real wires."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.errors import DeviceError, LinkLost, StageStalled
from devices.registry import DeviceContext, factory
from devices.rig import load_rig
from devices.values import Limits
from sim.bench_folder import LOCK, bench_folder
from sim.clock import SimClock
from sim.control import Control
from sim.faults import Delayed, Faults, HungUp
from sim.motion import Axis
from sim.rack import Device, PowerSwitch
from sim.serial_line import SerialLine
from sim.stages import AsiTwin

SMALL = """schema = 1
name = "small"
camera = { driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 2.0 }
optics = { magnification = 20.0, na = 0.45 }
[stage.z]
driver = "asi-ms2000"
port = "written by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def open_stage(bench):
    table = load_rig(bench.instrument).stage.z
    return contextlib.closing(factory(table.driver, "stage")(table, DeviceContext(SystemClock())))


class Plug:
    """A line without wires."""

    pty_path, tcp_url, port = None, "socket://nowhere", "nowhere"

    def __init__(self) -> None:
        self.plugged = True

    def plug(self) -> None:
        self.plugged = True

    def unplug(self) -> None:
        self.plugged = False


@contextlib.contextmanager
def on_simulated_time():
    axis = Axis(SimClock(), Limits(-100.0, 100.0))
    twin, line = AsiTwin(axis), Plug()
    power = PowerSwitch(twin)
    device = Device("z", "nowhere", line, power, twin.ttl_in, lambda: {"pulses": 3})
    with contextlib.closing(Control({"z": device}, axis, Faults((), axis.clock))) as control:
        yield control, axis, power, line


def ask(control: Control, **words: object) -> dict:
    return control.answer(json.dumps(words).encode())


def test_plug_power_pulses_and_truth_without_wires():
    with on_simulated_time() as (control, axis, power, line):
        assert ask(control, do="unplug", device="z", id=7) == {"ok": True, "id": 7}
        assert not line.plugged
        ask(control, do="replug", device="z")
        assert line.plugged
        power.feed(b"M Z=100\r")
        axis.clock.sleep(1.0)
        truth = ask(control, do="truth")
        assert (truth["z_um"], truth["moving"], truth["counters"]) == (10.0, False, {"z": {"pulses": 3}})
        ask(control, do="power", device="z", on=False)
        assert power.feed(b"W Z\r") == []
        ask(control, do="power", device="z", on=True)
        assert power.feed(b"W Z\r") == [b":A 0 \r\n"], "at power-up it counts from where it stands"
        assert axis.encoder_um() == 10.0
        power.feed(b"S Z=0.5\r")
        ask(control, do="power-cycle", device="z")
        assert power.feed(b"S Z?\r") != [b":A Z=0.500000\r\n"]


def test_a_power_cut_in_the_middle_of_a_move_stops_the_axis():
    with on_simulated_time() as (control, axis, power, _):
        power.feed(b"M Z=900\r")
        axis.clock.sleep(0.02)
        ask(control, do="power-cycle", device="z")
        axis.clock.sleep(5.0)
        assert 0 < axis.encoder_um() < 90


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"do": "unplug", "device": "zz"}, "no device 'zz'; did you mean 'z'"),
        ({"do": "unplug"}, "not understood"),
        ({"do": "dance"}, "not understood"),
        ({"do": "fault", "set": "z.slient"}, "did you mean 'z.silent'"),
        ({"do": "fault", "clear": "z.silent"}, "is not on"),
        ({"do": "fault"}, "not understood"),
        ({"do": "ttl", "device": "z", "count": 0}, "ask for 1 to"),
    ],
)
def test_what_cannot_be_done_is_said(words, said):
    with on_simulated_time() as (control, _, _, _):
        answer = ask(control, **words)
        assert not answer["ok"]
        assert said in answer["error"]


@given(st.binary(max_size=30) | st.sampled_from([b"[]", b"17", b'{"do":[]}', b'{"do":"ttl","device":"z","count":"x"}']))
def test_any_line_gets_an_answer(line):
    with on_simulated_time() as (control, _, _, _):
        assert not control.answer(line)["ok"]


def test_faults_come_and_go_while_a_driver_is_at_work(lend_bench, small):
    bench = lend_bench(small)
    with open_stage(bench) as stage:
        bench.ask(do="fault", set="z.silent")
        assert bench.ask(do="faults")["faults"] == ["z.silent"]
        with pytest.raises(DeviceError) as caught:
            stage.position_um()
        assert caught.value.code == "device-silent"
        bench.ask(do="fault", clear="z.silent")
        stage.reconnect()
        assert stage.position_um() == 0.0
        bench.ask(do="fault", set="z.stall@5um")
        stage.move_to(20.0)
        with pytest.raises(StageStalled):
            stage.settle(10.0)
        assert bench.ask(do="truth")["z_um"] == pytest.approx(5.0)
        bench.ask(do="fault", clear="z.stall")
        stage.move_to(20.0)
        assert stage.settle(10.0) == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("tcp", [False, True])
def test_a_port_that_is_pulled_and_put_back_has_the_same_name(lend_bench, small, tcp):
    bench = lend_bench(small, tcp=tcp)
    with open_stage(bench) as stage:
        stage.move_to(12.0)
        stage.settle(5.0)
        bench.ask(do="unplug", device="z")
        with pytest.raises(LinkLost):
            stage.position_um()
    with pytest.raises(DeviceError) as caught, open_stage(bench):
        pytest.fail("it opened")
    assert caught.value.code == "device-missing"
    bench.ask(do="replug", device="z")
    bench.ask(do="replug", device="z")  # it is in already
    with open_stage(bench) as stage:
        assert stage.position_um() == pytest.approx(12.0, abs=0.1), "the power was on all the time"


def test_a_device_that_hangs_up_takes_the_next_connection():
    answers = iter([[Delayed(b"1")], HungUp(), [Delayed(b"2")]])

    def feed(data):
        answer = next(answers)
        if isinstance(answer, HungUp):
            raise answer
        return answer

    with contextlib.closing(SerialLine(feed, 115200, SystemClock())) as line:
        with serial.serial_for_url(line.tcp_url, timeout=5) as first:
            first.write(b"x")
            assert first.read(1) == b"1"
            first.write(b"x")
            with pytest.raises(serial.SerialException):
                first.read(1)
        with serial.serial_for_url(line.tcp_url, timeout=5) as second:
            second.write(b"x")
            assert second.read(1) == b"2"


def test_pulses_reach_the_ttl_input(lend_bench, small):
    bench = lend_bench(small)
    with serial.Serial(bench.told["stage_pty"], 115200, timeout=5) as port:
        for command in (b"RM X=0", b"LD Z=30", b"LD Z=60", b"RM Y=4 Z=0", b"TTL X=1"):
            port.write(command + b"\r")
            assert port.read_until(b"\n").startswith(b":A")
        bench.ask(do="ttl", device="z")
        while bench.ask(do="truth")["moving"]:
            pass
        assert bench.ask(do="truth")["z_um"] == pytest.approx(3.0)


def test_a_script_is_told_in_an_exception_what_the_bench_refuses(lend_bench, sim_bench, small):
    with pytest.raises(RuntimeError, match="no device 'knife'"):
        lend_bench(small).ask(do="unplug", device="knife")
    with pytest.raises(RuntimeError, match="did not start"):
        sim_bench("no-such-file.toml")


def test_a_reset_bench_is_as_it_was_at_its_start(lend_bench, small):
    bench = lend_bench(small)
    with open_stage(bench) as stage:
        stage.move_to(12.0)
        stage.settle(5.0)
        stage.zero_here()
        stage.set_speed_um_s(50.0)
        bench.ask(do="fault", set="z.stall@15um")
        stage.move_to(20.0)
        bench.ask(do="unplug", device="z")
    bench.ask(do="power", device="z", on=False)
    bench.ask(do="reset")
    assert bench.ask(do="faults")["faults"] == []
    assert bench.ask(do="truth")["z_um"] == 0.0
    with open_stage(bench) as stage:
        assert stage.position_um() == 0.0
        stage.move_to(20.0)
        assert stage.settle(5.0) == pytest.approx(20.0, abs=0.1)


def left_by(folder: Path, pid: int) -> list[Path]:
    return [*folder.glob("stereotome-bench-*"), *Path("/dev/shm").glob(f"stereotome-bench-{pid}-*")]


def test_after_kill_9_nothing_stays_but_files_and_the_next_bench_sweeps_them(tmp_path, small):
    program = [sys.executable, "-c", "from devices.cli import main; main()", "sim", "serve", str(small)]
    scratch = tmp_path / "scratch"
    scratch.mkdir()

    def start():
        process = subprocess.Popen(
            program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "TMPDIR": str(scratch)}
        )
        return process, json.loads(process.stdout.readline())

    killed, told = start()
    link = Path(told["stage_pty"])
    assert link.is_symlink()
    assert len(left_by(scratch, killed.pid)) == 2
    terminal = link.resolve()
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert not terminal.exists()
    living, _ = start()
    assert left_by(scratch, killed.pid) == [folder for folder in left_by(scratch, living.pid) if folder.is_dir()]
    assert not link.parent.exists()
    last, _ = start()
    assert len(list(scratch.glob("stereotome-bench-*"))) == 2, "a living bench keeps its folder"
    for process in (living, last):
        process.terminate()
        process.communicate()
        assert left_by(scratch, process.pid) == [] or process is living
    assert list(scratch.iterdir()) == []


def test_a_folder_somebody_put_something_into_is_not_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with bench_folder(None) as folder:
        (folder / "z.port").symlink_to("/dev/null")
        (folder / "mine.txt").write_text("mine")
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]
    with bench_folder(tmp_path / "given") as given:
        assert (given / LOCK).exists()
    assert list((tmp_path / "given").iterdir()) == []
