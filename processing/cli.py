"""The command ``stereotome process focus``."""

from __future__ import annotations

import json as notation
import shutil
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from acquire.progress import progress
from acquire.words import spanned
from devices.clock import SystemClock
from devices.errors import InputError
from processing.block_options import IN_MEMORY, WORK, Blocks, whole_needed
from processing.block_source import Source
from processing.focus import SHARPNESS, FocusResult, focus_stack
from processing.focus_tracks import Method, Options  # noqa: TC001  as above
from processing.focus_view import View, ViewedPlanes
from processing.memory import check_memory
from processing.outputs import about_stack, check_folder, peak_memory_mb, write_focus_result
from processing.range_operators import fill as fill_range

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from devices.protocols import Clock
    from processing.focus_blocks import InPieces
    from processing.registration import Planes
    from processing.stack import Stack

    Array = NDArray[Any]

Registration = Literal["auto", "on", "off"]
REGISTER: dict[Registration, bool | Literal["auto"]] = {"auto": "auto", "on": True, "off": False}
BANDS = ("red", "green", "blue")
Switch = Parameter(negative="")
BYTES_PER_PIXEL, BYTES_PER_BAND = 50, 20  # measured, the soft pyramid of transparent specimens included
HARDLY_SURE = 0.02  # share of the pixels


def focus(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Method = "brightfield",
    threshold: float | None = None,
    band: Literal["red", "green", "blue"] | None = None,
    azimuth_deg: float = 0.0,
    tilt_deg: float = 0.0,
    fill: Annotated[bool, Switch] = False,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    register: Registration = "auto",
    blocks: Blocks = IN_MEMORY,
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
        brightfield: the sharpest plane of an opaque surface; transparent: the same for specimens that are seen
        through, each detail from where it is sharp; confocal: the brightest plane; threshold: the first bright enough.
    threshold
        Grey level from which a pixel is bright enough, for the method threshold.
    band
        The band of colour planes that decides; all of them together when left out.
    azimuth_deg, tilt_deg
        Look at the volume from the side, for the methods confocal and threshold: the line of sight leans by the tilt
        from the z axis, towards the azimuth (0 right, 90 down).
    fill
        Fill the range from what is sure around, where it is not sure itself, and mark it in filled.tif.
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
    source = Source(stack, step_um, channel, time)
    opened = source.stack
    _say_notes([] if quiet else opened.notes)
    view = View(azimuth_deg, tilt_deg) if azimuth_deg or tilt_deg else None
    options: Options = {"method": method, "threshold": threshold, "band": None if band is None else BANDS.index(band)}
    work = Work(opened, options, view, REGISTER[register], SystemClock())
    found: InMemory | InPieces
    if blocks.wanted:
        check_local(view, fill=fill)
        found, facts = work.by_blocks(source, blocks, output, overwrite=overwrite, quiet=quiet)
    else:
        check_memory(needed_bytes(opened), f"the focus of {opened.source}", "go tile by tile: --memory 2GB")
        found, facts = work.measure(quiet=quiet)
    result = found.shown
    doubts = [
        words
        for words in (doubtful(result.share_confident, len(opened)), blank(result.parameters["blank_planes"]))
        if words
    ]
    _say_notes([] if quiet else doubts)
    facts["notes"] += doubts
    found = InMemory(filled(result)) if fill else found
    check_folder(output, overwrite=overwrite)
    report = found.write(output, pixel_um=opened.pixel_um, facts=facts)
    shutil.rmtree(output / WORK, ignore_errors=True)
    sys.stdout.write(notation.dumps(report, ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


def check_local(view: View | None, *, fill: bool) -> None:
    """Raise `InputError` ``blockwise`` for what looks at the whole and cannot go tile by tile."""
    if view is not None:
        raise whole_needed("a view from the side")
    if fill:
        raise whole_needed("--fill")


@dataclass(frozen=True)
class InMemory:
    """What was found, as a whole."""

    shown: FocusResult

    def write(self, folder: Path, *, pixel_um: float | None, facts: dict[str, Any]) -> dict[str, Any]:
        """Write it; returns the report."""
        return write_focus_result(self.shown, folder, pixel_um=pixel_um, facts=facts, overwrite=True)


@dataclass(frozen=True)
class Work:
    """A stack to be measured and how."""

    stack: Stack
    options: Options
    view: View | None
    register: bool | Literal["auto"]
    clock: Clock

    def measure(self, *, quiet: bool) -> tuple[InMemory, dict[str, Any]]:
        """Measure the stack and return what was found and what it took."""
        begin = self.clock.now()
        planes, z_um, options = self._seen()
        with progress("measuring focus", len(planes), quiet=quiet) as show:
            result = focus_stack(
                planes,
                z_um=z_um,
                register=self.register,
                progress=lambda share: show(round(share * len(planes))),
                **options,
            )
        return InMemory(result), self._facts(begin)

    def by_blocks(
        self, source: Source, blocks: Blocks, output: Path, *, overwrite: bool, quiet: bool
    ) -> tuple[InPieces, dict[str, Any]]:
        """Measure the stack tile by tile."""
        from processing.focus_blocks import focus_by_blocks  # noqa: PLC0415  dask takes a second

        begin, per_pixel = self.clock.now(), bytes_per_pixel(self.stack)
        how = (source, self.options, self.register, per_pixel, blocks, output)
        found = focus_by_blocks(*how, overwrite=overwrite, quiet=quiet)
        told = {"memory": blocks.memory, "tile_px": found.ranges.side, "halo_px": found.ranges.halo[0]}
        return found, {**self._facts(begin), "blocks": told}

    def _facts(self, begin: float) -> dict[str, Any]:
        took = {"seconds": round(self.clock.now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
        seen = None if self.view is None else asdict(self.view)
        return {**about_stack(self.stack), "view": seen, **took}

    def _seen(self) -> tuple[Planes, Array | None, Options]:
        """Return the planes to be measured, their positions, and how."""
        stack = self.stack
        if self.view is None:
            return stack, stack.z_um, self.options
        if self.options["method"] in SHARPNESS:
            raise InputError(
                "sharpness cannot be measured from the side: planes are taken, and sharp, along z.",
                fix="--method confocal, or --method threshold --threshold T",
                code="focus-view",
            )
        planes = ViewedPlanes(stack, stack.z_um, stack.pixel_um, self.view, band=self.options["band"])
        return planes, None if stack.z_um is None else planes.depth, {**self.options, "band": None}


def needed_bytes(stack: Stack) -> float:
    """Return about what the state, the maps and the picture of a stack take at most, whatever its number of planes."""
    return float(stack.shape[0] * stack.shape[1]) * bytes_per_pixel(stack)


def bytes_per_pixel(stack: Stack) -> float:
    """Return about what measuring one pixel takes."""
    return float(BYTES_PER_PIXEL + BYTES_PER_BAND * (3 if stack.colour else 1))


def doubtful(share_confident: float, planes: int) -> str:
    """Return what to say when a range is hardly sure anywhere; empty otherwise."""
    if planes == 1 or share_confident >= HARDLY_SURE:
        return ""
    return (
        f"the range is sure in {share_confident:.1%} of the pixels only: the planes show nothing, are saturated, all "
        "alike, or not of one field; see confidence.png."
    )


def blank(planes: Sequence[int]) -> str:
    """Return what to say of planes that are one grey value everywhere; empty when there are none."""
    return f"nothing is to be seen in planes {', '.join(map(str, planes))}: lost, or dark." if planes else ""


def filled(result: FocusResult) -> FocusResult:
    """Return the result with what is not sure filled from around, and marked."""
    range_, where = fill_range(result.range, result.confidence)
    return replace(result, range=range_, filled=where)


def _say_notes(notes: Sequence[str]) -> None:
    for note in notes:
        sys.stderr.write(f"note: {note}\n")


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end: what was measured, then every file."""
    span, unit = report["range"], "µm" if report["unit"] == "um" else "planes"
    reached = "no range" if span["p1"] is None else f"range {spanned(span['p1'], span['p99'])} {unit}"
    words = (
        f"{reached}, sure in {report['share_confident']:.0%} of the pixels; "
        f"noise {report['noise_grey_levels']:.2g} grey levels; {report['seconds']:.1f} s, "
        f"{report['peak_memory_mb']:.0f} MB at most"
    )
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
