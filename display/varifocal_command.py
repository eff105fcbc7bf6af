"""The command ``stereotome varifocal``: which plane is shown when, before a mirror that moves."""

from __future__ import annotations

import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from devices.errors import InputError
from display.render import check_output
from display.varifocal import Mirror, Sweep, even_planes
from processing.outputs import write_durably
from processing.pictures import png_bytes
from processing.result_folder import csv_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray


def varifocal(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    planes: int = 20,
    reach_um: float = 100.0,
    mirror_hz: float = 30.0,
    frames_hz: float = 2880.0,
    waveform: Literal["sine", "triangle", "sawtooth"] = "sine",
    lag: float = 0.0,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Plan a volume of planes before a varifocal mirror: a picture, and a table (CSV) beside it.

    Parameters
    ----------
    output
        PNG to write.
    planes
        How many, evenly spaced over nine tenths of the reach.
    reach_um
        Depth of the picture either way from the middle.
    mirror_hz
        Periods of the mirror a second.
    frames_hz
        Frames of the display a second.
    waveform
        How the mirror moves.
    lag
        How much later than its sync pulse it is there, as a share of a period.
    overwrite
        Replace files that are there.
    """
    check_output(output, overwrite=overwrite)
    if planes < 1 or not frames_hz > 0:
        raise InputError("a sweep needs a plane and a display that shows frames.", code="usage")
    mirror = Mirror(mirror_hz, reach_um, waveform, lag)
    sweep = Sweep(mirror, even_planes(planes, mirror), 1 / frames_hz)
    phases, numbers = sweep.timetable
    blur = sweep.blur_um
    rows = zip(phases / mirror_hz * 1e3, numbers, sweep.depths_um[numbers], blur[numbers], strict=True)
    write_durably(output, png_bytes(_drawn(sweep)))
    write_durably(output.with_suffix(".csv"), csv_bytes(("time_ms", "plane", "depth_um", "blur_um"), rows))
    apart_um = np.ptp(sweep.depths_um) / max(planes - 1, 1)
    sys.stdout.write(
        f"{mirror.volumes_hz:g} volumes a second, {planes} planes {apart_um:.3g} µm apart; "
        f"each moves by {blur.min():.3g} … {blur.max():.3g} µm while it is lit\n{output}\n"
    )
    return 0


def _drawn(sweep: Sweep) -> NDArray[np.uint8]:
    figure = Figure(figsize=(9, 4.5), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    phase = np.linspace(0, 1, 500)
    period_ms = 1e3 / sweep.mirror.hz
    axes.plot(phase * period_ms, sweep.mirror.depth_um(phase), color="0.7")
    phases, numbers = sweep.timetable
    half_ms = sweep.frame_s * 1e3 / 2
    depths = sweep.depths_um[numbers]
    axes.hlines(depths, phases * period_ms - half_ms, phases * period_ms + half_ms, color="C3", linewidth=2)
    axes.set_xlabel("after the sync pulse, ms")
    axes.set_ylabel("depth, µm")
    axes.set_title(
        f"{len(sweep.depths_um)} planes, {sweep.mirror.waveform} at {sweep.mirror.hz:g} Hz: "
        f"{sweep.mirror.volumes_hz:g} volumes a second; red: lit for {sweep.frame_s * 1e3:.3g} ms",
        fontsize=10,
    )
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()
