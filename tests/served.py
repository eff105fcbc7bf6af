"""An instrument process as a user starts it."""

import json
import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

from wires import PROGRAM

from acquire.client import Instrument

SMALL_BENCH = """
schema = 1
name = "small"
[camera]
driver = "sim"
size_px = [96, 80]
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
speed_um_s = 5000.0
"""

RECIPE = """
schema = 1
name = "t"
[output]
keep_free_gb = 0.001
[stack]
top_um = 10.0
bottom_um = -10.0
step = 2.0
"""
PATIENCE_S = 60.0


class Served:
    """A running ``stereotome serve``."""

    def __init__(self, instrument, *options, runtime):
        self.runtime = runtime
        self.process = subprocess.Popen(
            [*PROGRAM, "serve", "-i", str(instrument), *map(str, options)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_RUNTIME_DIR": str(runtime)},
            start_new_session=True,
        )
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(self.process.communicate()[1])
        self.told = json.loads(line)
        self.connection = Path(self.told["connection"])

    def client(self):
        return Instrument.connect(self.connection)

    def end(self):
        """End it as Ctrl-C does, and return its exit code and what it logged."""
        self.process.send_signal(signal.SIGINT)
        _, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, err


@contextmanager
def short_folder():
    """A folder whose path is short enough for sockets in it."""
    folder = Path(tempfile.mkdtemp(prefix="st-", dir="/tmp"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def served(instrument, *options):
    with short_folder() as runtime:
        server = Served(instrument, *options, runtime=runtime)
        try:
            yield server
        finally:
            if not server.process.stdout.closed:
                server.process.kill()
                server.process.communicate()
