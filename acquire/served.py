"""An instrument process: joined when it serves already, else started, in a process of its own."""

from __future__ import annotations

import json
import signal
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from acquire.bench import PROGRAM
from acquire.client import Instrument
from acquire.meeting import connection_file, is_served, runtime_folder
from devices.errors import DeviceError
from devices.rig import load_rig

LEAVE_AFTER_S = 30
END_S = 30.0
NAMES = {False: "simulated bench", True: "simulated block-face bench"}


@dataclass
class Served:
    """An instrument process.

    Attributes
    ----------
    place : Path or str
        Its connection file, or ``tcp://HOST:PORT``; None for the only one there is.
    process : Popen or None
        It, when this program started it.
    keys : Path or None
        Folder of the keys by which it lets this client in.
    options : tuple of str
        With which this program started it.
    """

    place: Path | str | None
    process: subprocess.Popen[bytes] | None = None
    keys: Path | None = None
    options: tuple[str, ...] = ()

    def connect(self) -> Instrument:
        """Connect to it; raises as `Instrument.connect`."""
        return Instrument.connect(self.place, keys=self.keys)

    def end(self) -> None:
        """End it, if this program started it."""
        if self.process is not None:
            with suppress(ProcessLookupError, subprocess.TimeoutExpired):
                self.process.send_signal(signal.SIGINT)
                self.process.wait(END_S)

    def anew(self) -> bool:
        """End it and start it again, so that all devices are opened anew; False when this program did not start it."""
        if self.process is None:
            return False
        self.end()
        started = _started(self.options)
        self.place, self.process = started.place, started.process
        return True


def found_or_started(
    instrument: Path | None,
    *,
    sim: bool = False,
    block: bool = False,
    server: str | None = None,
    keys: Path | None = None,
) -> Served:
    """Return the process that serves an instrument.

    Parameters
    ----------
    instrument : Path or None
        Instrument file; None with ``sim`` is the bench's own, and without it the only instrument that is served.
    server : str or None
        A process to join: its instrument's name, its connection file, or ``tcp://HOST:PORT``.
    keys : Path or None
        Folder of this client's keys, for an instrument on another computer.

    Raises
    ------
    StereotomeError
        The file is wrong, nobody serves, or the process did not start; its own words are passed on.
    """
    if server is not None or (instrument is None and not sim):
        served = Served(server, keys=keys)
        served.connect().close()  # says in words that there is none
        return served
    name = NAMES[block] if instrument is None else load_rig(instrument).name
    if is_served(connection_file(name)):
        return Served(connection_file(name))
    named = [] if instrument is None else ["-i", str(instrument.absolute())]
    return _started((*named, *(["--sim"] if sim else []), *(["--block"] if block else [])))


def _started(options: tuple[str, ...]) -> Served:
    log = runtime_folder() / "serve-started.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [*PROGRAM, "serve", *options, "--leave-after", str(LEAVE_AFTER_S)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,  # it outlives a client that crashes
        )
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        process.wait()
        raise _not_started(log)
    return Served(Path(json.loads(line)["connection"]), process, options=options)


def _not_started(log: Path) -> DeviceError:
    """Return the error the process told, as this program's own."""
    said = log.read_text(encoding="utf-8", errors="replace").strip()
    told = said[said.find("error[") :] if "error[" in said else said[-2000:]
    return DeviceError("the instrument process did not start.", why=f"It said:\n{told}", code="serve-silent")
