"""``devices list``, ``config check`` and ``doctor``; the instrument opened and closed in order."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from devices import commands, config_commands, doctor, registry, rig
from devices.clock import SystemClock
from devices.errors import DeviceError, RigError
from devices.toml_model import load_text
from devices.transport import ports

RIG = """schema = 1
name = "bench"
[camera]
driver = "folder"
source = "images"
step_um = 1.0
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "/dev/ttyUSB0"
limits = { min_um = -200.0, max_um = 200.0 }
"""
PORT = ports.Port("/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI-port0", "FT232R")


def stereotome(*arguments: str) -> subprocess.CompletedProcess:
    program = Path(sys.executable).with_name("stereotome")
    return subprocess.run([program, *arguments], capture_output=True, text=True, timeout=60)


def test_the_drivers_of_this_program_are_listed():
    listed = json.loads(stereotome("devices", "list", "--json").stdout)
    assert listed["drivers"]["stage"] == ["asi-ms2000", "asi-tiger", "pi-gcs2", "prior-proscan"]
    assert set(listed["drivers"]["camera"]) >= {"folder", "opencv", "sim"}
    assert listed["drivers"]["feed"] == ["modbus"]
    assert set(listed["drivers"]) == {"stage", "camera", "feed", "glasses"}


def test_ports_are_listed_by_the_name_that_survives_a_reboot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(commands, "ports_present", lambda: [PORT])
    commands.list_devices()
    assert "  /dev/serial/by-id/usb-FTDI-port0  (/dev/ttyUSB0, FT232R)\n" in capsys.readouterr().out


def test_a_phantom_port_is_hidden(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    class Found:
        def __init__(self, device: str, description: str) -> None:
            self.device, self.description = device, description

        def __lt__(self, other: Found) -> bool:
            return self.device < other.device

    (tmp_path / "usb-FTDI-port0").symlink_to("/dev/ttyUSB0")
    monkeypatch.setattr(ports, "BY_ID", tmp_path)
    found = [Found("/dev/ttyS0", "n/a"), Found("/dev/ttyUSB1", "b"), Found("/dev/ttyUSB0", "a")]
    monkeypatch.setattr(ports, "comports", lambda: found)
    assert [port.name for port in ports.ports_present()] == [str(tmp_path / "usb-FTDI-port0"), "/dev/ttyUSB1"]


def test_a_wrong_instrument_file_through_the_real_command(tmp_path: Path):
    file = tmp_path / "bad.toml"
    file.write_text(RIG.replace("port =", "prot =").replace("na = 0.45", "na = nan"))
    done = stereotome("config", "check", str(file))
    assert done.returncode == 3
    assert done.stderr == (
        f"error[config]: {file} has 3 problems:\n"
        f"    {file}:9: optics.na: must be a finite number\n"
        f"    {file}:10: stage.z.port: missing\n"
        f"    {file}:12: stage.z.prot: unknown key; did you mean 'port'?\n"
    )


def test_a_file_is_checked_as_what_its_tables_say(tmp_path: Path, capsys: pytest.CaptureFixture):
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "recipe.toml").write_text("[stack]\ntop_um = 1.0\nbottom_um = 0.0\nstep = 0.5\n")
    (tmp_path / "broken.toml").write_text("name = \n")
    assert config_commands.check_config([tmp_path / "rig.toml", tmp_path / "recipe.toml"]) == 0
    said = capsys.readouterr().out
    assert "rig.toml: a good instrument file." in said
    assert "recipe.toml: a good recipe file." in said
    assert config_commands.check_config([tmp_path / "broken.toml", tmp_path / "rig.toml"]) == 3
    assert "broken.toml:1: no valid TOML" in capsys.readouterr().err


def test_the_doctor_sees_this_machine():
    done = stereotome("doctor", "--json")
    report = json.loads(done.stdout)
    assert report["ok"] == (done.returncode == 0)
    found = {one["name"]: one for one in report["findings"]}
    assert found["python"]["ok"]
    assert found["packages"]["ok"]
    assert all(one["ok"] or one["fix"] for one in report["findings"])


def test_the_doctor_s_advice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    assert not doctor.python_version((3, 10, 1)).ok
    assert "missing: no-such-package" in doctor.packages(["numpy", "no-such-package"]).found
    assert doctor.graphics({"libnothing.so.9": "libnothing9"}).fix == "sudo apt install libnothing9"
    assert doctor.display({}, "linux").fix.startswith("start from a desktop")
    assert doctor.display({"DISPLAY": ":0"}, "linux").found == ":0"
    assert doctor.display({}, "win32").ok
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 1e8}))
    assert not doctor.disk(tmp_path).ok
    assert "remount" in doctor.shared_memory(tmp_path).fix


@pytest.mark.parametrize(("members", "fix"), [([], "sudo usermod -aG uucp mk"), (["mk"], "log out and in again")])
def test_the_doctor_on_permissions(monkeypatch: pytest.MonkeyPatch, members: list[str], fix: str):
    monkeypatch.setattr(doctor, "ports_present", lambda: [PORT])
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    monkeypatch.setattr(doctor.getpass, "getuser", lambda: "mk")
    monkeypatch.setattr(doctor, "port_group", lambda port: "uucp")
    monkeypatch.setattr(doctor, "group_members", lambda group: members)
    (finding,) = doctor.serial_permissions()
    assert finding.fix.startswith(fix)
    assert not finding.essential
    assert doctor.serial_ports().found == "/dev/serial/by-id/usb-FTDI-port0"


def test_an_essential_failure_is_exit_code_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    broken = doctor.Finding("python", ok=False, found="3.9", fix="newer", essential=True)
    monkeypatch.setattr(doctor, "examine", lambda: iter([broken]))
    assert doctor.doctor() == 1
    assert capsys.readouterr().out == "FAIL  python: 3.9\n      fix: newer\n"


EVENTS: list[str] = []


class Device:
    def __init__(self, name: str) -> None:
        self.name = name
        EVENTS.append(f"open {name}")

    def position_um(self) -> float:
        return 4.5

    def close(self) -> None:
        EVENTS.append(f"close {self.name}")


def open_stage(table: rig.AxisSpec, context: registry.DeviceContext) -> Device:
    return Device(table.port)


def open_camera(table: rig.CameraSpec, context: registry.DeviceContext) -> Device:
    if table.source == "broken":
        raise DeviceError("camera: broken.")
    return Device(f"camera at {context.stage_position_um()}")


@pytest.fixture
def drivers_of_ours(monkeypatch: pytest.MonkeyPatch):
    EVENTS.clear()
    functions = {"asi-ms2000": open_stage, "folder": open_camera}
    points = [EntryPoint(name, f"{__name__}:{made.__name__}", registry.GROUP) for name, made in functions.items()]
    monkeypatch.setattr(registry, "installed", lambda group: points)


def spec(source: str = "images") -> rig.RigSpec:
    return load_text(RIG.replace("images", source), "rig.toml", rig.RigSpec, RigError)


def test_a_rig_is_opened_in_order_and_closed_in_reverse(drivers_of_ours: None):
    with rig.open_rig(spec(), clock=SystemClock()) as opened:
        assert opened.spec.name == "bench"
        assert opened.stage.position_um() == 4.5
    assert EVENTS == ["open /dev/ttyUSB0", "open camera at 4.5", "close camera at 4.5", "close /dev/ttyUSB0"]


def test_what_was_opened_is_closed_when_the_next_fails(drivers_of_ours: None):
    with pytest.raises(DeviceError, match="broken"), rig.open_rig(spec("broken"), clock=SystemClock()):
        pytest.fail("the rig opened")
    assert EVENTS == ["open /dev/ttyUSB0", "close /dev/ttyUSB0"]


def test_a_driver_that_is_gone_since_the_file_was_read(drivers_of_ours: None):
    with pytest.raises(RigError, match=r"no camera driver 'foldr'; did you mean 'folder'\?"):
        registry.factory("foldr", "camera")
