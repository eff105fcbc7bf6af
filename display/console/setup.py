"""The first start: who is at which port, an instrument file from a few answers, and its process; without a window."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.meeting import ServerGone
from acquire.served import found_or_started
from devices.clock import SystemClock
from devices.commands import described_ports
from devices.config_commands import check_text
from devices.errors import InputError, StereotomeError
from devices.init_rig import (
    LIMITS_UM,
    NOBODY_KNOWN,
    SOURCES,
    USUAL_BAUD,
    USUAL_LIMITS_UM,
    Bench,
    note_bit_depth,
    remark,
    rig_text,
)
from devices.probe import BAUDS, probe_port
from devices.registry import drivers
from devices.rig import load_rig, open_rig
from processing.outputs import write_durably

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.client import Instrument
    from acquire.served import Served


class Later:
    """An instrument process that is chosen while the window is open already."""

    def __init__(self) -> None:
        self.served: Served | None = None

    def connect(self) -> Instrument:
        """Connect to what was chosen."""
        if self.served is None:
            raise ServerGone("no instrument is chosen yet.")
        return self.served.connect()

    def anew(self) -> bool:
        """Start it again, if this console started it."""
        return self.served is not None and self.served.anew()

    def end(self) -> None:
        """End what this console started."""
        if self.served is not None:
            self.served.end()


@dataclass
class Setup:
    """What is answered so far; slow things are done by a thread, one at a time.

    Attributes
    ----------
    doing : str
        What is under way, in words; empty for nothing.
    words : str
        What came of the last thing, in words.
    """

    later: Later
    file: str = "my-bench.toml"
    port: str = ""
    driver: str = "asi-ms2000"
    baud: int = USUAL_BAUD
    seen: str = NOBODY_KNOWN
    camera: str = "opencv"
    source: str = ""
    magnification: float = 20.0
    na: float = 0.45
    limits_um: tuple[float, float] = USUAL_LIMITS_UM
    ports: list[dict[str, Any]] = field(default_factory=list)
    doing: str = ""
    words: str = ""
    _noted: str = ""  # the file as it was written last, with what its camera told
    _thread: threading.Thread | None = None

    @property
    def done(self) -> bool:
        """Whether an instrument is chosen."""
        return self.later.served is not None

    @property
    def stages(self) -> list[str]:
        """Drivers of stages."""
        return sorted(drivers("stage"))

    @property
    def cameras(self) -> list[str]:
        """Drivers of cameras."""
        return sorted(drivers("camera"))

    @property
    def source_words(self) -> str:
        """What the camera's driver opens, in words; empty when it needs nothing."""
        return SOURCES[self.camera][0] if self.camera in SOURCES else ""

    def look(self) -> None:
        """Look which serial ports there are."""
        self.ports = described_ports()
        self.words = "" if self.ports else "No serial port is there now. A network port: socket://HOST:PORT"
        if self.ports and not self.port:
            self.port = self.ports[0]["name"]

    def ask(self) -> None:
        """Ask who is at the port, by questions that change nothing."""
        self._do(f"asking who is at {self.port} ...", self._probe)

    def start(self) -> None:
        """Write the file, unless there is another one of its name, and start its process."""
        self._do("starting the instrument's process ...", self._write_and_start)

    def simulate(self) -> None:
        """Start the simulated bench instead."""
        self._do("starting the simulated bench ...", lambda: self._serve(None))

    def text(self) -> str:
        """Return the instrument file these answers make."""
        source = self.source or (SOURCES[self.camera][1] if self.camera in SOURCES else "")
        low_um, high_um = self.limits_um
        return rig_text(
            Bench(
                name=Path(self.file).stem,
                camera=self.camera,
                source=source,
                magnification=self.magnification,
                na=self.na,
                seen=self.seen,
                driver=self.driver,
                port=self.port,
                baud=self.baud,
                min_um=low_um,
                max_um=high_um,
            )
        )

    def wait(self) -> None:
        """Wait for what is under way."""
        if self._thread is not None:
            self._thread.join()

    def _do(self, doing: str, what: Callable[[], None]) -> None:
        if not self.doing:
            self.doing, self.words = doing, ""
            self._thread = threading.Thread(target=self._run, args=(what,), name="setup", daemon=True)
            self._thread.start()

    def _run(self, what: Callable[[], None]) -> None:
        try:
            what()
        except StereotomeError as error:
            self.words = error.message()
        except OSError as error:
            self.words = f"{self.file}: {error.strerror}"
        finally:
            self.doing = ""

    def _probe(self) -> None:
        found = probe_port(self.port, BAUDS, SystemClock()).found
        if found is None or found.driver not in self.stages:
            self.seen = NOBODY_KNOWN
            self.words = f"{self.port}: {'nobody known answered' if found is None else f'{found.name}: no stage'}."
            return
        self.driver, self.baud, self.seen = found.driver, found.baud, remark(found)
        self.limits_um = LIMITS_UM.get(found.driver, USUAL_LIMITS_UM)
        self.words = f"{found.name}, {found.baud} baud: driver {found.driver}"

    def _write_and_start(self) -> None:
        path, text = Path(self.file), self.text()
        check_text(text, path.name)
        if path.exists() and path.read_text(encoding="utf-8") not in (text, self._noted):
            raise InputError(f"{path} exists already.", fix="choose another name", code="output-exists")
        write_durably(path, text.encode())
        with open_rig(load_rig(path), clock=SystemClock()) as rig:
            note_bit_depth(path, rig.camera.caps().bit_depth)
        self._noted = path.read_text(encoding="utf-8")
        self._serve(path)

    def _serve(self, path: Path | None) -> None:
        self.later.served = found_or_started(path, sim=path is None)
