"""The command ``stereotome process focus``."""

from __future__ import annotations

import json as notation
import sys
from dataclasses import dataclass
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from acquire.progress import progress
from devices.clock import SystemClock
from processing.focus import FocusResult, Method, focus_stack
from processing.outputs import about_stack, check_folder, peak_memory_mb, write_focus_result
from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from devices.protocols import Clock

Registration = Literal["auto", "on", "off"]
REGISTER: dict[Registration, bool | Literal["auto"]] = {"auto": "auto", "on": True, "off": False}
Switch = Parameter(negative="")


def focus(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Method = "brightfield",
    step_um: float | None = None,
    channel: int | None = None,
    time: int = 0,
    register: Registration = "auto",
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Make the extended focus and the range image of a focal stack.

    Parameters
    ----------
    stack
        Run folder, OME-Zarr, TIFF, a folder of PNG, JPEG or TIFF images (or a quoted pattern of their names), NPY,
        NPZ or NIfTI.
    output
        Folder for images, previews and report.
    method
        brightfield: the sharpest plane of an opaque surface; confocal: the brightest one.
    step_um
        Distance of planes in µm; goes before what the file says.
    channel
        Channel, or series of images, to take when there are several; counted from 0.
    time
        Time point to take when there are several; counted from 0.
    register
        Whether to match the planes by shift and scale first; auto does it where they move.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_folder(output, overwrite=overwrite)
    opened = open_stack(stack, step_um=step_um, channel=channel, time=time)
    _say_notes([] if quiet else opened.notes)
    work = Work(opened, method, REGISTER[register], SystemClock())
    result, facts = work.measure(quiet=quiet)
    report = write_focus_result(result, output, pixel_um=opened.pixel_um, facts=facts, overwrite=overwrite)
    sys.stdout.write(notation.dumps(report, ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


@dataclass(frozen=True)
class Work:
    """A stack to be measured and how."""

    stack: Stack
    method: Method
    register: bool | Literal["auto"]
    clock: Clock

    def measure(self, *, quiet: bool) -> tuple[FocusResult, dict[str, Any]]:
        """Measure the stack and return what was found and what it took."""
        begin, count = self.clock.now(), len(self.stack)
        with progress("measuring focus", count, quiet=quiet) as show:
            result = focus_stack(
                self.stack,
                z_um=self.stack.z_um,
                method=self.method,
                register=self.register,
                progress=lambda share: show(round(share * count)),
            )
        took = {"seconds": round(self.clock.now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
        return result, {**about_stack(self.stack), **took}


def _say_notes(notes: Sequence[str]) -> None:
    for note in notes:
        sys.stderr.write(f"note: {note}\n")


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end: what was measured, then every file."""
    span, unit = report["range"], "µm" if report["unit"] == "um" else "planes"
    words = (
        f"range {span['p1']:.4g} … {span['p99']:.4g} {unit}, sure in {report['share_confident']:.0%} of the pixels; "
        f"noise {report['noise_grey_levels']:.2g} grey levels; {report['seconds']:.1f} s, "
        f"{report['peak_memory_mb']:.0f} MB at most"
    )
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
