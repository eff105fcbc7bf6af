"""The command ``stereotome console``."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from acquire.logs import logged
from acquire.meeting import ServerGone
from acquire.served import found_or_started
from devices.errors import DisplayError
from devices.rig import load_rig
from display.console import settings as remembered
from display.console.bench import Bench
from display.console.eyes import Eyes
from display.console.journal import Journal
from display.console.model import TOP_OF_UNKNOWN, Console
from display.console.setup import Later, Setup
from display.console.tour import Tour

if TYPE_CHECKING:
    from acquire.served import Served

Flag = Annotated[bool, Parameter(negative="")]


def console(
    *,
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    sim: Flag = False,
    block: Flag = False,
    server: str | None = None,
    keys: Path | None = None,
    scale: float | None = None,
) -> int:
    """Work at an instrument in a window: focus, stacks, sections, and what was taken.

    The instrument is driven by a process of its own, joined when it serves already; this window may close or crash and
    a run goes on. Where none is served and none is named, a dialogue finds the devices and writes an instrument file.

    Parameters
    ----------
    instrument
        The instrument file; without it and --sim, the only instrument that is served here.
    sim
        Take the simulated bench in place of the hardware.
    block
        With --sim and no instrument file: the bench with a microtome and a block.
    server
        Join a process: its instrument's name, its connection file, or tcp://HOST:PORT.
    keys
        Folder with this client's keys, for an instrument on another computer: `stereotome keys` makes them.
    scale
        How large everything is, where the system does not tell it right: 2 for 200 %.
    """
    if instrument is not None:
        load_rig(instrument)  # what is wrong with it is told before what is wrong with the screen
    needs_window()
    sys.stderr.write("starting the instrument's process, or joining it ...\n")
    served: Served | Later
    try:
        served = found_or_started(instrument, sim=sim, block=block, server=server, keys=keys)
    except ServerGone:
        if server is not None or instrument is not None or sim:
            raise
        served = Later()
    try:
        goes_on = show(served, scale=scale)
    except DisplayError:
        served.end()
        raise
    if goes_on:
        sys.stderr.write("the run goes on without the console; open it again to see it.\n")
    else:
        served.end()
    return 0


def demonstrate(folder: Path) -> int:
    """Show the console on the simulated bench, with a stack that runs and a short tour; its data goes to ``folder``."""
    sys.stderr.write("starting the simulated bench and its console ...\n")
    served = found_or_started(None, sim=True)
    show(served, tour=Tour(str(folder.absolute())))
    served.end()
    return 0


def show(served: Served | Later, *, scale: float | None = None, tour: Tour | None = None) -> bool:
    """Show the window until it is closed; return whether a run goes on."""
    from display.console.window import ConsoleWindow  # noqa: PLC0415  nothing else needs a display

    with ExitStack() as stack:
        stack.enter_context(logged("console"))
        made = opened(served, stack)
        made.tour = tour
        ConsoleWindow(made, scale=scale).run()
        return made.running


def opened(served: Served | Later, stack: ExitStack) -> Console:
    """Return a console of an instrument process; it leaves when the stack ends, its settings kept."""
    folder = remembered.settings_folder()
    settings = remembered.load(folder)
    journal = Journal()
    bench = Bench(served.connect, journal, anew=served.anew)
    stack.callback(bench.close)

    def top() -> int:
        return TOP_OF_UNKNOWN if bench.rig is None else (1 << bench.rig.camera.bit_depth) - 1

    eyes = Eyes(lambda: bench.ring, top, instrument=lambda: bench.instrument)
    stack.callback(eyes.close)
    made = Console(bench, eyes, journal, settings)
    if isinstance(served, Later):
        made.setup = Setup(served)
        stack.callback(made.setup.wait)
    stack.callback(made.flipping.close)

    def remember() -> None:
        made.remember()
        remembered.save(folder, settings)

    stack.callback(remember)
    return made


def has_display() -> bool:
    """Tell whether there may be a screen to open a window on."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def no_display(why: str) -> DisplayError:
    """Return the error of a console without a screen."""
    return DisplayError(
        "there is no display on which the console can be opened.",
        why=why,
        fix=("work without a window: stereotome run RECIPE", "over ssh: ssh -X"),
        code="no-display",
    )


def needs_window() -> None:
    """Say in words what is missing before anything is started."""
    try:
        import imgui_bundle  # noqa: F401, PLC0415
    except ImportError as cause:
        raise DisplayError(
            "the console's window cannot be drawn here.",
            why=str(cause),
            fix=("install its extra: pip install 'stereotome[console]'", "sudo apt install libgl1 libx11-6 libxext6"),
            code="no-console",
        ) from None
    if not has_display():
        raise no_display("DISPLAY and WAYLAND_DISPLAY are not set.")
