"""The command ``stereotome measure``."""

from __future__ import annotations

import shutil
import sys
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing import circles, measure_network, measure_report
from processing.block_options import IN_MEMORY, WORK, Blocks, whole_needed
from processing.grey_volume import GreyVolume, open_volume, read_volume
from processing.measuring import Features, Measurement, Question, measure_features, told_apart, with_network
from processing.outputs import peak_memory_mb, versions, write_durably
from processing.picked import Picked, read_picked
from processing.pipeline import Pipeline, Step
from processing.planes import slabs
from processing.result_folder import check_results, csv_bytes, json_bytes
from processing.step_inputs import Choices
from processing.volume_files import publish, volume_names, write_volume

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from processing.planes import Planes

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
    skeleton: Annotated[bool, Switch] = False,
    points: Path | None = None,
    scale: Scale = Scale(),
    blocks: Blocks = IN_MEMORY,
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
    skeleton
        Thin the features to lines: nodes, branches, loops, and a table of the branches.
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
    task = Task(data, output, question, scale, first, grey, balls, skeleton, points, overwrite, quiet)
    report, found = task.do(blocks)
    for note in () if quiet else report["notes"]:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(json_bytes(report).decode() if json else summary(found, report, output))
    return 0


@dataclass(frozen=True)
class Task:
    """Data to be measured, and where the results go."""

    data: Path
    output: Path
    question: Question
    scale: Scale
    first: tuple[str, ...]
    grey: Path | None
    balls: bool
    skeleton: bool
    points: Path | None
    overwrite: bool
    quiet: bool

    @property
    def files(self) -> list[str]:
        """Names of what is written."""
        asked = ((self.balls, circles.FILES), (self.skeleton, measure_network.FILES), (self.points, PICKED_FILES))
        more = [name for wanted, names in asked if wanted for name in names]
        return [*files_of(self.question), *more, "report.json", PAGE]

    @property
    def steps(self) -> Pipeline:
        """Steps before the threshold."""
        return Pipeline(tuple(Step.parse(words) for words in self.first))

    def do(self, blocks: Blocks) -> tuple[dict[str, Any], Measurement]:
        """Do it; returns the report and what was found."""
        if self.question.smallest < 1:
            raise InputError("a feature has one voxel at least.", fix="--smallest 1", code="operator-params")
        check_results(self.output, self.files, overwrite=self.overwrite)
        begin = SystemClock().now()
        side = slab_side(self.data, self.scale, blocks) if blocks.wanted else None
        stored = self._read(self.data, side)
        seen = stored if self.grey is None else beside(self._read(self.grey, side), stored)
        lines = read_picked(self.points, stored.values.shape) if self.points else []
        told_apart = self._by_blocks(stored, blocks) if blocks.wanted else nullcontext(self._in_memory(stored))
        with told_apart as given:
            with progress("measuring", 3 * len(stored.values), quiet=self.quiet) as tell:
                bright = None if self.question.labels and self.grey is None else seen.values
                found = measure_features(given, self.question, seen=bright, told=tell)
            found = with_network(found, stored) if self.skeleton else found
            more = picked_files(lines, seen.values, stored) if lines else {}
            if found.network is not None:
                more |= measure_report.network_files(found.network, scaled=stored.spacing_um is not None)
            if self.balls:
                more |= circles.files(circles.ball_sizes(found.labels, stored.spacing), stored.unit)
            report = {
                **self._report(given, found, (*stored.notes, *found.notes)),
                "blocks": {"planes": side, "memory": blocks.memory} if side else None,
                "seconds": round(SystemClock().now() - begin, 3),
                "peak_memory_mb": round(peak_memory_mb(), 1),
                "versions": versions(),
                "files": self.files,
            }
            publish(self.output, lambda part: write_all(part, found, given.volume, seen.values, report, more))
        shutil.rmtree(self.output / WORK, ignore_errors=True)
        return report, found

    def _read(self, path: Path, side: int | None) -> GreyVolume:
        scale = asdict(self.scale)
        return read_volume(path, **scale, quiet=self.quiet) if side is None else open_volume(path, **scale, side=side)

    def _in_memory(self, stored: GreyVolume) -> Features:
        return told_apart(prepared(stored, self.steps), self.question)

    def _by_blocks(self, stored: GreyVolume, blocks: Blocks) -> AbstractContextManager[Features]:
        from processing.measure_blocks import by_blocks  # noqa: PLC0415  dask takes a second

        if self.skeleton:
            raise whole_needed("--skeleton")
        return by_blocks(
            stored,
            self.question,
            Choices(**asdict(self.scale)),
            self.steps,
            blocks,
            self.output,
            overwrite=self.overwrite,
            quiet=self.quiet,
        )

    def _report(self, given: Features, found: Measurement, said: tuple[str, ...]) -> dict[str, Any]:
        question = {
            **asdict(self.question),
            "threshold_taken": found.threshold,
            "first": [*self.first],
            "grey": self.grey and str(self.grey),
        }
        return {
            "format": "stereotome-measure",
            "version": 1,
            "input": about(given.volume),
            "question": question,
            "notes": said,
            "numbers": {name: asdict(number) for name, number in found.numbers.items()},
            "features": len(found.table["feature"]),
        }


def slab_side(data: Path, scale: Scale, blocks: Blocks) -> int:
    """Return how many planes are measured at once."""
    from processing.measure_blocks import planes_at_once  # noqa: PLC0415  dask takes a second

    return planes_at_once(open_volume(data, **asdict(scale)).values.shape, blocks.memory)


def files_of(question: Question) -> list[str]:
    """Return the names of what is written."""
    grey = () if question.labels else measure_report.GREY_PICTURES
    return [*measure_report.TABLES, *volume_names("labels"), *measure_report.PICTURES, *grey]


def beside(grey: GreyVolume, stored: GreyVolume) -> GreyVolume:
    """Return grey values that are as large as the volume; raises `InputError` ``volume-shape`` where they are not."""
    if grey.values.shape != stored.values.shape:
        raise InputError(
            f"{grey.source} has {grey.values.shape} voxels, {stored.source} has {stored.values.shape}.",
            fix="give grey values of the same size: --grey FILE",
            code="volume-shape",
        )
    return grey


def prepared(stored: GreyVolume, first: Pipeline) -> GreyVolume:
    """Take steps on a volume in memory."""
    if not first.steps:
        return stored
    layers = first({"volume": stored.values, "spacing_um": stored.spacing})
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


def picked_files(lines: list[Picked], grey: Planes, volume: GreyVolume) -> dict[str, bytes]:
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
    seen: Planes,
    report: dict[str, Any],
    more: dict[str, bytes],
) -> None:
    """Write labels, tables, pictures, the page and the report."""
    dtype = np.dtype(np.uint16 if int(found.table["feature"].max()) <= SIXTEEN_BIT else np.uint32)
    pixel_um = volume.spacing_um and volume.spacing_um[1]
    shape = found.labels.shape
    layout = FocalArray(shape[0], shape[1:], str(dtype), volume.start_um, volume.spacing[0], pixel_um)
    planes = (plane.astype(dtype, copy=False) for _, slab in slabs(found.labels) for plane in slab)
    write_volume(part, "labels", "labels", layout, planes)
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
