"""``stereotome glasses …`` against an emitter behind a pseudo-terminal, and against lines in this process."""

import json
from pathlib import Path

import pytest

from devices.cli import run
from devices.clock import SystemClock
from sim.simlines import Circuit, plug


@pytest.fixture
def lines():
    circuit = Circuit(SystemClock())
    return circuit, f'driver = "modem-lines"\nport = "{plug("commands", circuit)}"'


def test_show_one_eye(rig, emitter):
    twin, table = emitter
    assert run(["glasses", "show", "left", "-i", rig(table), "--seconds", "0.1"]) == 0
    assert twin.edges()
    assert {edge.eye for edge in twin.edges()} == {"left"}


def test_show_both(rig, lines):
    circuit, table = lines
    assert run(["glasses", "show", "both", "-i", rig(table), "--seconds", "0.1"]) == 0
    assert {edge.eye for edge in circuit.edges()} == {"left", "right"}
    assert not circuit.powered


def test_swap_lasts_until_power_off_or_is_saved(rig, emitter, capsys):
    twin, table = emitter
    assert run(["glasses", "swap", "-i", rig(table)]) == 0
    assert "exchanged until the power goes" in capsys.readouterr().out
    assert (twin.flipped, twin.saves) == (True, 0)
    assert run(["glasses", "swap", "-i", rig(table), "--save"]) == 0
    assert (twin.flipped, twin.saves) == (False, 1)


def test_mode_is_left_in_the_emitter(rig, emitter, capsys):
    twin, table = emitter
    assert run(["glasses", "mode", "free-run", "-i", rig(table)]) == 0
    assert "given by: free-run until" in capsys.readouterr().out
    assert twin.feed(b"0\n")[0].endswith(b",6\r\nOK\r\n")


def test_what_the_file_says_is_not_changed_behind_its_back(rig, emitter, lines, capsys):
    for table in (lines[1], f"{emitter[1]}\nswap = true"):
        assert run(["glasses", "swap", "-i", rig(table)]) == 2
        assert "write there under [glasses]: swap = true" in capsys.readouterr().err


def test_measuring_the_link_and_the_turns(rig, emitter, lines, capsys):
    assert run(["glasses", "test", "-i", rig(emitter[1]), "--seconds", "0.3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["round_trip_max_ms"] >= found["round_trip_p50_ms"] > 0
    assert found["turns_max_ms"] >= found["turns_p99_ms"] >= 0
    assert run(["glasses", "test", "-i", rig(lines[1]), "--seconds", "0.3"]) == 0
    words = capsys.readouterr().out
    assert "toggles  200" in words
    assert "turns_p99_ms" in words


def test_a_loop_without_its_wire_is_said(rig, lines, capsys):
    circuit, table = lines
    circuit.faults = {"unwired"}
    circuit.clear_to_send = lambda: False
    assert run(["glasses", "test", "-i", rig(f"{table}\nmax_hold_ms = 1000.0"), "--seconds", "0.2"]) == 0
    assert "wire RTS to CTS" in capsys.readouterr().out


def test_an_instrument_without_glasses(rig, tmp_path, capsys):
    path = tmp_path / "none.toml"
    path.write_text(Path(rig("")).read_text().partition("[glasses]")[0])
    assert run(["glasses", "show", "left", "-i", str(path)]) == 3
    assert "has no glasses" in capsys.readouterr().err
