"""The command ``stereotome sim serve``: the simulated bench as a process of its own."""

from __future__ import annotations

import json
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.rig import load_rig
from sim.bench import build_bench, instrument_text
from sim.bench_folder import bench_folder
from sim.camera_server import CameraServer
from sim.control import Control
from sim.faults import Faults, parse_faults
from sim.rack import fill_rack
from sim.triggered_camera import FaultyLines, TriggerLines

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.bench import Bench

DEFAULT_INSTRUMENT = Path(__file__).with_name("default_instrument.toml")
DEFAULT_BLOCK = Path(__file__).with_name("default_block.toml")


def serve(
    instrument: Path | None = None,
    *,
    block: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    folder: Annotated[Path | None, Parameter(name="--dir")] = None,
    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="", show_default=False)] = (),
    fault: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = (),
    tcp: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    follow_stdin: Annotated[bool, Parameter(negative="", show_default=False)] = False,
) -> int:
    """Simulate every device of an instrument file, on wires, over a specimen that is known, until stopped.

    Prints one line of JSON that names the instrument file to use with other commands and the control socket, and
    serves until Ctrl-C.

    Parameters
    ----------
    instrument
        The instrument file to stand in for; without it a 20x/0.45 bench of 512 x 512 pixels.
    block
        Without an instrument file: put a microtome on the bench, and a block of tissue in front of its knife.
    folder
        Where to write instrument.toml and truth.npz; without it a new one, removed at the end.
    set_
        Replace a value of the instrument file: --set optics.na=0.3
    fault
        Something that goes wrong, such as z.silent, z.late@3, z.garble@10%, z.die@5, z.stall@12.5um, camera.drop@2.
    tcp
        Connect the instrument file to the TCP port of the stage instead of its pseudo-terminal.
    follow_stdin
        End also when standard input ends, so as never to outlive the program that started this one.
    """
    spec = load_rig(instrument or (DEFAULT_BLOCK if block else DEFAULT_INSTRUMENT), set_)
    faults = Faults(parse_faults((*spec.sim.faults, *fault)), SystemClock(), seed=spec.sim.seed)
    bench = build_bench(spec, SystemClock(), faults)
    with ExitStack() as cleanup:
        told = _start(bench, faults, cleanup.enter_context(bench_folder(folder)), cleanup, tcp=tcp)
        sys.stdout.write(f"{json.dumps(told)}\n")
        sys.stdout.flush()
        return _wait(follow_stdin=follow_stdin)


def _start(bench: Bench, faults: Faults, folder: Path, cleanup: ExitStack, *, tcp: bool) -> dict[str, object]:
    """Open the ports, write the files, start to serve, and return what the starter wants to know."""
    rack = fill_rack(bench, faults, folder, cleanup, tcp=tcp)
    lines = FaultyLines(bench.twin, faults) if isinstance(bench.twin, TriggerLines) else None
    camera = CameraServer(bench.sensor, bench.axis, faults, exposure_ms=bench.spec.camera.exposure_ms, lines=lines)
    cleanup.callback(camera.close)
    control = Control(rack, bench.axis, faults)
    cleanup.callback(control.close)
    truth, instrument = folder / "truth.npz", folder / "instrument.toml"
    bench.specimen.save_truth(truth)
    ports = {"camera": camera.address, **{name: device.port for name, device in rack.items()}}
    instrument.write_text(instrument_text(bench, ports), encoding="utf-8")
    _in_threads(camera.serve, control.serve)
    return {
        "instrument": str(instrument),
        "ports": ports,
        "stage_pty": rack["z"].line.pty_path,
        "stage_tcp": rack["z"].line.tcp_url,
        "camera": camera.address,
        "control": control.address,
        "truth": str(truth),
        "pid": os.getpid(),
    }


def _in_threads(*serving: Callable[[], None]) -> None:
    for function in serving:
        Thread(target=function, daemon=True).start()


def _wait(*, follow_stdin: bool) -> int:
    """Wait for Ctrl-C or, if asked, for the end of standard input; SIGTERM leaves by an exception of its own."""
    ended = Event()
    if follow_stdin:
        Thread(target=_until_stdin_ends, args=[ended], daemon=True).start()
    try:
        ended.wait()
    except KeyboardInterrupt:
        return 0
    return 0


def _until_stdin_ends(ended: Event) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    ended.set()
