"""A bench, its instrument process, and a screen, for all tests of the console."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from screens import virtual_screen
from served import served

from sim.pytest_plugin import SimBench

RIG = """
schema = 1
name = "console-bench"
[camera]
driver = "sim"
size_px = [256, 256]
bit_depth = 12
pixel_um = 3.45
exposure_ms = 2.0
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "filled in by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
park_um = -80.0
speed_um_s = 5000.0
"""
HAND = Path(__file__).with_name("hand.py")
PICTURES = os.environ.get("STEREOTOME_PICTURES")  # where the pictures of the documentation are wanted


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("console")
    rig = folder / "rig.toml"
    rig.write_text(RIG)
    bench = SimBench([str(rig), "--dir", str(folder / "b")])
    yield bench
    bench.close()


@pytest.fixture(scope="module")
def server(bench):
    with served(bench.instrument) as server:
        yield server


@pytest.fixture(scope="module")
def screen():
    with virtual_screen("2560x1440") as environment:
        yield environment


@pytest.fixture
def drive(server, screen, tmp_path):
    """Drive the console by a function of `driven`; returns its exit code and where its pictures are."""

    def run(function, *, scale=1.0):
        folder = tmp_path if PICTURES is None else Path(PICTURES)
        child = subprocess.run(
            [sys.executable, str(HAND), function, str(server.connection), str(folder), str(scale)],
            env={**screen, "XDG_CONFIG_HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(server.runtime)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=280,
        )
        return child.returncode, child.stdout + child.stderr

    return run
