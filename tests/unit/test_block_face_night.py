"""A night at the microtome through the real command: debris, a jam and a full disk, and what the morning finds.

With ``--long`` it is 50 sections, else a few.
"""

import json
import os
import pty
import shlex
import signal
import subprocess

import pytest
from sections import BENCH, RECIPE, cuts, files, ready_rig
from wires import PROGRAM, stereotome

from acquire.store import RunEnd, open_run

BLOCK = BENCH.replace("[48, 40]", "[320, 256]") + '\n[sim]\nspecimen = "block"\nseed = 11\n'
STACK = "top_um = 0.0\nbottom_um = 0.0\nplanes = 1"
RESERVE = 1_000_000
FRAME_BYTES = 320 * 256 * 2


@pytest.fixture
def sections(pytestconfig):
    return 50 if pytestconfig.getoption("long") else 9


def homed(start_bench, instrument, *faults):
    bench = start_bench(instrument, faults=list(faults))
    with ready_rig(bench):
        pass
    return bench


def night(where, instrument, recipe):
    """The night as a shell script on a disk of its own; `go` lets it go on, the fifo fills the disk."""
    run = shlex.join([*PROGRAM, "run"])
    phase = """echo '{"event": "phase", "code": '$?'}'; read go"""
    return f"""
    mount -t tmpfs -o size=64m none {where} || exit 99
    (read go < {where}.fill; free=$(df -B1 --output=avail {where} | tail -1)
     head -c $((free - {RESERVE + FRAME_BYTES * 3 // 2})) /dev/zero > {where}/ballast) & filler=$!
    {run} {recipe} -i {instrument} --out {where}/run --json --on-hold end </dev/null; {phase}
    {run} --resume {where}/run -i {instrument} --json --answer not-done </dev/null; {phase}
    rm {where}/ballast
    {run} --resume {where}/run -i {instrument} --json --on-hold end </dev/null; {phase}
    cp -r {where}/run {where}-morning; copied=$?
    kill $filler 2>/dev/null; exit $copied
    """


def test_a_night_with_debris_a_jam_and_a_full_disk_is_complete_in_the_morning(start_bench, tmp_path, sections):
    stack = RECIPE.replace("top_um = 2.0\nbottom_um = -2.0\nstep = 4.0", STACK)
    thick = sections // 2 + 1  # the cut that jams is the first thin one
    thickness = f'thickness_nm = "1-{thick}: 500, {thick + 1}-: 300"'
    text = stack.replace("count = 3", f"count = {sections}").replace("thickness_nm = 500", thickness)
    instrument, recipe = files(tmp_path, BLOCK, text)
    bench = homed(start_bench, instrument, f"block.debris@{sections // 3}")
    where, fill, codes = tmp_path / "disk", tmp_path / "disk.fill", []
    where.mkdir()
    os.mkfifo(fill)
    shell = subprocess.Popen(
        ["unshare", "-rm", "sh", "-c", night(where, bench.instrument, recipe)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    for line in shell.stdout:
        event = json.loads(line)
        if event["event"] == "section" and event["section"] == sections // 2:
            bench.ask(do="fault", set="feed.jam")
        if event["event"] == "section" and event["section"] == sections // 2 + 1:
            fill.write_text("now\n")
        if event["event"] == "phase":
            codes.append(event["code"])
            if len(codes) == 1:
                bench.ask(do="fault", clear="feed.jam")
            shell.stdin.write("go\n")
            shell.stdin.flush()
    shell.stdin.close()
    shell.stdout.close()
    assert shell.wait() == 0
    assert codes == [11, 6, 0]
    run = open_run(tmp_path / "disk-morning")
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    assert cuts(bench) == sections + 1  # one of them wiped the debris away
    removed = bench.ask(do="truth")["counters"]["feed"]["removed_um"]
    assert sorted(round(1000 * um) for um in removed[1:]) == [0, *[300] * (sections - thick), *[500] * (thick - 1)]
    text = (run.folder / "report.md").read_text()
    for told in (
        "COMPLETED",
        "debris",
        "wipes the face",
        "HOLD [knife-failed]",
        "answered: not-done",
        "HOLD [disk-full]",
    ):
        assert told in text, told
    assert text.count("the run went on") == 2


class AtTerminal:
    """A run started by hand, on a bench whose knife jams."""

    def __init__(self, start_bench, tmp_path):
        instrument, recipe = files(tmp_path)
        self.bench = homed(start_bench, instrument, "feed.jam")
        self.folder = tmp_path / "run"
        self.keyboard, terminal = pty.openpty()
        command = [*PROGRAM, "run", recipe, "-i", self.bench.instrument, "--out", self.folder, "--yes", "--json"]
        self.process = subprocess.Popen(
            list(map(str, command)), stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        os.close(terminal)

    def type(self, words):
        os.write(self.keyboard, words)

    def events(self, name):
        """The run's events of this name, as they come."""
        return (event for line in self.process.stdout if (event := json.loads(line))["event"] == name)

    def end(self):
        """Exit code, and what was said."""
        _, words = self.process.communicate()
        os.close(self.keyboard)
        return self.process.returncode, words


def test_a_question_is_asked_and_answered_at_the_terminal(start_bench, tmp_path):
    run = AtTerminal(start_bench, tmp_path)
    run.type(b"done\n")  # typed before anything was asked: answers nothing
    for _ in run.events("hold"):
        run.bench.ask(do="fault", clear="feed.jam")
        run.type(b"perhaps\nnot-done\n")
    code, words = run.end()
    assert code == 0, words
    assert "HOLD [knife-failed]" in words
    assert "not-done" in words
    assert "error[no-answer]" in words
    assert open_run(run.folder).state is RunEnd.COMPLETED
    assert cuts(run.bench) == 3


def test_ctrl_c_at_a_question_ends_the_run_without_an_answer(start_bench, tmp_path):
    run = AtTerminal(start_bench, tmp_path)
    next(run.events("hold"))
    run.process.send_signal(signal.SIGINT)
    code, words = run.end()
    assert code == 130, words  # no plane was taken yet
    assert open_run(run.folder).state is RunEnd.CANCELLED
    assert cuts(run.bench) == 0


def test_two_engines_do_not_share_an_instrument(start_bench, tmp_path):
    instrument, recipe = files(tmp_path)
    bench = homed(start_bench, instrument)
    with ready_rig(bench):
        result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run")
    assert result.code == 8, result.err
    assert "error[device-busy]" in result.err
    assert not (tmp_path / "run").exists()


def test_a_disk_that_cannot_be_written_is_one_clear_line(start_bench, tmp_path):
    instrument, recipe = files(tmp_path)
    bench = homed(start_bench, instrument)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", "/proc/run", "--set", "output.keep_free_gb=0")
    assert result.code == 6, result.err
    assert result.err.count("error[") == 1
    assert "Traceback" not in result.err
