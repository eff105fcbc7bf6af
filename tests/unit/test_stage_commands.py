"""``stereotome stage …`` and ``devices list`` at a bench of twins, as a user starts them."""

from __future__ import annotations

import json
import os
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from wires import PROGRAM, stereotome

from devices import commands
from devices.clock import SystemClock
from devices.errors import Refused, StageStalled
from devices.halt_now import HALTS
from devices.holders import holders_of
from devices.registry import DeviceContext, drivers, factory
from devices.rig import load_rig
from devices.transport.ports import Port

RIG = """schema = 1
name = "small"
camera = {{ driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 2.0 }}
optics = {{ magnification = 20.0, na = 0.45 }}
[stage.z]
driver = "{driver}"
port = "written by the bench"
baud = 115200
units_per_um = {units_per_um}
limits = {{ min_um = -100.0, max_um = 100.0 }}
{more}
"""
MAKERS = [("asi-ms2000", 10.0), ("asi-tiger", 10.0), ("pi-gcs2", 1.0), ("prior-proscan", 10.0)]


@pytest.fixture
def bench_of(sim_bench, tmp_path: Path):
    def start(driver: str = "asi-ms2000", units_per_um: float = 10.0, more: str = "", **options):
        path = tmp_path / "rig.toml"
        path.write_text(RIG.format(driver=driver, units_per_um=units_per_um, more=more))
        return sim_bench(path, **options)

    return start


def stage(bench, *arguments: object):
    return stereotome("stage", *arguments, "-i", bench.instrument)


def test_a_stage_is_moved_by_hand_inside_its_limits(bench_of):
    bench = bench_of(more="park_um = -80.0")
    assert stage(bench, "show").out == "z +0.000 µm  (limits -100 … 100 µm)\n"
    assert json.loads(stage(bench, "move", "12.5", "--json").out)["z_um"] == pytest.approx(12.5)
    assert stage(bench, "jog", "-2.5").out.startswith("z +10.000 µm")
    assert bench.ask(do="truth")["z_um"] == pytest.approx(10.0)
    beyond = stage(bench, "jog", "95")
    assert beyond.code == 5
    assert "outside the soft limits" in beyond.err
    assert stage(bench, "move", "nan").code == 5
    assert bench.ask(do="truth")["z_um"] == pytest.approx(10.0)
    assert stage(bench, "park").out.startswith("z -80.000 µm")
    assert stage(bench, "zero").out.startswith("z +0.000 µm")
    assert stage(bench, "move", "10").out.startswith("z +10.000 µm")
    assert stage(bench, "home").out.startswith("z +0.000 µm")
    assert bench.ask(do="truth")["z_um"] == pytest.approx(-80.0)


@pytest.mark.parametrize(("driver", "units_per_um"), MAKERS)
def test_a_stop_goes_past_the_program_that_holds_the_port(bench_of, driver: str, units_per_um: float):
    bench = bench_of(driver, units_per_um, more="speed_um_s = 10.0" if driver != "prior-proscan" else "")
    bench.ask(do="fault", set="z.stall@5um")  # the axis is driven against it until it is stopped
    table = load_rig(bench.instrument).stage.z
    with closing(factory(driver, "stage")(table, DeviceContext(SystemClock()))) as held:
        held.move_to(90.0)
        while not bench.ask(do="truth")["moving"]:
            pass
        done = stage(bench, "stop")
        assert (done.code, done.err) == (0, "")
        assert "past the program that holds it" in done.out
        while bench.ask(do="truth")["moving"]:
            pass
        with pytest.raises((StageStalled, Refused)):  # refused, when the answer to the stop is still on its way
            held.settle(20.0)
    assert bench.ask(do="truth")["z_um"] < 6.0
    assert stage(bench, "stop").out == f"halt sent to {table.port}\n"


def test_a_stop_over_a_network_port_that_is_taken_says_that_it_cannot(bench_of):
    bench = bench_of(tcp=True)
    assert stage(bench, "stop").code == 0
    bench.ask(do="unplug", device="z")
    gone = stage(bench, "stop")
    assert gone.code == 4
    assert "cannot be opened" in gone.err


def test_every_stage_driver_has_a_halt():
    assert set(HALTS) == set(drivers("stage"))


def test_what_a_stage_cannot_do_is_said(bench_of):
    bench = bench_of("pi-gcs2", 1.0)
    assert "cannot set a zero" in stage(bench, "zero").err
    nowhere = stage(bench, "park")
    assert (nowhere.code, "names no safe place" in nowhere.err) == (3, True)
    held = factory("pi-gcs2", "stage")(load_rig(bench.instrument).stage.z, DeviceContext(SystemClock()))
    with closing(held):
        assert stage(bench, "show").code == 8


def test_a_motor_without_reference_searches_it_only_with_consent(bench_of):
    bench = bench_of("pi-gcs2", 0.001)
    for command in (["show"], ["home"], ["move", "5"]):
        refused = stage(bench, *command)
        assert refused.code == 4
        assert "error[position-unknown]" in refused.err
        assert "stage home --may-move" in refused.err
    assert bench.ask(do="truth")["z_um"] == 0.0
    assert stage(bench, "home", "--may-move").out.startswith("z +0.000 µm")
    assert stage(bench, "move", "5").out.startswith("z +5.000 µm")


def test_ctrl_c_stops_a_move_by_hand(bench_of):
    bench = bench_of(more="speed_um_s = 5.0")
    command = [*PROGRAM, "stage", "move", "90", "-i", str(bench.instrument)]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        while not bench.ask(do="truth")["moving"]:
            pass
        process.send_signal(2)
        process.communicate()
    assert process.returncode == 130
    while bench.ask(do="truth")["moving"]:
        pass
    assert 0 <= bench.ask(do="truth")["z_um"] < 50


def test_who_holds_a_port_is_found_in_the_system_s_list_of_processes(tmp_path: Path):
    link = tmp_path / "link"
    with (tmp_path / "device").open("w") as held:
        link.symlink_to(held.name)
        (holder,) = holders_of(str(link))
        assert holder.pid == os.getpid()
        assert str(holder).endswith(f"(process {os.getpid()})")
    assert holders_of(str(link)) == []
    assert holders_of(str(link), processes=tmp_path) == []
    (tmp_path / "17").mkdir()
    assert holders_of(str(link), processes=tmp_path) == [], "a process that just ended"


def test_the_list_tells_who_holds_a_port_and_what_keeps_one_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    device = tmp_path / "ttyUSB0"
    device.touch()
    monkeypatch.setattr(commands, "ports_present", lambda: [Port(str(device), None, "FT232R")])
    monkeypatch.setattr(commands.os, "access", lambda path, mode: False)
    monkeypatch.setattr(commands, "port_group", lambda path: "uucp")
    monkeypatch.setattr(commands.getpass, "getuser", lambda: "mk")
    with device.open():
        commands.list_devices()
    said = capsys.readouterr().out
    assert f"in use by {Path('/proc/self/comm').read_text().strip()} (process {os.getpid()})" in said
    assert "no permission: sudo usermod -aG uucp mk" in said
    monkeypatch.setattr(commands, "group_members", lambda group: ["mk"])
    commands.list_devices(json=True)
    (port,) = json.loads(capsys.readouterr().out)["ports"]
    assert port["held_by"] == []
    assert "from the next login on" in port["hint"]
