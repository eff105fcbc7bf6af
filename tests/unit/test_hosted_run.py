"""A run in the instrument process: from the moment it is begun until it is over nobody is told that all is idle."""

import threading
from pathlib import Path

from acquire.hosted_run import HostedRun
from acquire.session import Outcome
from acquire.state import Phase, RunState, RunStatus
from devices.clock import SystemClock


class WaitsForItsObservers:
    """A session that has begun and takes nothing yet."""

    folder, ring_path, plan = Path("run"), Path("ring"), range(3)

    def __init__(self):
        self.go, self.state = threading.Event(), RunState.IDLE

    @property
    def status(self):
        return RunStatus(self.state, Phase.WAITING, 0, 3, 0, 0, (), 0, 1, None, None)

    def execute(self):
        assert self.go.wait(100)
        self.state = RunState.COMPLETED
        return Outcome(self.state, None, self.folder, 3, 3, ())


def test_a_run_that_waits_for_its_observers_is_not_idle():
    over = threading.Event()
    run, session = HostedRun(None, SystemClock(), lambda _: None, over.set), WaitsForItsObservers()
    started = run._begin("t", session)
    assert (run.active, run.view().number, run.view().state) == (True, started.number, "ARMING")
    session.go.set()
    assert over.wait(100)
    assert (run.active, run.view().state) == (False, "COMPLETED")
