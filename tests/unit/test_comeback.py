"""A stage that was lost, silent or without power, at a real instrument process: it comes back where it was, or not."""

import os
import signal
from contextlib import closing

import pytest
from served import PATIENCE_S, RECIPE, SMALL_BENCH, served

from acquire.comeback import Comeback
from devices.errors import DeviceError
from sim.pytest_plugin import SimBench

AWAY_S = 5.0  # three questions without an answer take less
HERE_UM = 30.0


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("comeback")
    small = folder / "small.toml"
    small.write_text(SMALL_BENCH.replace('"small"', '"comeback"'))
    with closing(SimBench([str(small), "--dir", str(folder / "b")])) as bench:
        yield bench


@pytest.fixture(scope="module")
def server(bench):
    with served(bench.instrument) as server:
        yield server


@pytest.fixture
def instrument(server):
    with server.client() as instrument:
        instrument.command("ann", wait_s=PATIENCE_S)
        instrument.move(HERE_UM)
        yield instrument


def truth_um(bench):
    return bench.ask(do="truth")["z_um"]


def gone(instrument):
    """Wait until three questions are left unanswered; meanwhile the process goes on to tell how things stand."""
    told = []
    instrument.listen(lambda news: told.append(getattr(news, "z_age_s", 0.0)))
    instrument.wait_for(lambda state: state.z_age_s > AWAY_S, PATIENCE_S)
    assert sum(1.0 < age_s < AWAY_S for age_s in told) >= 3


def back(instrument):
    return instrument.wait_for(lambda state: state.z_age_s < 1.0, PATIENCE_S).z_um


def freeze(bench):
    os.kill(bench.process.pid, signal.SIGSTOP)


def thaw(bench):
    os.kill(bench.process.pid, signal.SIGCONT)


def unplug(bench):
    bench.ask(do="unplug", device="z")


def replug(bench):
    bench.ask(do="replug", device="z")


@pytest.mark.parametrize(
    ("lose", "find", "code"), [(freeze, thaw, "position-unknown"), (unplug, replug, "device-lost")]
)
def test_a_stage_that_comes_back_where_it_was_moves_again(instrument, bench, lose, find, code):
    lose(bench)
    gone(instrument)
    with pytest.raises(DeviceError) as refused:
        instrument.move(10.0)
    assert refused.value.code == code
    find(bench)
    assert back(instrument) == pytest.approx(HERE_UM, abs=0.2)
    assert truth_um(bench) == pytest.approx(HERE_UM, abs=0.2)
    assert instrument.move(10.0) == pytest.approx(10.0, abs=0.2)


def test_a_stage_whose_power_was_off_stays_refused_until_its_place_is_called_0(instrument, bench, tmp_path):
    bench.ask(do="power", device="z", on=False)
    gone(instrument)
    bench.ask(do="power", device="z", on=True)
    assert back(instrument) == pytest.approx(0.0, abs=0.2)
    for act in (
        lambda: instrument.move(10.0),
        lambda: instrument.jog(1.0),
        lambda: instrument.start_run(RECIPE, out=tmp_path / "run"),
    ):
        with pytest.raises(DeviceError, match=r"30\.00 µm was read last, and it says .0\.00 µm now") as refused:
            act()
        assert refused.value.code == "position-unknown"
        assert "call that place 0" in refused.value.message()
    assert not (tmp_path / "run").exists()
    assert truth_um(bench) == pytest.approx(HERE_UM, abs=0.2)
    instrument.zero()
    assert instrument.move(5.0) == pytest.approx(5.0, abs=0.2)
    assert truth_um(bench) == pytest.approx(HERE_UM + 5.0, abs=0.3)


class LostStage:
    """A stage without a zero of its own that is lost, and takes what `Comeback` makes of it."""

    position_known = False

    def __init__(self):
        self.met_at = []

    def reconnect(self, timeout_s, *, at_um=None):
        self.met_at.append(at_um)
        return 7.0


def test_nobody_asks_a_stage_to_be_anywhere_unless_it_was_known_where():
    stage = LostStage()
    comeback = Comeback(stage)
    assert comeback.read_um(may_meet=False) is None
    comeback.take_as_it_is()  # it has no zero to be told: nothing is known afterwards
    assert stage.met_at == []
    with pytest.raises(DeviceError, match="out of touch"):
        comeback.check()
