"""The program's outer shell: exit codes, words for people, nothing heavy imported before it is needed."""

import os
import signal
import subprocess
import sys
from importlib.metadata import EntryPoint, version
from pathlib import Path

import pytest

from devices import cli
from devices.errors import DeviceBusy, LimitError

HERE = __name__


def refuse() -> None:
    raise LimitError("Z: too far.", why="because", fix=("come back", "stay"))


def busy() -> None:
    raise DeviceBusy("taken")


def interrupt() -> None:
    raise KeyboardInterrupt


def stumble() -> None:
    raise ZeroDivisionError("by nothing")


def nine(count: int = 9) -> int:
    """Return a number."""
    return count


@pytest.fixture(autouse=True)
def commands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The program with commands of our own in place of the installed ones."""
    names = {"refuse": refuse, "busy": busy, "interrupt": interrupt, "stumble": stumble, "count nine": nine}
    points = [EntryPoint(name, f"{HERE}:{function.__name__}", cli.GROUP) for name, function in names.items()]
    points.append(EntryPoint("absent", "no.such.module:command", cli.GROUP))
    monkeypatch.setattr(cli, "installed", lambda group: points)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def test_an_error_of_ours_becomes_words_and_its_exit_code(capsys: pytest.CaptureFixture):
    assert cli.run(["refuse"]) == 5
    assert capsys.readouterr().err == "error[limit]: Z: too far.\n  why: because\n  fix: come back\n   or: stay\n"
    assert cli.run(["busy"]) == 8


def test_a_command_returns_its_exit_code():
    assert cli.run(["count", "nine"]) == 9
    assert cli.run(["count", "nine", "--count", "6"]) == 6


def test_a_command_shows_its_own_help_and_a_list_of_commands_our_words(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cli, "COMMAND_HELP", {"count nine": "Count.", "count": "Numbers."})
    assert cli.run(["count", "nine", "--help"]) == 0
    assert "Return a number." in capsys.readouterr().out
    assert cli.run(["count", "--help"]) == 0
    assert "Count." in capsys.readouterr().out
    assert cli.run(["--help"]) == 0
    assert "Numbers." in capsys.readouterr().out


def test_ctrl_c_before_anything_was_kept(capsys: pytest.CaptureFixture):
    assert cli.run(["interrupt"]) == 130
    assert capsys.readouterr().err == "interrupted.\n"


def test_a_bug_is_one_line_and_its_traceback_is_in_the_log(capsys: pytest.CaptureFixture, tmp_path: Path):
    assert cli.run(["stumble"]) == 1
    log = tmp_path / "stereotome" / "bugs.log"
    assert capsys.readouterr().err == f"error[bug]: ZeroDivisionError: by nothing; traceback in {log}\n"
    assert "in stumble" in log.read_text()


def test_a_log_that_cannot_be_written_goes_elsewhere(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(cli.tempfile, "gettempdir", lambda: str(tmp_path))
    assert cli.run(["stumble"]) == 1
    assert f"stereotome-bugs-{os.getpid()}.log" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["refsue"], "no command 'refsue'; did you mean 'refuse'?\n  fix: see stereotome --help"),
        (["count", "eight"], "no command 'eight'; known here: nine\n  fix: see stereotome count --help"),
        (["count", "nine", "--count", "many"], "see stereotome count nine --help"),
        (["count", "nine", "--cuont", "3"], "--cuont"),
    ],
)
def test_wrong_usage_is_two_lines_and_exit_2(capsys: pytest.CaptureFixture, arguments: list[str], words: str):
    assert cli.run(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error[usage]: ")
    assert words in said
    assert len(said.splitlines()) == 2


ENDLESS = """
import sys
from devices import cli
cli.build_app = lambda arguments: lambda *a, **k: [print("x", flush=True) for _ in range(99999)]
sys.exit(cli.run([]))
"""
WAITING = """
import os, signal
from devices import cli
cli.run = lambda arguments: os.kill(os.getpid(), signal.SIGTERM) or signal.pause()
cli.main()
"""


def test_a_reader_that_leaves_is_no_error():
    with subprocess.Popen([sys.executable, "-c", ENDLESS], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        program.stdout.readline()
        program.stdout.close()
        assert program.wait(30) == 0
        assert program.stderr.read() == b""


MICRO = "from devices import cli; cli.run = lambda arguments: print('5 µm'); cli.main()"


def test_a_terminal_without_our_signs_gets_the_rest():
    plain = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", MICRO], capture_output=True, timeout=60, env=plain)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"5 ?m\n", b"")


def stereotome(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [Path(sys.executable).with_name("stereotome"), *arguments], capture_output=True, text=True, timeout=60
    )


def test_the_program_tells_its_version():
    assert stereotome("--version").stdout.strip() == version("stereotome")


@pytest.mark.parametrize("arguments", [["--version"], ["devices", "list"], ["devcies"], ["devices"]])
def test_nothing_heavy_is_imported_before_it_is_needed(arguments: list[str]):
    code = f"import sys; from devices.cli import run; run({arguments!r}); sys.stderr.write('|' + ' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    loaded = set(done.stderr.rpartition("|")[2].split())
    assert "devices.cli" in loaded
    assert not loaded & {"numpy", "cv2", "numba", "matplotlib", "zarr", "tensorstore"}


def test_a_command_that_is_told_to_end_ends_with_143():
    assert subprocess.run([sys.executable, "-c", WAITING], timeout=60).returncode == 128 + signal.SIGTERM
