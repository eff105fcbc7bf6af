"""The real console on the real simulated bench, driven as by hand: each test in a process of its own."""

import signal
from pathlib import Path

from screens import needs_screen

from acquire.client import Instrument
from acquire.store import RunEnd, open_run

pytestmark = needs_screen
PATIENCE_S = 120.0


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
