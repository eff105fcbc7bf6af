"""What tests share."""

import json
import subprocess
from pathlib import Path

import pytest
from wires import PROGRAM, Bench


@pytest.fixture
def start_bench(tmp_path):
    """Start simulated benches; each ends with the test."""
    benches = []

    def start(*arguments):
        folder = tmp_path / f"bench-{len(benches)}"
        process = subprocess.Popen(
            [*PROGRAM, "sim", "serve", *map(str, arguments), "--dir", str(folder), "--follow-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        told = json.loads(process.stdout.readline())
        benches.append(process)
        return Bench(process, Path(told["instrument"]), Path(told["truth"]), told)

    yield start
    for process in benches:
        process.communicate()
