"""The logs of console and instrument process, written by the real handlers and shown by the real command."""

import logging
import subprocess

import pytest
from wires import PROGRAM, stereotome

from acquire import logs
from acquire.watch import RunLog


@pytest.fixture
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    root = logging.getLogger()
    level = root.level
    yield tmp_path
    root.setLevel(level)


def write(program, *words, level=logging.INFO):
    with logs.logged(program):
        for each in words:
            logging.getLogger("part").log(level, each)


def shown(*options):
    result = stereotome("logs", *options)
    assert (result.code, result.err) == (0, "")
    return [line.split(" ", 1)[1] for line in result.out.splitlines()]


def test_entries_of_all_programs_come_in_the_order_of_their_times(state):
    write("console")
    write("serve-a/b bench")
    console, serve = sorted(logs.logs_folder().iterdir())
    assert (console.name, serve.name) == ("console.log", "serve-a_b_bench.log")
    console.write_text("2026-01-01T00:00:00.001 INFO part: one\n2026-01-01T00:00:00.003 INFO part: three\n")
    serve.write_text("2026-01-01T00:00:00.002 ERROR part: two\n")
    assert shown() == ["INFO part: one", "ERROR part: two", "INFO part: three"]
    assert shown("-n", "1") == ["INFO part: three"]
    assert shown("--level", "error") == ["ERROR part: two"]


def test_a_traceback_belongs_to_its_entry():
    lines = ["2026-01-01T00:00:00.000 ERROR a: failed", "Traceback", "  line", "2026-01-01T00:00:01.000 INFO a: on"]
    assert list(logs.entries(lines, "error")) == ["2026-01-01T00:00:00.000 ERROR a: failed\nTraceback\n  line\n"]
    assert len(list(logs.entries(["left of an older entry", *lines], "info"))) == 2


def test_full_files_make_room_and_are_shown_before_the_newest(state, monkeypatch):
    monkeypatch.setattr(logs, "LARGEST_BYTES", 200)
    write("console", *(f"entry {k}" for k in range(12)))
    assert 1 < len(list(logs.logs_folder().iterdir())) <= 1 + logs.OLDER
    assert [int(line.split()[-1]) for line in shown()] == list(range(12))


def test_what_comes_is_followed_and_a_file_begun_anew_is_read_from_its_start(state):
    file = state / "x.log"
    tail = logs.Tail(file, "info")
    stamp = "2026-01-01T00:00:00.000 INFO a:"
    file.write_text(f"{stamp} one\n{stamp} half")
    assert tail.entries() == [f"{stamp} one\n"]
    with file.open("a") as more:
        more.write(" written\n")
    assert tail.entries() == [f"{stamp} half written\n"]
    file.write_text(f"{stamp} new\n")
    assert tail.entries() == [f"{stamp} new\n"]


def test_following_takes_in_logs_begun_since_and_goes_on_until_ctrl_c(state):
    write("console", "before")
    with subprocess.Popen([*PROGRAM, "logs", "-f"], stdout=subprocess.PIPE, text=True) as following:
        assert following.stdout.readline().endswith("before\n")
        write("console", "after")
        assert following.stdout.readline().endswith("after\n")
        write("serve-late", "begun since")
        assert following.stdout.readline().endswith("begun since\n")
        following.send_signal(2)
        assert not following.stdout.read()
    assert following.returncode == 0


def test_a_run_has_a_log_of_its_own(tmp_path):
    log = RunLog(tmp_path)
    log.hear({"event": "hold", "code": "debris"})
    log.close()
    assert shown("--run", str(tmp_path), "--level", "warning") == [
        'WARNING acquire.run: {"event": "hold", "code": "debris"}'
    ]


def test_without_any_log_it_says_so(state):
    for options in ((), ("--run", str(state))):
        result = stereotome("logs", *options)
        assert (result.code, result.out) == (2, "")
        assert "[no-log]" in result.err


def test_where_no_log_can_be_kept_the_program_goes_on(state, capsys):
    (state / "stereotome").write_text("in the way")
    write("console", "lost")
    assert capsys.readouterr().err.startswith("no log is kept:")
