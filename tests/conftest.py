"""What tests share."""

import atexit
import os
import shutil
import signal
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from pty_twin import OnPty

from devices.clock import SystemClock
from sim.controllers.open3d import Emitter
from sim.pytest_plugin import SimBench, StartBench

# a shell that starts the tests in the background has them and all their children ignore Ctrl-C
signal.signal(signal.SIGINT, signal.default_int_handler)

# how long an example takes says nothing on a machine that does other things as well
settings.register_profile("busy-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy-machine")

# logs of the programs under test are no part of those of whoever tests
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="stereotome-logs-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

GLASSES_RIG = """\
schema = 1
name = "bench"
[camera]
driver = "sim"
address = "127.0.0.1:1"
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "/dev/null"
limits = {{ min_um = -100.0, max_um = 100.0 }}
[glasses]
{glasses}
"""


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="try thousands of kills instead of hundreds")


@pytest.fixture
def start_bench(sim_bench):
    """Start simulated benches; each ends with the test."""
    return sim_bench


@pytest.fixture
def rig(tmp_path):
    def write(glasses):
        path = tmp_path / "rig.toml"
        path.write_text(GLASSES_RIG.format(glasses=glasses))
        return str(path)

    return write


@pytest.fixture
def emitter():
    """An emitter behind a pseudo-terminal: the twin and the port's name."""
    twin = Emitter(SystemClock())
    with closing(OnPty(twin.feed)) as far:
        yield twin, f'driver = "open3d"\nport = "{far.port}"'


@pytest.fixture(scope="module")
def benches_of_module(tmp_path_factory: pytest.TempPathFactory):
    """Benches by the text of their instrument file and their kind of ports, each started once for a module."""
    with ExitStack() as running:
        yield StartBench(tmp_path_factory.mktemp("benches"), running), {}


@pytest.fixture
def lend_bench(benches_of_module):
    """Lend simulated benches to a test that leaves them alive, each as it was at its start."""
    start, running = benches_of_module

    def lend(instrument: Path, *, tcp: bool = False) -> SimBench:
        kind = (Path(instrument).read_text(), tcp)
        if kind not in running:
            running[kind] = start(instrument, tcp=tcp)
        running[kind].ask(do="reset")
        return running[kind]

    return lend


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory):
    """A small bench for all tests of the instrument process."""
    from served import SMALL_BENCH

    folder = tmp_path_factory.mktemp("bench")
    small = folder / "small.toml"
    small.write_text(SMALL_BENCH)
    bench = SimBench([str(small), "--dir", str(folder / "b")])
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def server(small_bench):
    """An instrument process with its page, for all tests that leave it running."""
    from served import served

    with served(small_bench.instrument, "--observe") as server:
        yield server
