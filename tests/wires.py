"""The program as a user starts it."""

import multiprocessing
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]

# Processes of their own, forked from one that has the commands imported: a start costs a tenth of a new interpreter's.
_processes = multiprocessing.get_context("forkserver")
_processes.set_forkserver_preload(["acquire.cli", "devices.section_commands", "devices.stage_commands"])


@dataclass
class Result:
    code: int
    out: str
    err: str


def stereotome(*arguments, cwd=None, env=None, typed=""):
    """Run the program to its end and return its exit code and what it said; ``typed`` is its standard input."""
    environment = {**os.environ, "NO_COLOR": "1", **(env or {})}
    with TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("in", "out", "err")]
        files[0].write_text(typed)
        process = _processes.Process(target=_program, args=([*map(str, arguments)], cwd, environment, files))
        process.start()
        process.join()
        return Result(process.exitcode, *(file.read_text() for file in files[1:]))


def _program(arguments, cwd, environment, files):
    """Be the program, with files for what it is told and what it says."""
    for number, file in enumerate(files):
        os.dup2(os.open(file, os.O_RDWR | os.O_CREAT), number)
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode) for number, mode in enumerate("rww"))
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd or ".")
    sys.argv = ["stereotome", *arguments]
    from devices.cli import main

    main()
