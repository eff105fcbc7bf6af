"""The pytest plug-in ``stereotome_sim``: the fixture `sim_bench` starts simulated benches for a test.

A test asks for the fixture and calls it; each bench is a process of its own and ends with the test::

    def test_my_script(sim_bench):
        bench = sim_bench("my-instrument.toml", faults=["z.late@3"])
        my_script(bench.instrument)
        bench.ask(do="unplug", device="z")
        assert bench.ask(do="truth")["z_um"] == 0.0
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]
ANSWER_S = 20.0


class SimBench:
    """A running bench.

    Parameters
    ----------
    arguments : sequence of str
        Of ``stereotome sim serve``.

    Attributes
    ----------
    told : dict
        What the bench said first: its ports, and where its files are.
    instrument : Path
        The instrument file that connects to it.
    truth : Path
        The specimen's relief, as `numpy.load` reads it.
    process : subprocess.Popen
        The bench itself.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [*PROGRAM, "sim", "serve", *arguments, "--follow-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.communicate()
            raise RuntimeError("the simulated bench did not start; it said why on standard error")
        self.told: dict[str, Any] = json.loads(line)
        self.instrument = Path(self.told["instrument"])
        self.truth = Path(self.told["truth"])
        self._control: socket.socket | None = None

    def ask(self, **words: object) -> dict[str, Any]:
        """Ask the control socket and return its answer; see `sim.control`.

        Raises
        ------
        RuntimeError
            The bench said no; its words.
        """
        if self._control is None:
            host, _, port = self.told["control"].partition(":")
            self._control = socket.create_connection((host, int(port)), ANSWER_S)
        self._control.sendall(json.dumps(words).encode() + b"\n")
        with self._control.makefile("rb") as lines:
            answer: dict[str, Any] = json.loads(lines.readline())
        if not answer["ok"]:
            raise RuntimeError(answer["error"])
        return answer

    def kill(self) -> None:
        """End it as a power cut does."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.close()

    def close(self) -> None:
        """End it and wait until it has ended."""
        if self._control is not None:
            self._control.close()
        self.process.communicate()


class StartBench:
    """Starts benches: what the fixture `sim_bench` gives."""

    def __init__(self, folder: Path, running: ExitStack) -> None:
        self._folder = folder
        self._running = running
        self._started = 0

    def __call__(
        self, instrument: Path | str | None = None, *, faults: Sequence[str] = (), tcp: bool = False
    ) -> SimBench:
        """Start a bench.

        Parameters
        ----------
        instrument : path, optional
            The instrument file to stand in for.
        faults : sequence of str
            Those that are on from the beginning.
        tcp : bool
            Connect the instrument file to network ports instead of pseudo-terminals.
        """
        named = [] if instrument is None else [str(instrument)]
        folder = self._folder / f"bench-{self._started}"
        self._started += 1
        struck = [word for fault in faults for word in ("--fault", fault)]
        bench = SimBench([*named, "--dir", str(folder), *struck, *(["--tcp"] if tcp else [])])
        self._running.callback(bench.close)
        return bench


@pytest.fixture
def sim_bench(tmp_path: Path) -> Iterator[StartBench]:
    """Start simulated benches; each ends with the test."""
    with ExitStack() as running:
        yield StartBench(tmp_path, running)
