"""The commands ``stereotome process volume`` and ``stereotome process apply``: steps of a pipeline, taken on data."""

from __future__ import annotations

import json as notation
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import zarr
from cyclopts import Parameter

from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.block_options import IN_MEMORY, WORK, Blocks
from processing.outputs import peak_memory_mb, versions, write_durably
from processing.pictures import png_bytes
from processing.pipeline import Pipeline, Step
from processing.result_folder import check_results, json_bytes, plain
from processing.step_inputs import Choices, Given, open_layers, read_steps
from processing.step_outputs import files_of, summed_up, write_layers
from processing.table import Picture, Table
from processing.volume_files import cuts_picture, publish

if TYPE_CHECKING:
    from collections.abc import Callable

    Layers = dict[str, Any]

Switch = Parameter(negative="")
REPORT = "report.json"


def volume(
    operation: str,
    data: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    then: tuple[str, ...] = (),
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    bands: str = "",
    time: int | None = None,
    blocks: Blocks = IN_MEMORY,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Apply operators to a volume or a range image, one after the other.

    Parameters
    ----------
    operation
        An operator with its settings, ``filter.median:rule=6``, or a TOML file of ``[[step]]`` tables. All operators:
        stereotome process operators.
    data
        Run folder, OME-Zarr, TIFF, a folder of images, NPY, NPZ or NIfTI; or a range image: folder of process focus or
        process elevation, or a TIFF of floats.
    output
        Folder for volumes, maps, tables, pictures and report.
    then
        A further step; may be given several times.
    pixel_um, step_um
        Size of a pixel and distance of planes; go before what the file says.
    channel
        Channel, or series of images, to take when there are several; counted from 0.
    bands
        Channels for steps that take several, such as 0,1; counted from 0.
    time
        Time point to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    from_file = operation.endswith(".toml")
    further = tuple(Step.parse(words) for words in then)
    first = read_steps(Path(operation), ()) if from_file else read_steps(None, (operation,))
    choices = Choices(pixel_um, step_um, channel, time, channels_of(bands))
    task = Task(Pipeline((*first.steps, *further)), data, output, choices, overwrite=overwrite, quiet=quiet)
    report = task.do(blocks)
    sys.stdout.write(notation.dumps(plain(report), ensure_ascii=False) + "\n" if json else summary(report, output))
    return 0


def apply(
    source: Path,
    *words: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    steps: Path | None = None,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    overwrite: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Do as process volume does, with the data first and all steps after it.

    Parameters
    ----------
    source
        Data, as for process volume.
    words
        Steps in order, such as range.median:side_px=5 range.level; all of them: stereotome process operators.
    output
        Folder for what the steps make, pictures and report.
    steps
        Steps in a TOML file instead: a table [[step]] for each, operator = "range.median" and its parameters.
    pixel_um, step_um
        Size of a pixel and distance of planes; go before what the file says.
    channel
        Channel, or series of images, of a stack; counted from 0.
    time
        Time point of a stack; counted from 0.
    overwrite
        Replace results that are in the folder.
    quiet
        Show no progress and no notes.
    """
    choices = Choices(pixel_um, step_um, channel, time)
    task = Task(read_steps(steps, words), source, output, choices, overwrite=overwrite, quiet=quiet)
    sys.stdout.write(summary(task.do(IN_MEMORY), output))
    return 0


def channels_of(words: str) -> tuple[int, ...]:
    """Read ``0,1``; raises `InputError` ``bands`` for anything but numbers."""
    parts = [part.strip() for part in words.split(",") if part.strip()]
    if not all(part.isdigit() for part in parts):
        raise InputError(f"{words!r} names no channels.", fix="numbers from 0: --bands 0,1", code="bands")
    return tuple(int(part) for part in parts)


@dataclass(frozen=True)
class Task:
    """Steps to be taken on data, and where the results go."""

    pipeline: Pipeline
    source: Path
    output: Path
    choices: Choices
    overwrite: bool
    quiet: bool

    def do(self, blocks: Blocks) -> dict[str, Any]:
        """Do it; returns the report."""
        check_results(self.output, files_of(self.pipeline), overwrite=self.overwrite)
        given = open_layers(self.source, self.choices)
        self.pipeline.check(given.names)
        clock = SystemClock()
        begin = clock.now()
        about, fill = self._by_blocks(given, blocks) if blocks.wanted else self._in_memory(given)
        report = {
            "format": "stereotome-steps",
            "version": 2,
            "input": self._input(given),
            "notes": list(given.notes),
            "steps": self.pipeline.tables(),
            "spacing_um": given.spacing_um if given.scaled else None,
            "pixel_um": given.about.get("pixel_um"),
            **about,
            "seconds": round(clock.now() - begin, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "versions": versions(),
        }

        def write(part: Path) -> None:
            report["files"] = [*fill(part), REPORT]
            write_durably(part / REPORT, json_bytes(report))

        publish(self.output, write)
        shutil.rmtree(self.output / WORK, ignore_errors=True)
        for note in () if self.quiet else given.notes:
            sys.stderr.write(f"note: {note}\n")
        return report

    def _input(self, given: Given) -> dict[str, Any]:
        shapes = {name: list(layer.shape) for name, layer in given.maps.items()}
        for name, stacks in given.stacks.items():
            shapes[name] = [*([len(stacks)] if name == "bands" else []), len(stacks[0]), *stacks[0].shape]
        return {"source": str(given.source), "shapes": shapes}

    def _in_memory(self, given: Given) -> tuple[dict[str, Any], Callable[[Path], list[str]]]:
        with progress("steps", len(self.pipeline.steps), quiet=self.quiet) as show:
            layers = given.read()
            made = {k: v for k, v in self.pipeline(layers, show).items() if v is not layers.get(k)}
        numbers, arrays = parted(made)
        spacing_um = made_spacing(made, given)
        z_um = np.ravel({**given.about, **made}.get("z_um", 0.0))
        about = {"results": {name: summed_up(value) for name, value in arrays.items()}, "values": numbers}
        return about, lambda part: write_layers(part, arrays, spacing_um, float(z_um[0]))

    def _by_blocks(self, given: Given, blocks: Blocks) -> tuple[dict[str, Any], Callable[[Path], list[str]]]:
        from processing.block_job import block_job  # noqa: PLC0415  dask takes a second

        with block_job(
            self.output, given, self.choices, self.pipeline, blocks, overwrite=self.overwrite, quiet=self.quiet
        ) as going:
            images = going.run(self.pipeline)
        plan = going.plan
        about: dict[str, Any] = {"blocks": {"planes": plan.side, "at_once": plan.workers, "memory": blocks.memory}}
        about["values"] = going.values
        about["results"] = {name: {"shape": going.shape, "dtype": going.types[name]} for name in images}
        return about, lambda part: move_images(part, images, given)


def parted(made: Layers) -> tuple[Layers, Layers]:
    """Return what is told in the report, and what is written as files."""
    files = {name: value for name, value in made.items() if isinstance(value, Table | Picture) or np.ndim(value) >= 2}
    return {name: value for name, value in made.items() if name not in files}, files


def made_spacing(made: Layers, given: Given) -> tuple[float, float, float] | None:
    """Return the spacing of volumes after the steps: those that change it say where planes and pixels lie then.

    None where it is not known.
    """
    if not given.scaled and "pixel_um" not in made:
        return None
    dz, dy, dx = given.spacing_um
    pixel = made.get("pixel_um")
    z_um = np.asarray(made.get("z_um", ()))
    step = float(np.abs(np.diff(z_um)).mean()) if z_um.size > 1 else dz
    return (step, dy, dx) if pixel is None else (step, float(pixel), float(pixel))


def move_images(part: Path, images: dict[str, Path], given: Given) -> list[str]:
    """Move images that were made block by block to where results go, each with a picture of its middle cuts."""
    dz, _, dx = given.spacing_um
    for name, image in images.items():
        image.replace(part / image.name)
        array: Any = zarr.open_array(part / image.name / "0", mode="r")
        _, _, planes, height, _ = array.shape
        middle = cuts_picture(np.asarray(array[0, 0, planes // 2]), np.asarray(array[0, 0, :, height // 2]), dz / dx)
        write_durably(part / f"{name}.png", png_bytes(middle))
    return sorted(path.name for path in part.iterdir())


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end: each result, then every file."""
    told = []
    for name, r in report["results"].items():
        size = f"{'×'.join(map(str, r['shape']))} {r['dtype']}" if "shape" in r else f"{r['rows']} rows"
        extent = f", {r['min']:.4g} … {r['max']:.4g}, mean {r['mean']:.4g}" if "mean" in r else ""
        told.append(f"{name}: {size}{extent}")
    told += [f"{name}: {value:.6g}" for name, value in report["values"].items() if np.ndim(value) == 0]
    return "\n".join([*told, *(str(folder / name) for name in report["files"])]) + "\n"
