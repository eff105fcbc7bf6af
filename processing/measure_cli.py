"""The command ``stereotome measure``."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing import circles, measure_report
from processing.grey_volume import GreyVolume, read_volume
from processing.measuring import Measurement, Question, measure_volume
from processing.outputs import peak_memory_mb, versions, write_durably
from processing.picked import Picked, read_picked
from processing.pipeline import Pipeline, Step
from processing.result_folder import check_results, csv_bytes, json_bytes
from processing.volume_files import publish, volume_names, write_volume

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

Switch = Parameter(negative="")
SIXTEEN_BIT = 65535
PAGE = "report.html"
PICKED_FILES = ("picked.csv", "profiles.csv")


@Parameter(name="*")
@dataclass(frozen=True)
class Scale:
    """What the file does not say, or says wrongly."""

    pixel_um: float | None = None
    "Size of a pixel; goes before what the file says."
    step_um: float | None = None
    "Distance of planes; goes before what the file says."
    channel: int | None = None
    "Channel to take when there are several; counted from 0."
    time: int | None = None
    "Time point to take when there are several; counted from 0."


def measure(
    data: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    threshold: str = "otsu",
    dark: Annotated[bool, Switch] = False,
    neighbours: Literal[6, 18, 26] = 26,
    first: tuple[str, ...] = (),
    fill: Annotated[bool, Switch] = False,
    smallest: int = 1,
    labels: Annotated[bool, Switch] = False,
    grey: Path | None = None,
    balls: Annotated[bool, Switch] = False,
    points: Path | None = None,
    scale: Scale = Scale(),
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Measure the features of a volume, and the volume as a whole.

    Parameters
    ----------
    data
        Run folder, OME-Zarr, TIFF, a folder of images, NPY, NPZ or NIfTI.
    output
        Folder for tables, labels, pictures and the report.
    threshold
        Inside is what is greater: a number, or how it is found: otsu, li, yen, isodata, minimum, triangle, mean.
    dark
        Inside is what is not greater.
    neighbours
        Voxels that share a face (6), an edge too (18), a corner too (26) belong together.
    first
        A step before the threshold, such as filter.median:rule=6; may be given several times.
    fill
        Fill holes.
    smallest
        Leave out features of fewer voxels.
    labels
        The data are numbers of features, 0 for none.
    grey
        Grey values whose densities are measured, where the data are others.
    balls
        Find the sizes of balls from the circles of the planes, beside those measured directly.
    points
        Table (CSV) of picked points, name,z,y,x in voxels: lengths and angles along those of one name, and profiles.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    question = Question(threshold, dark, neighbours, fill, smallest, labels)
    files = [*files_of(question), *(circles.FILES if balls else ()), *(PICKED_FILES if points else ())]
    check_results(output, [*files, "report.json", PAGE], overwrite=overwrite)
    begin = SystemClock().now()
    stored = read_volume(data, **asdict(scale), quiet=quiet)
    seen = stored.values if grey is None else _beside(read_volume(grey, **asdict(scale), quiet=quiet), stored)
    lines = read_picked(points, stored.values.shape) if points else []
    volume = _prepared(stored, first)
    with progress("measuring", 2 * len(volume.values), quiet=quiet) as tell:
        beside = None if labels and grey is None else seen
        found = measure_volume(volume, question, seen=beside, told=tell)
    more = picked_files(lines, seen, stored) if lines else {}
    if balls:
        more |= circles.files(circles.ball_sizes(found.labels, stored.spacing), stored.unit)
    said = (*stored.notes, *found.notes)
    report = {
        "format": "stereotome-measure",
        "version": 1,
        "input": about(stored),
        "question": {
            **asdict(question),
            "threshold_taken": found.threshold,
            "first": [*first],
            "grey": grey and str(grey),
        },
        "notes": said,
        "numbers": {name: asdict(number) for name, number in found.numbers.items()},
        "features": len(found.table["feature"]),
        "seconds": round(SystemClock().now() - begin, 3),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "versions": versions(),
        "files": [*files, "report.json", PAGE],
    }
    publish(output, lambda part: write_all(part, found, volume, seen, report, more))
    for note in () if quiet else said:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(json_bytes(report).decode() if json else summary(found, report, output))
    return 0


def files_of(question: Question) -> list[str]:
    """Return the names of what is written."""
    grey = () if question.labels else measure_report.GREY_PICTURES
    return [*measure_report.TABLES, *volume_names("labels"), *measure_report.PICTURES, *grey]


def _beside(grey: GreyVolume, stored: GreyVolume) -> Array:
    if grey.values.shape != stored.values.shape:
        raise InputError(
            f"{grey.source} has {grey.values.shape} voxels, {stored.source} has {stored.values.shape}.",
            fix="give grey values of the same size: --grey FILE",
            code="volume-shape",
        )
    return grey.values


def _prepared(stored: GreyVolume, first: tuple[str, ...]) -> GreyVolume:
    if not first:
        return stored
    pipeline = Pipeline(tuple(Step.parse(words) for words in first))
    layers = pipeline({"volume": stored.values, "spacing_um": stored.spacing})
    if layers["volume"].shape != stored.values.shape:
        raise InputError(
            "a step changes the size of the volume.",
            fix="do that before: stereotome process volume",
            code="operator-params",
        )
    return replace(stored, values=layers["volume"])


def about(volume: GreyVolume) -> dict[str, Any]:
    """Describe the input for the report."""
    return {
        "source": volume.source,
        "shape": list(volume.values.shape),
        "dtype": str(volume.values.dtype),
        "spacing_um": volume.spacing_um and list(volume.spacing_um),
        "first_plane_um": volume.start_um,
    }


def picked_files(lines: list[Picked], grey: Array, volume: GreyVolume) -> dict[str, bytes]:
    """Encode lengths and angles, and the profiles along the lines."""
    unit = "um" if volume.spacing_um else "voxels"
    measured, profiles = [], []
    for line in lines:
        angles = ";".join(f"{angle:.4g}" for angle in line.angles_deg(volume.spacing))
        measured.append([line.name, len(line.points), line.length_um(volume.spacing), angles])
        at, values = line.profile(grey, volume.spacing)
        profiles += [[line.name, float(a), float(v)] for a, v in zip(at, values, strict=True)]
    return {
        "picked.csv": csv_bytes(["name", "points", f"length_{unit}", "angles_deg"], measured),
        "profiles.csv": csv_bytes(["name", f"at_{unit}", "value"], profiles),
    }


def write_all(
    part: Path,
    found: Measurement,
    volume: GreyVolume,
    seen: Array,
    report: dict[str, Any],
    more: dict[str, bytes],
) -> None:
    """Write labels, tables, pictures, the page and the report."""
    few = int(found.labels.max()) <= SIXTEEN_BIT
    labels = found.labels.astype(np.uint16 if few else np.uint32, copy=False)
    pixel_um = volume.spacing_um and volume.spacing_um[1]
    layout = FocalArray(len(labels), labels.shape[1:], str(labels.dtype), volume.start_um, volume.spacing[0], pixel_um)
    write_volume(part, "labels", "labels", layout, iter(labels))
    shown = measure_report.pictures(found, volume, seen)
    for name, content in (measure_report.tables(found) | shown | more).items():
        write_durably(part / name, content)
    write_durably(part / PAGE, measure_report.page(found, report, shown | more))
    write_durably(part / "report.json", json_bytes(report))


def summary(found: Measurement, report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end: the numbers, then every file."""
    told = []
    for name, number in found.numbers.items():
        words, unit = measure_report.split_unit(name)
        error = "" if number.error is None else f" ± {number.error:.2g}"
        told.append(f"{words}: {number.value:.6g}{error} {unit}".rstrip())
    return "\n".join([*told, *(str(folder / name) for name in report["files"])]) + "\n"
