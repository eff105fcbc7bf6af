"""The simulated bench, started in a process of its own and known only by the instrument file it writes."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import DeviceError, RigError
from devices.feed_values import FeedState
from devices.protocols import Microtome
from devices.rig import RigSpec, load_rig, open_rig

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from contextlib import ExitStack

    from devices.protocols import Clock
    from devices.rig import Rig

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


def instrument_spec(
    stack: ExitStack, path: Path | None, overrides: Sequence[str], *, sim: bool, block: bool = False
) -> RigSpec:
    """Return what an instrument file says, or, for ``sim``, the simulated bench that stands in for it.

    Parameters
    ----------
    stack : ExitStack
        Ends the simulated bench.
    block : bool
        Put a microtome on the simulated bench when no instrument is named.

    Raises
    ------
    RigError
        The file is wrong, or none is given.
    """
    if not sim:
        if path is None:
            raise RigError("no instrument is given.", fix=("name its file: -i RIG.toml", "work without one: --sim"))
        return load_rig(path, overrides)
    spec = None if path is None else load_rig(path, overrides)
    scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="stereotome-bench-")))
    return simulated_rig(stack.enter_context(simulated_bench(path, scratch, overrides, block=block)), spec)


@contextmanager
def opened(spec: RigSpec, clock: Clock, transcript: Path | None, *, home: bool) -> Iterator[Rig]:
    """Open an instrument; ``home`` consents to the feed's search for its reference, as on a simulated bench."""
    with open_rig(spec, clock=clock, transcript=transcript) as rig:
        feed: object = rig.feed
        if home and isinstance(feed, Microtome) and feed.resolve() is not FeedState.READY:
            feed.home()
        yield rig
