"""The simulated bench, started in a process of its own and known only by the instrument file it writes."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import DeviceError
from devices.rig import RigSpec, load_rig

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

PROGRAM = [sys.executable, "-c", "from devices.cli import main; main()"]


@dataclass(frozen=True)
class Bench:
    """A running simulated bench: the instrument that connects to it, and the truth about its specimen."""

    instrument: Path
    truth: Path


@contextmanager
def simulated_bench(
    instrument: Path | None, folder: Path, overrides: Sequence[str] = (), *, block: bool = False
) -> Iterator[Bench]:
    """Run the simulated bench while the context lasts; it also ends when this process dies.

    Parameters
    ----------
    instrument : Path or None
        The instrument file it stands in for; None takes the bench's own default.
    folder : Path
        Where the bench writes its instrument file and its truth.
    overrides : sequence of str
        Values that replace those of the instrument file: ``"optics.na=0.3"``.
    block : bool
        Of the bench's own defaults, take the one with a microtome and a block.

    Raises
    ------
    DeviceError
        The bench did not start; its own words are passed on.
    """
    named = (["--block"] if block else []) if instrument is None else [str(instrument)]
    replaced = [word for given in overrides for word in ("--set", given)]
    process = subprocess.Popen(
        [*PROGRAM, "sim", "serve", *named, *replaced, "--dir", str(folder), "--follow-stdin"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the run, which still has to drive the stage back
    )
    assert process.stdout is not None
    try:
        yield _greeting(process.stdout.readline())
    finally:
        process.communicate()  # closes its standard input, which tells it to leave


def _greeting(line: bytes) -> Bench:
    try:
        told = json.loads(line)
        return Bench(Path(told["instrument"]), Path(told["truth"]))
    except (ValueError, KeyError):
        raise DeviceError(
            "the simulated bench did not start; it said why above.", fix="try it alone: stereotome sim serve"
        ) from None


def simulated_rig(bench: Bench, spec: RigSpec | None) -> RigSpec:
    """Return the instrument with its hardware replaced by the bench; a camera that replays files stays what it is."""
    simulated = load_rig(bench.instrument)
    if spec is None or spec.camera.driver != "folder":
        return simulated
    return simulated.model_copy(update={"camera": spec.camera})
