"""A bench, its instrument process, and a screen, for all tests of the console."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from screens import virtual_screen
from sections import BENCH
from served import served

from sim.pytest_plugin import SimBench

RIG = """
schema = 1
name = "console-bench"
[camera]
driver = "sim"
size_px = [SIDE, SIDE]
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
limits = { min_um = -5000.0, max_um = 5000.0 }
park_um = -80.0
"""
BLOCK = BENCH.replace("[48, 40]", "[160, 128]") + '\n[sim]\nspecimen = "block"\nseed = 11\n'
HAND = Path(__file__).with_name("hand.py")
PATIENCE_S = 280
PICTURES = os.environ.get("STEREOTOME_PICTURES")  # where the pictures of the documentation are wanted
SCALE = float(os.environ.get("STEREOTOME_SCALE", "1"))  # 2: all of them at 200 %


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("console")
    rig = folder / "rig.toml"
    rig.write_text(RIG.replace("SIDE", "512" if PICTURES else "96"))
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


@pytest.fixture(scope="module")
def knife_server(tmp_path_factory):
    """That of a bench with a knife: debris falls on the third face, the specimen is lost from the sixth on."""
    folder = tmp_path_factory.mktemp("knife")
    rig = folder / "rig.toml"
    rig.write_text(BLOCK if PICTURES is None else BLOCK.replace("[160, 128]", "[480, 384]"))
    bench = SimBench([str(rig), "--dir", str(folder / "b"), "--fault", "block.debris@3", "--fault", "block.lost@6"])
    with served(bench.instrument) as server:
        yield server
    bench.close()


@pytest.fixture
def drive(screen, tmp_path, bench):
    """Drive the console by a function of `driven`; returns its exit code and what it said."""

    def run(function, server, *, scale=1.0):
        folder = tmp_path if PICTURES is None else Path(PICTURES)
        scale *= SCALE if PICTURES else 0.5  # everything at its place, on a quarter of the pixels
        child = subprocess.run(
            [sys.executable, str(HAND), function, str(server.connection), str(folder), str(scale)],
            env={
                **screen,
                "XDG_CONFIG_HOME": str(tmp_path),
                "XDG_RUNTIME_DIR": str(server.runtime),
                "STEREOTOME_BENCH": bench.told["control"],
                "STEREOTOME_HANGS_S": str(PATIENCE_S - 10),
            },
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        if PICTURES:
            make_small(folder)
        return child.returncode, child.stdout + child.stderr

    return run


def make_small(folder):
    """Leave as many colours in the pictures as they need."""
    for path in folder.glob("console*.png"):
        with Image.open(path) as picture:
            small = picture.convert("RGB").quantize(255, Image.Quantize.MAXCOVERAGE, kmeans=1)
        small.save(path, optimize=True)
