"""The real console on the real simulated bench, driven as by hand: each test in a process of its own."""

import os
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from screens import needs_screen, virtual_screen
from served import short_folder
from wires import PROGRAM

from acquire.client import Instrument
from acquire.store import RunEnd, open_run
from devices.rig import load_rig

pytestmark = needs_screen
PATIENCE_S = 120.0


def test_the_first_start_finds_the_devices_and_writes_an_instrument_file(drive, bench, tmp_path):
    (tmp_path / "bench.toml").write_bytes(bench.instrument.read_bytes())
    with short_folder() as runtime:
        code, said = drive("first_start", SimpleNamespace(connection="later", runtime=runtime))
    assert code == 0, said
    written = load_rig(tmp_path / "my-bench.toml")
    assert (written.stage.z.driver, written.stage.z.baud) == ("asi-ms2000", 115200)
    assert "\nbit_depth = 12\n" in (tmp_path / "my-bench.toml").read_text()


@pytest.mark.parametrize(
    ("without", "code", "words"), [("screen", "no-display", "DISPLAY"), ("GLX", "no-opengl", "3.3")]
)
def test_a_console_without_screen_or_opengl_says_so_in_words(server, without, code, words):
    with virtual_screen("64x64", *([] if without == "screen" else ["-extension", "GLX"])) as environment:
        display = ":4095" if without == "screen" else environment["DISPLAY"]
        ended = subprocess.run(
            [*PROGRAM, "console", "--server", str(server.connection)],
            env={**environment, "DISPLAY": display},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
    assert ended.returncode == 10
    assert f"error[{code}]" in ended.stderr
    assert words in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_wrong_instrument_file_is_named_before_a_missing_screen(tmp_path):
    (tmp_path / "wrong.toml").write_text("schema = 1\nnane = 'x'\n")
    environment = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    command = [*PROGRAM, "console", "-i", str(tmp_path / "wrong.toml")]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 3
    assert "wrong.toml:2" in ended.stderr


def test_an_operator_takes_stacks_and_a_console_that_crashes_leaves_the_run_going(drive, server):
    code, said = drive("first_run", server)
    assert code == -signal.SIGKILL, said  # it got to its end, which is a crash
    with Instrument.connect(server.connection) as script:
        taken = script.state.run.taken
        script.command("script", wait_s=PATIENCE_S)  # the dead console's lease runs out
        script.pause()
        run = script.wait_for(lambda state: state.state == "PAUSED", PATIENCE_S).run
        assert taken < run.taken < run.planned
    code, said = drive("picks_up", server, scale=2.0)
    assert code == 0, said
    with Instrument.connect(server.connection) as looker:
        run = looker.wait_for_run(PATIENCE_S)
    stored = open_run(Path(run.folder))
    assert (stored.state, stored.missing) == (RunEnd.COMPLETED, [])


def test_sections_by_hand_and_in_a_run_that_asks_and_their_review(drive, knife_server, tmp_path):
    code, said = drive("sections", knife_server)
    assert code == 0, said
    stored, held, cut_short = (open_run(folder) for folder in sorted(tmp_path.glob("run-*")))
    assert (stored.state, stored.missing, stored.layout.sections) == (RunEnd.COMPLETED, [], 3)
    assert held.state == cut_short.state == RunEnd.CANCELLED
    asked = [record for record in stored.records if record["e"] == "hold"]
    assert len(asked) == 1
