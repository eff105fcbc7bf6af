"""The command ``stereotome serve``: one process owns an instrument; consoles, scripts and observers are its clients."""

from __future__ import annotations

import json
import logging
import signal
import sys
import tempfile
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from acquire.bench import simulated_bench, simulated_rig
from acquire.keys import ServerKeys
from acquire.server import serving
from acquire.watchdog import Watchdog
from acquire.web_process import observed_at, observer_page
from devices.clock import SystemClock
from devices.errors import RigError
from devices.rig import load_rig, open_rig

if TYPE_CHECKING:
    from collections.abc import Sequence

    from devices.rig import RigSpec

CLOCK = SystemClock()


def serve(
    *,
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    sim: Annotated[bool, Parameter(negative="")] = False,
    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    bind: str | None = None,
    keys: Path | None = None,
    observe: Annotated[bool | str, Parameter(negative="")] = False,
) -> int:
    """Own an instrument, and let consoles, scripts and observers work with it, until Ctrl-C.

    Prints one line of JSON that names the connection file.

    Parameters
    ----------
    instrument
        The instrument file.
    sim
        Take the simulated bench in place of the hardware.
    set_
        Replace a value of the instrument file: --set optics.na=0.3
    bind
        Address to serve at: 127.0.0.1:5570, or any other with --keys. Without it, this user's programs on this computer
        alone can reach the instrument.
    keys
        Folder of keys made by `stereotome keys`; only those on its list are admitted.
    observe
        Show the newest picture and how things stand on a web page: --observe, or --observe=ADDRESS:PORT.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(message)s")
    with ExitStack() as stack:
        spec = _instrument(stack, instrument, set_, sim=sim)
        guarded = None if keys is None else ServerKeys(keys)
        where = observed_at(observe)
        watchdog = stack.enter_context(Watchdog(spec, CLOCK))
        rig = stack.enter_context(open_rig(spec, clock=CLOCK))
        watchdog.wait_until_ready()
        file, host = stack.enter_context(serving(rig, CLOCK, bind=bind, keys=guarded, beat=watchdog.beat))
        watchdog.halted = host.stop_all
        told = {"instrument": spec.name, "connection": str(file)}
        if where is not None:
            told["page"] = stack.enter_context(observer_page(file, *where))
        sys.stdout.write(json.dumps(told, ensure_ascii=False) + "\n")
        sys.stdout.flush()
        _wait()
    return 0


def _wait() -> None:
    """Wait for Ctrl-C or SIGTERM; a run under way then ends after its plane."""
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    over.wait()


def _instrument(stack: ExitStack, path: Path | None, overrides: Sequence[str], *, sim: bool) -> RigSpec:
    if not sim:
        if path is None:
            raise RigError("no instrument is given.", fix=("name its file: -i RIG.toml", "work without one: --sim"))
        return load_rig(path, overrides)
    spec = None if path is None else load_rig(path, overrides)
    scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="stereotome-bench-")))
    return simulated_rig(stack.enter_context(simulated_bench(path, scratch, overrides)), spec)
