"""The real console on the real simulated bench, driven as by hand: each test in a process of its own."""

import signal
from pathlib import Path

from screens import needs_screen

from acquire.client import Instrument
from acquire.store import RunEnd, open_run

pytestmark = needs_screen
PATIENCE_S = 120.0


def test_an_operator_takes_a_stack(drive):
    code, said = drive("first_run")
    assert code == 0, said


def test_a_console_crashes_and_the_run_goes_on(drive, server):
    code, said = drive("crashes")
    assert code == -signal.SIGKILL, said
    with Instrument.connect(server.connection) as looker:
        assert looker.state.run.state in {"RUNNING", "COMPLETED"}
    code, said = drive("picks_up", scale=2.0)
    assert code == 0, said
    with Instrument.connect(server.connection) as looker:
        run = looker.wait_for_run(PATIENCE_S)
    stored = open_run(Path(run.folder))
    assert (stored.state, stored.missing) == (RunEnd.COMPLETED, [])
