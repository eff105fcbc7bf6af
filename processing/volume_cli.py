"""The command ``stereotome process volume``."""

from __future__ import annotations

import json as notation
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.deblur_cli import read_volume
from processing.neighbours import neighbours
from processing.outputs import about_stack, peak_memory_mb, versions, write_durably
from processing.pictures import png_bytes
from processing.pipeline import Pipeline, Step
from processing.resample import mean_step
from processing.result_folder import check_results, json_bytes, plain
from processing.stack import Stack, open_stack
from processing.volume_files import middle_cuts, publish, volume_names, write_volume

if TYPE_CHECKING:
    from processing.neighbours import Spacing

Switch = Parameter(negative="")


def volume(
    operation: str,
    data: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    then: tuple[str, ...] = (),
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int = 0,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Apply operators to a volume, one after the other.

    Parameters
    ----------
    operation
        An operator with its settings, ``filter.median:rule=6``, or a TOML file of ``[[step]]`` tables. All operators:
        stereotome process operators.
    data
        Run folder, OME-Zarr, TIFF, a folder of images, NPY, NPZ or NIfTI.
    output
        Folder for volumes, pictures and report.
    then
        A further step; may be given several times.
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
    pipeline = steps_of(operation, then)
    made = volumes_made(pipeline)
    files = [name for layer in made for name in (*volume_names(layer), f"{layer}.png")]
    check_results(output, [*files, "report.json"], overwrite=overwrite)
    stack = open_stack(data, step_um=step_um, channel=channel, time=time)
    spacing_um, notes = spacing_of(stack, pixel_um)
    begin = SystemClock().now()
    with progress("processing", len(pipeline.steps), quiet=quiet) as show:
        layers = pipeline({"volume": read_volume(stack), "spacing_um": spacing_um}, show)
    report = {
        "format": "stereotome-volume",
        "version": 1,
        **about_stack(stack),
        "steps": pipeline.tables(),
        "spacing_um": spacing_um,
        "notes": [*stack.notes, *notes],
        "results": {name: summed_up(layers[name]) for name in made},
        "values": {name: layers[name] for name in values_made(pipeline)},
        "seconds": round(SystemClock().now() - begin, 3),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "versions": versions(),
        "files": [*files, "report.json"],
    }
    publish(output, lambda part: write_all(part, {name: layers[name] for name in made}, stack, spacing_um, report))
    for note in [] if quiet else report["notes"]:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(notation.dumps(plain(report), ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


def steps_of(operation: str, then: tuple[str, ...]) -> Pipeline:
    """Return the steps of a command line, or of a file and a command line; raises `InputError` for unknown ones."""
    further = tuple(Step.parse(words) for words in then)
    if not operation.endswith(".toml"):
        return _checked(Pipeline((Step.parse(operation), *further)))
    try:
        tables = tomllib.loads(Path(operation).read_text(encoding="utf-8")).get("step", [])
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(
            f"{operation} cannot be read: {error}.", fix="check the file.", code="operator-params"
        ) from None
    return _checked(Pipeline((*Pipeline.from_tables(tables).steps, *further)))


def _checked(pipeline: Pipeline) -> Pipeline:
    if not pipeline.steps:
        raise InputError(
            "there is no step.", fix='write [[step]] with operator = "family.name"', code="operator-params"
        )
    pipeline.check(["volume", "spacing_um"])
    return pipeline


def volumes_made(pipeline: Pipeline) -> list[str]:
    """Return the layers of the volume's shape that the steps make, in order."""
    made = [layer.name for step in pipeline.steps for layer in step.operator.gives if layer.shape == "volume"]
    return list(dict.fromkeys(made))


def values_made(pipeline: Pipeline) -> list[str]:
    """Return the layers that are single numbers, such as a threshold that was found, in order."""
    made = [layer.name for step in pipeline.steps for layer in step.operator.gives if not layer.shape and layer.dtype]
    return list(dict.fromkeys(made))


def spacing_of(stack: Stack, pixel_um: float | None) -> tuple[Spacing, list[str]]:
    """Return (dz, dy, dx) in µm, in voxels where it is not known, and what the user is told about it."""
    pixel = pixel_um if pixel_um is not None else stack.pixel_um
    if stack.z_um is None or pixel is None or len(stack) < 2:
        return (1.0, 1.0, 1.0), ["the size of the voxels is not known: lengths are in voxels, which count as cubes."]
    spacing = (mean_step(stack.z_um), pixel, pixel)
    note = neighbours(26, spacing).note
    return spacing, [note] if note else []


def summed_up(result: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Describe a result for the report."""
    return {
        "shape": list(result.shape),
        "dtype": str(result.dtype),
        "min": float(result.min()),
        "mean": float(result.mean(dtype=np.float64)),
        "max": float(result.max()),
    }


def write_all(
    part: Path,
    results: dict[str, np.ndarray[Any, Any]],
    stack: Stack,
    spacing_um: Spacing,
    report: dict[str, Any],
) -> None:
    """Write every result with a picture of its middle cuts, and the report."""
    dz, _, dx = spacing_um
    start_um = 0.0 if stack.z_um is None else float(stack.z_um[0])
    for name, result in results.items():
        layout = FocalArray(len(result), result.shape[1:], str(result.dtype), start_um, dz, dx)
        write_volume(part, name, name, layout, iter(result))
        write_durably(part / f"{name}.png", png_bytes(middle_cuts(result, dz / dx)))
    write_durably(part / "report.json", json_bytes(report))


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end: each result, then every file."""
    told = [
        f"{name}: {'×'.join(map(str, r['shape']))} {r['dtype']}, {r['min']:.4g} … {r['max']:.4g}, mean {r['mean']:.4g}"
        for name, r in report["results"].items()
    ]
    told += [f"{name}: {value:.6g}" for name, value in report["values"].items()]
    return "\n".join([*told, *(str(folder / name) for name in report["files"])]) + "\n"
