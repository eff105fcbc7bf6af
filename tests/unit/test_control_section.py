"""Feed and knife by hand from the command line, at a real instrument process on the wires of a simulated bench."""

import json
import signal
import subprocess
from contextlib import closing

import pytest
from sections import BENCH
from served import served
from wires import PROGRAM, Result

from acquire.requests import CutSection
from devices.cli import run
from sim.pytest_plugin import SimBench

HANDS = BENCH.replace("block-face", "hands").replace("speed_um_s = 300.0", "speed_um_s = 2.0")  # a stroke of 1.5 s
PARK_UM = -90


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hands")
    file = folder / "bench.toml"
    file.write_text(HANDS)
    with closing(SimBench([str(file), "--dir", str(folder / "b")])) as bench:
        yield bench


@pytest.fixture(scope="module")
def server(bench):
    """The instrument's process; its feed is homed, its stage parked."""
    with served(bench.instrument) as server:
        with server.client() as client:
            client.command()
            client.home_feed()
            client.move(PARK_UM)
        yield server


@pytest.fixture
def at(server, capsys):
    """Return a function that runs a command, in this process to spare its start, at the served instrument."""

    def here(*words):
        code = run(["control", *map(str, words), "--server", str(server.connection)])
        return Result(code, *capsys.readouterr())

    return here


def told(result):
    assert result.code == 0, result.err
    return json.loads(result.out)


def counters(bench):
    return bench.ask(do="truth")["counters"]["feed"]


def test_a_section_is_approached_fed_cut_and_left(at, bench):
    assert told(at("section", "approach", 20, "--json"))["depth_nm"] == pytest.approx(20_000, abs=2)
    before = counters(bench)
    fed = told(at("section", "feed", 500, "--json"))
    assert (fed["depth_nm"], fed["cuts"]) == (pytest.approx(20_500, abs=2), before["cuts"])
    assert counters(bench)["feeds"] == before["feeds"] + 1
    cut = at("section", "cut", "--stage-is-parked")
    assert (cut.code, f"knife: clear, {before['cuts'] + 1} cuts counted" in cut.out) == (0, True)
    assert counters(bench)["cuts"] == before["cuts"] + 1
    assert at("section", "retract", "--knife").code == 0
    assert "feed: ready, at 10.000 µm" in at("section", "retract", 10).out
    assert "feed: ready, at 10.000 µm" in at("section", "show").out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["home"], 5, "--yes"),
        (["cut"], 5, "--stage-is-parked"),
        (["approach", "1"], 5, "that is backwards"),
        (["retract", "3000"], 5, "that is forwards"),
        (["retract"], 5, "give a depth in µm, or --knife"),
        (["retract", "1", "--knife"], 5, "give a depth in µm, or --knife"),
        (["feed", "5000"], 5, "is not within 20 … 2000 nm"),
        (["feed", "nan"], 5, "Nothing moved"),
        (["approach", "nan"], 5, "Nothing moved"),
        (["approach", "9000"], 5, "Nothing moved"),
        (["slice"], 2, "no command 'slice'"),
    ],
)
def test_what_should_not_be_done_is_refused_and_nothing_moves(at, bench, server, words, code, said):
    with server.client() as client:
        client.command()
        client.approach(10.0)
    before = counters(bench)
    result = at("section", *words)
    assert (result.code, said in result.err) == (code, True), result.err
    assert counters(bench) == before


def test_no_cut_is_made_unless_the_stage_reads_its_park_position(at, bench):
    before = counters(bench)["cuts"]
    assert at("move", "0").code == 0
    refused = at("section", "cut", "--stage-is-parked")
    assert (refused.code, "it is parked at -90.00 µm. Nothing was cut" in refused.err) == (5, True)
    assert at("stop").code == 0
    stopped = at("section", "cut", "--stage-is-parked")
    assert (stopped.code, "error[serve-stopped]" in stopped.err) == (5, True)
    assert at("release").code == 0
    assert counters(bench)["cuts"] == before
    assert at("move", PARK_UM).code == 0


def until_it_cuts(bench, fine):
    while counters(bench)["knife"] != "cutting":
        assert fine()


def test_while_the_knife_is_out_the_stage_goes_nowhere_but_to_its_park_position(at, bench, server):
    before = counters(bench)["cuts"]
    with server.client() as client:
        client.command()
        client.arm_knife()
        cut = client.ask(CutSection(expect_section=before))
        until_it_cuts(bench, lambda: not cut.done())
        assert at("stop").code == 0
        assert cut.exception().code == "feed-halted"
    assert at("release").code == 0
    refused = at("jog", 1)
    assert (refused.code, "not clear. The stage stays where it is" in refused.err) == (5, True), refused.err
    assert at("move", PARK_UM).code == 0
    assert at("section", "retract", "--knife").code == 0
    assert at("jog", 1).code == 0
    assert at("move", PARK_UM).code == 0
    assert at("section", "cut", "--stage-is-parked").code == 0  # the stop is over: it does not end the next stroke
    assert counters(bench)["cuts"] == before + 1


def test_a_feed_that_was_unplugged_is_met_anew_when_its_knife_is_brought_out(at, bench):
    before = counters(bench)
    bench.ask(do="unplug", device="feed")
    assert "error[device-lost]" in at("section", "feed", 500).err
    bench.ask(do="replug", device="feed")
    assert "error[device-lost]" in at("section", "feed", 500).err
    assert "feed: ready" in at("section", "retract", "--knife").out
    assert counters(bench) == before
    assert at("section", "feed", 500).code == 0
    bench.ask(do="power-cycle", device="feed")
    assert "feed: idle" in at("section", "retract", "--knife").out
    assert "it is idle, not ready" in at("section", "feed", 500).err
    assert at("section", "home", "--yes").code == 0
    assert at("section", "feed", 500).code == 0


def test_a_cut_whose_answer_is_lost_is_told_to_be_unknown_and_not_made_again(bench, server):
    """The last of these tests: it kills the instrument's process in the middle of a stroke."""
    before = counters(bench)["cuts"]
    words = [*PROGRAM, "control", "section", "cut", "--stage-is-parked", "--server", str(server.connection)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as cut:
        until_it_cuts(bench, lambda: cut.poll() is None)
        server.process.send_signal(signal.SIGKILL)
        _, said = cut.communicate()
    assert (cut.returncode, "error[feed-undecided]" in said) == (5, True), said
    assert "told to cut once, and nobody knows whether it was executed" in said
    assert counters(bench)["cuts"] <= before + 1  # none more, when the watchdog stopped the knife on its way
