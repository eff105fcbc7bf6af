"""The program as a user starts it."""

import os
import subprocess
import sys
from dataclasses import dataclass

PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]


@dataclass
class Result:
    code: int
    out: str
    err: str


def stereotome(*arguments, cwd=None, env=None, **options):
    """Run the program to its end and return its exit code and what it said."""
    done = subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        env={**os.environ, "NO_COLOR": "1", **(env or {})},
        **options,
    )
    return Result(done.returncode, done.stdout, done.stderr)
