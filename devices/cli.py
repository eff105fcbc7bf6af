"""The program ``stereotome``: finds its subcommands, runs one, and turns whatever happens into words and an exit code.

Every package contributes subcommands through entry points of the group ``stereotome.commands``; a name of two words
such as ``"process focus"`` is a subcommand of a subcommand. A command's module is imported only when it is used. A
command is a plain function; it returns its exit code, or None for 0.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from cyclopts import App, CycloptsError, UnknownCommandError

from devices.errors import StereotomeError, did_you_mean
from devices.installed import installed

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

GROUP = "stereotome.commands"
HELP = "Takes focal and section stacks at the microscope and shows the third dimension."
COMMAND_HELP = {
    "config": "Look at instrument and recipe files.",
    "config check": "Check instrument and recipe files.",
    "console": "Work at an instrument in a window: focus, stacks, sections, and what was taken.",
    "control": "At an instrument that is being served, what the console's buttons do.",
    "control answer": "Answer what the run asks.",
    "control camera": "Set exposure and part of the frame.",
    "control cancel": "End the run after the exposure in progress.",
    "control jog": "Move the z stage by a distance.",
    "control move": "Move the z stage to a position.",
    "control note": "Write a note into the journal of the run.",
    "control pause": "Have the run wait after this plane, stack or section.",
    "control release": "Allow motion again after a stop.",
    "control resume": "Let a run that waits go on.",
    "control section": "Feed and knife by hand.",
    "control section approach": "Go forward to an absolute depth in one go.",
    "control section cut": "Take one section with the knife, once.",
    "control section feed": "Feed forward by the thickness of one section, once.",
    "control section home": "Move the feed to its home switch.",
    "control section retract": "Bring the knife out, or draw the feed back.",
    "control section show": "Say where feed and knife stand; nothing moves.",
    "control show": "Say how stage, camera and run stand, and who commands.",
    "control stop": "Stop all motion now and end the run.",
    "control zero": "Call the stage's present place 0 µm.",
    "demo": "Take a stack on a simulated bench and make pictures of it; needs no files.",
    "devices": "Look at what is connected.",
    "devices init": "Write an instrument file by a short dialogue, and try it.",
    "devices list": "List the serial ports present now and the installed drivers.",
    "devices probe": "Ask who is at a serial port; changes nothing.",
    "doctor": "See whether this machine is ready, and how to mend what is not.",
    "export": "Copy a run into a file that other programs read.",
    "glasses": "Try the shutter glasses of an instrument.",
    "glasses mode": "Choose what gives the glasses their turns.",
    "glasses pattern": "Show a test picture for each eye, and report how that went.",
    "glasses show": "Let one eye see, or both, for a while.",
    "glasses swap": "Exchange the eyes.",
    "glasses test": "Measure the link to the glasses and how evenly turns are given.",
    "import": "Make a run of a stack of another program, or of cut sections.",
    "keys": "Make keys for clients of an instrument process on other computers.",
    "measure": "Measure the features of a volume, and the volume as a whole.",
    "process": "Make pictures and measurements from stacks.",
    "process align": "Align the sections of a stack, and say how sure that is.",
    "process apply": "The same as process volume, data first: steps of a pipeline on a range image or a stack.",
    "process crater": "Bend the planes of a depth profile to the crater measured after it.",
    "process deblur": "Take the blur out of a stack of fluorescence.",
    "process elevation": "Measure the elevation of a surface from two views at a known tilt.",
    "process faces": "Make a volume of a run of sections with focal stacks.",
    "process focus": "Make an extended-focus image and a range image from a focal stack.",
    "process indents": "Measure hardness indents, and the depth removed between two pictures of a face.",
    "process psf": "Measure the point spread function on a stack of beads.",
    "process register": "Put a volume on another one of the same specimen.",
    "process resample": "Make the voxels of a stack cubic.",
    "process volume": "Apply operators to a volume or a range image, one after the other.",
    "process operators": "List the operators that steps of a pipeline may name.",
    "run": "Take what a recipe says.",
    "section": "Move a microtome's feed and knife by hand.",
    "section approach": "Go forward to an absolute depth in one go.",
    "section check": "Print every frame of a feed drive's profile.",
    "section cut": "Take one section with the knife, once.",
    "section feed": "Feed forward by the thickness of one section.",
    "section home": "Move the feed to its home switch.",
    "section retract": "Bring the knife out, or draw the feed back.",
    "section show": "Say where feed and knife stand; nothing moves.",
    "section stop": "Stop feed and knife at once.",
    "serve": "Own an instrument, and let consoles, scripts and observers work with it.",
    "snap": "Take a picture, or a few, without a run.",
    "stage": "Look at the z stage and move it by hand.",
    "stage home": "Move the z stage to 0 µm.",
    "stage jog": "Move the z stage by a distance.",
    "stage move": "Move the z stage to a position.",
    "stage park": "Move the z stage to its safe place.",
    "stage show": "Say where the z stage is.",
    "stage stop": "Stop the z stage at once, past any program that holds it.",
    "stage zero": "Call the present place 0 µm.",
    "relief": "Draw a range image: lit or coloured surface, grid, contour map, profiles.",
    "render": "Make a picture of a stack or volume, without a window.",
    "surface": "Draw surfaces of features, from meshes or labelled volumes.",
    "varifocal": "Plan which plane is shown when, before a mirror that moves.",
    "view": "Open a window on a stack, a volume, or an instrument at work.",
    "sim": "A simulated bench to put in place of an instrument.",
    "sim serve": "Serve a simulated bench until it is told to end.",
    "sim specimen": "Make a specimen of known size as a volume of grey values.",
}
USAGE, INTERRUPTED = 2, 130


def main() -> NoReturn:
    """Run the program with the arguments of the command line and leave with its exit code."""
    signal.signal(signal.SIGTERM, _leave)
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without a µ is no reason to stop
    logging.getLogger().addHandler(logging.NullHandler())  # or Python prints stray warnings of libraries to the user
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; nothing but words reaches the user."""
    try:
        result = build_app(arguments)(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except StereotomeError as error:
        return _say(error.message(), error.exit_code)
    except CycloptsError as error:
        return _say(_usage(error), USAGE)
    except KeyboardInterrupt:
        return _say("interrupted.", INTERRUPTED)
    except BrokenPipeError:
        return _reader_left()
    except Exception as bug:  # noqa: BLE001  the last stop before the user: a bug becomes one line and a log entry
        return _say(f"error[bug]: {type(bug).__name__}: {bug}; traceback in {_logged(arguments)}", 1)
    return result if isinstance(result, int) else 0


def build_app(arguments: Sequence[str]) -> App:
    """Return the program with every installed command, none of them imported yet.

    A list of commands shows our short words for each; the command asked for by ``arguments`` shows its own.
    """
    asked = " ".join(arguments)
    app = App("stereotome", help=HELP, version=lambda: version("stereotome"), suppress_keyboard_interrupt=False)
    groups = {"": app}
    for point in sorted(installed(GROUP), key=lambda point: point.name):
        group, _, name = point.name.rpartition(" ")
        words = None if asked.startswith(point.name) else COMMAND_HELP.get(point.name)
        _group(groups, group).command(point.value, name=name, help=words)
    return app


def _group(groups: dict[str, App], path: str) -> App:
    """Return the command under which others stand, made on first use."""
    if path not in groups:
        above, _, name = path.rpartition(" ")
        groups[path] = App(name, help=COMMAND_HELP.get(path, ""))
        _group(groups, above).command(groups[path])
    return groups[path]


def _usage(error: CycloptsError) -> str:
    command = " ".join(["stereotome", *(error.command_chain or ())])
    words = _unknown_command(error) if isinstance(error, UnknownCommandError) else " ".join(str(error).split())
    return f"error[usage]: {words}\n  fix: see {command} --help"


def _unknown_command(error: UnknownCommandError) -> str:
    """Word it from the names alone: the framework would import every command to do so."""
    group = " ".join(error.command_chain or ())
    names = [point.name for point in installed(GROUP)]
    known = [name.removeprefix(group).split()[0] for name in names if name.startswith(group)]
    word = (error.unused_tokens or [""])[0]
    return f"no command '{word}'{did_you_mean(word, sorted(set(known)))}"


def _say(words: str, code: int) -> int:
    sys.stderr.write(f"{words}\n")
    return code


def _leave(signum: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001  the shape of a signal handler
    sys.exit(128 + signum)


def _reader_left() -> int:
    """Nobody reads our output any more (``| head``): be quiet, also when Python flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _logged(arguments: Sequence[str]) -> Path:
    """Append the present traceback to the log and return the log's path."""
    entry = f"{datetime.now(UTC).isoformat()} stereotome {' '.join(arguments)}\n{traceback.format_exc()}\n"
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "stereotome"
    try:
        return _append(state / "bugs.log", entry)
    except OSError:
        return _append(Path(tempfile.gettempdir()) / f"stereotome-bugs-{os.getpid()}.log", entry)


def _append(log: Path, entry: str) -> Path:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        file.write(entry)
    return log
