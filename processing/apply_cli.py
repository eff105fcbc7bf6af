"""The command ``stereotome process apply``: steps of a pipeline on a range image or a stack."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tifffile
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.memory import check_memory
from processing.outputs import peak_memory_mb, tiff_bytes, versions, write_durably
from processing.pictures import png_bytes
from processing.pipeline import Pipeline, Step
from processing.readers import reading
from processing.relief_picture import range_picture, relief_picture
from processing.result_folder import check_results, json_bytes
from processing.stack import open_stack
from processing.volume_files import middle_cuts, publish, write_volume

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Layers = dict[str, Any]

Switch = Parameter(negative="")
RANGE_FILES = {"range": ("range.tif", "elevation.tif"), "confidence": ("confidence.tif",)}
FILES = ("range.tif", "volume.ome.tif", "report.json")
UM_PER_CM = 1e4
CENTIMETRE = 3  # of the TIFF tag ResolutionUnit


def apply(
    source: Path,
    *words: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    steps: Path | None = None,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int = 0,
    overwrite: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Take the steps of a pipeline on a range image or a stack.

    Parameters
    ----------
    source
        Folder of process focus or process elevation, a range image as float TIFF, or a stack as for process focus.
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
    check_results(output, FILES, overwrite=overwrite)
    pipeline = read_steps(steps, words)
    clock = SystemClock()
    begin = clock.now()
    layers, notes = read_layers(source, pixel_um, step_um, channel, time)
    with progress("steps", len(pipeline.steps), quiet=quiet) as show:
        made = pipeline(layers, show)
    changed = {name: value for name, value in made.items() if value is not layers.get(name)}
    report: dict[str, Any] = {
        "format": "stereotome-apply",
        "version": 1,
        "source": source,
        "notes": notes,
        "steps": pipeline.tables(),
        "pixel_um": made.get("pixel_um"),
        "values": {name: value for name, value in changed.items() if np.ndim(value) < 2},
        "seconds": round(clock.now() - begin, 3),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "versions": versions(),
    }
    publish(output, lambda part: write_layers(part, changed, made, report))
    for note in [] if quiet else notes:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write("\n".join(str(output / name) for name in report["files"]) + "\n")
    return 0


def read_steps(path: Path | None, words: tuple[str, ...]) -> Pipeline:
    """Return the steps of a file, or those of the command line.

    Raises
    ------
    InputError
        ``operator-params``: none at all, or both; ``input-missing``, ``input-damaged``.
    """
    if (path is None) == (not words):
        raise InputError(
            "steps are named on the command line or in a file.", fix="range.median:side_px=5", code="operator-params"
        )
    if path is None:
        return Pipeline(tuple(Step.parse(word) for word in words))
    if not path.is_file():
        raise InputError(f"there is no {path}.", fix="check the name.", code="input-missing")
    with reading(path):
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("step", [])
    return Pipeline.from_tables(tables)


def read_layers(
    source: Path, pixel_um: float | None, step_um: float | None, channel: int | None, time: int
) -> tuple[Layers, list[str]]:
    """Read a range image, or a stack, as layers; returns notes, too."""
    found = range_files(source)
    if "range" in found:
        layers: Layers = {name: read_map(path) for name, path in found.items()}
        shapes = {layer.shape for layer in layers.values()}
        if len(shapes) > 1:
            raise InputError(
                f"{source}: range and confidence differ in size.", fix="give those of one run", code="stack-shape"
            )
        pixel = pixel_um or tiff_pixel_um(found["range"])
        return layers | ({"pixel_um": pixel} if pixel else {}), []
    stack = open_stack(source, step_um=step_um, channel=channel, time=time)
    needed = 3.0 * len(stack) * int(np.prod(stack.shape)) * stack.dtype.itemsize
    check_memory(needed, f"{source} in memory", "bin it first: stereotome process resample")
    layers = {"volume": np.stack([stack[k] for k in range(len(stack))])}
    pixel = pixel_um or stack.pixel_um
    sizes: Layers = {"z_um": stack.z_um, "pixel_um": pixel}
    if stack.z_um is not None and pixel and len(stack) > 1:
        sizes["spacing_um"] = (float(np.abs(np.diff(stack.z_um)).mean()), pixel, pixel)
    return layers | {name: value for name, value in sizes.items() if value is not None}, list(stack.notes)


def range_files(source: Path) -> dict[str, Path]:
    """Return the files of a range image; none where ``source`` is a stack."""
    if source.is_dir():
        there = {name: [source / f for f in files if (source / f).is_file()] for name, files in RANGE_FILES.items()}
        return {name: files[0] for name, files in there.items() if files}
    if source.is_file() and source.suffix.lower() in {".tif", ".tiff"}:
        with reading(source), tifffile.TiffFile(source) as file:
            page: Any = file.pages.first
            if len(file.pages) == 1 and page.dtype.kind == "f" and len(page.shape) == 2:
                return {"range": source}
    return {}


def read_map(path: Path) -> NDArray[np.float32]:
    """Read a map; infinite values count as not known."""
    with reading(path):
        values = np.asarray(tifffile.imread(path), np.float32)
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def tiff_pixel_um(path: Path) -> float | None:
    """Return the size of a pixel that our TIFFs carry."""
    with reading(path), tifffile.TiffFile(path) as file:
        tags: Any = file.pages.first.tags
        if "XResolution" not in tags or int(tags["ResolutionUnit"].value) != CENTIMETRE:
            return None
        over, under = tags["XResolution"].value
        return UM_PER_CM * under / over if over else None


def write_layers(part: Path, changed: Layers, made: Layers, report: dict[str, Any]) -> None:
    """Write what the steps made: maps as TIFF and picture, volumes as OME-Zarr and OME-TIFF, all else in the report."""
    pixel = made.get("pixel_um")
    for name, value in changed.items():
        if np.ndim(value) == 2:
            write_map(part, name, np.asarray(value), pixel)
        elif np.ndim(value) >= 3:
            write_any_volume(part, name, np.asarray(value), made)
    if "range" in changed:
        write_durably(part / "relief.png", png_bytes(relief_picture(changed["range"], pixel)))
    report["files"] = [*sorted(path.name for path in part.iterdir()), "report.json"]
    write_durably(part / "report.json", json_bytes(report))


def write_map(part: Path, name: str, values: Array, pixel_um: float | None) -> None:
    """Write a map with its picture."""
    kept = np.where(values, np.uint8(255), np.uint8(0)) if values.dtype == np.bool_ else values
    write_durably(part / f"{name}.tif", tiff_bytes(kept, pixel_um, name))
    write_durably(part / f"{name}.png", png_bytes(range_picture(kept.astype(np.float32), name, pixel_um)))


def write_any_volume(part: Path, name: str, volume: Array, made: Layers) -> None:
    """Write a volume; other types than 8 and 16 bit as NPY."""
    if volume.dtype not in (np.uint8, np.uint16):
        np.save(part / f"{name}.npy", volume)
        return
    z_um = np.asarray(made.get("z_um", np.arange(volume.shape[0])), np.float64)
    step = float(z_um[-1] - z_um[0]) / max(1, z_um.size - 1)
    layout = FocalArray(
        volume.shape[0], volume.shape[1:], str(volume.dtype), float(z_um[0]), step, made.get("pixel_um")
    )
    write_volume(part, name, name, layout, volume)
    write_durably(part / f"{name}.png", png_bytes(middle_cuts(volume, 1.0)))
