"""The command ``stereotome serve``: one process owns an instrument; consoles, scripts and observers are its clients."""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
from contextlib import ExitStack
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from acquire.bench import instrument_spec, opened
from acquire.keys import ServerKeys
from acquire.logs import logged
from acquire.meeting import addresses
from acquire.server import serving
from acquire.watchdog import DEAD_AFTER_S, Watchdog
from acquire.web_process import observed_at, observer_page
from devices.clock import SystemClock

if TYPE_CHECKING:
    from acquire.host import Host

CLOCK = SystemClock()
LOOK_S = 0.5
GIVEN_UP = f"the instrument process stood still for {DEAD_AFTER_S:g} s: its watchdog stopped all motion."


def serve(
    *,
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    sim: Annotated[bool, Parameter(negative="")] = False,
    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    bind: str | None = None,
    keys: Path | None = None,
    observe: Annotated[bool | str, Parameter(negative="")] = False,
    transcript: Path | None = None,
    block: Annotated[bool, Parameter(negative="")] = False,
    leave_after: Annotated[float | None, Parameter(name="--leave-after")] = None,
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
    transcript
        Folder in which every exchange with the devices is recorded.
    block
        With --sim and no instrument file: the bench with a microtome and a block.
    leave_after
        End by itself when nobody commanded for so many seconds and no run is under way.
    """
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(message)s")
    guarded = None if keys is None else ServerKeys(keys)
    endpoints, where = addresses(bind, keyed=keys is not None), observed_at(observe)
    with ExitStack() as stack:
        spec = instrument_spec(stack, instrument, set_, sim=sim, block=block)
        stack.enter_context(logged(f"serve-{spec.name}"))
        watchdog = stack.enter_context(Watchdog(spec, CLOCK))
        rig = stack.enter_context(opened(spec, CLOCK, transcript, home=sim))
        watchdog.wait_until_ready()
        file, host = stack.enter_context(serving(rig, CLOCK, endpoints, keys=guarded, beat=watchdog.beat))
        watchdog.halted = lambda: host.stop_all(GIVEN_UP)
        told = {"instrument": spec.name, "connection": str(file)}
        if where is not None:
            told["page"] = stack.enter_context(observer_page(file, *where))
        sys.stdout.write(json.dumps(told, ensure_ascii=False) + "\n")
        sys.stdout.flush()
        _wait(host, leave_after)
    return 0


def _wait(host: Host, leave_after_s: float | None) -> None:
    """Wait for Ctrl-C or SIGTERM; a run under way then ends after its plane, and at once when told a second time.

    With ``leave_after_s`` also until nobody commanded for so long while no run was under way.
    """
    over = threading.Event()

    def on_signal(*_: object) -> None:
        if over.is_set():
            threading.Thread(target=host.stop_all, name="stop", daemon=True).start()
        over.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    used_s = CLOCK.now()
    while not over.wait(LOOK_S):  # the handler runs when the main thread turns: one that waits for ever may never turn
        if host.in_use:
            used_s = CLOCK.now()
        elif leave_after_s is not None and CLOCK.now() - used_s > leave_after_s:
            return
