"""The command ``stereotome process resample``."""

from __future__ import annotations

import json as notation
import shutil
import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.block_options import IN_MEMORY, WORK, Blocks
from processing.block_source import Source
from processing.outputs import about_stack, peak_memory_mb, versions, write_durably
from processing.pictures import png_bytes
from processing.resample import NAME, TITLE, CubicPlanes, choose_method, default_side, mean_step
from processing.result_folder import check_results, json_bytes
from processing.volume_files import (
    MiddleCuts,
    publish,
    pyramid,
    settle_volume,
    volume_names,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from processing.stack import Stack

    Show = Callable[[int], None]

    Array = NDArray[Any]

Switch = Parameter(negative="")
FILES = (*volume_names(NAME), "resampled.png", "report.json")
GAP = 1.5  # times the usual step


def resample(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Literal["auto", "nearest", "linear", "cubic", "bin"] = "auto",
    side_um: float | None = None,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    blocks: Blocks = IN_MEMORY,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Make the voxels of a stack cubic, and say how.

    Parameters
    ----------
    stack
        Run folder, OME-Zarr, TIFF, a folder of PNG, JPEG or TIFF images (or a quoted pattern of their names), NPY,
        NPZ or NIfTI; evenly spaced or not.
    output
        Folder for the volume, picture and report.
    method
        Interpolation along z: nearest, linear, cubic; bin: means of pixels, no plane is invented; auto: bin where the
        planes are more than 3 pixels apart, else linear.
    side_um
        Side of the voxels; that of a pixel, or when binning the step of the planes, when left out.
    pixel_um, step_um
        Size of a pixel and distance of planes; go before what the file says.
    channel
        Channel, or series of images, to take when there are several; counted from 0.
    time
        Time point to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_results(output, FILES, overwrite=overwrite)
    begin = SystemClock().now()
    source = Source(stack, step_um, channel, time)
    opened = source.stack
    planes, notes = cubic_planes(opened, method, side_um, pixel_um)
    shape = (*planes.shape, *opened.shape[2:])
    first_um = float(planes.z_um[0])
    layout = pyramid(FocalArray(len(planes), shape, str(opened.dtype), first_um, planes.side_um, planes.pixel_um))
    report = {
        "format": "stereotome-resample",
        "version": 1,
        **about_stack(opened),
        "notes": [*opened.notes, *notes],
        "method": planes.method,
        "side_um": planes.side_um,
        "pixel_um": planes.pixel_um,
        "voxels": [len(planes), *planes.shape],
    }
    image, made = None, (planes[k] for k in range(len(planes)))
    if blocks.wanted:
        from processing.resample_blocks import resampled_by_blocks  # noqa: PLC0415  dask takes a second

        size = pixel_um if pixel_um is not None else opened.pixel_um
        assert size is not None
        how = (source, size, planes, layout, blocks, output)
        image = resampled_by_blocks(*how, overwrite=overwrite, quiet=quiet)
        report["blocks"] = {"memory": blocks.memory}
    with progress("writing" if image else "resampling", len(planes), quiet=quiet) as show:
        publish(output, lambda part: write_all(part, image or made, layout, report, show, begin))
    shutil.rmtree(output / WORK, ignore_errors=True)
    for note in [] if quiet else report["notes"]:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(notation.dumps(report, ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


def cubic_planes(
    stack: Stack, method: str, side_um: float | None, pixel_um: float | None
) -> tuple[CubicPlanes, list[str]]:
    """Return the planes to be made, and in words how it was decided.

    Raises
    ------
    InputError
        ``resample-spacing``: sizes are unknown or make no sense.
    """
    pixel = pixel_um if pixel_um is not None else stack.pixel_um
    if stack.z_um is None or pixel is None or pixel <= 0:
        raise InputError(
            f"{stack.source} does not tell the size of its voxels.",
            fix="give what the file lacks: --step-um 1 --pixel-um 0.2",
            code="resample-spacing",
        )
    step = mean_step(stack.z_um)
    chosen, why = choose_method(step, pixel) if method == "auto" else (method, f"{method}, as asked for.")
    planes = CubicPlanes(stack, stack.z_um, pixel, side_um or default_side(chosen, step, pixel), chosen)  # type: ignore[arg-type]
    return planes, [why, *gaps(stack.z_um)]


def gaps(z_um: NDArray[np.float64]) -> list[str]:
    """Tell of gaps between planes that are filled from both sides."""
    steps = np.abs(np.diff(z_um))
    wide = np.flatnonzero(steps > GAP * np.median(steps))
    return [f"between planes {k} and {k + 1} there are {steps[k]:g} µm: what lies there is invented." for k in wide]


def write_all(
    part: Path, made: Iterable[Array] | Path, layout: FocalArray, report: dict[str, Any], show: Show, begin: float
) -> None:
    """Write the volume, its picture, and the report; of an image that is there already, all but that."""
    cuts = MiddleCuts(layout.planned)

    def told(planes: Iterable[Array]) -> Iterator[Array]:
        for k, plane in enumerate(cuts.seen(planes)):
            yield plane
            show(k + 1)

    settle_volume(part, NAME, TITLE, layout, made, told)
    write_durably(part / "resampled.png", png_bytes(cuts.picture()))
    took = {"seconds": round(SystemClock().now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
    report |= {**took, "versions": versions(), "files": list(FILES)}
    write_durably(part / "report.json", json_bytes(report))


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    shape = "×".join(str(n) for n in report["voxels"])
    words = f"{shape} voxels of {report['side_um']:.4g} µm, {report['method']}; {report['seconds']:.1f} s"
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
