"""The command ``stereotome process register``: a volume put on another one."""

from __future__ import annotations

import csv
import json as notation
import os
import sys
from io import BytesIO
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tifffile
from cyclopts import Parameter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.align_pair import grey
from processing.outputs import about_stack, peak_memory_mb, versions
from processing.pictures import png_bytes
from processing.readers import reading
from processing.result_folder import check_results, json_bytes, plain, write_results
from processing.stack import Stack, open_stack
from processing.volume_registration import (
    Method3,
    Model3,
    Registration,
    Volume,
    from_marks,
    from_pictures,
    judged,
    no_match,
    resampled,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

FILES = ("registered.tif", "transform.json", "overlay.png", "report.json")
COLUMNS = ("volume", "mark", "x_um", "y_um", "z_um")
CONVENTION = (
    "matrix leads from (x, y, z, 1) in µm of the fixed volume to µm of the moving one, from first voxels' middles"
)
COPIES = 6  # float32 copies of both volumes that are held at once
Switch = Parameter(negative="")


def register(
    fixed: Path,
    moving: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Method3 = "mutual-information",
    model: Model3 = "rigid",
    fiducials: Path | None = None,
    fixed_um: tuple[float, float] | None = None,
    moving_um: tuple[float, float] | None = None,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Put a volume on another one of the same specimen, whatever their voxels and modalities.

    Parameters
    ----------
    fixed
        The volume that stays.
    moving
        The volume that is resampled onto it.
    output
        Folder for the resampled volume, transform, picture and report.
    method
        mutual-information: any contrasts that go with the material; correlation: contrasts of one kind.
    model
        Maps allowed: translation, rigid, similarity, affine.
    fiducials
        CSV file with columns volume (fixed or moving), mark, x_um, y_um, z_um; the pictures only judge the result.
    fixed_um, moving_um
        Voxel size along z and across, in µm, where the file says none or a wrong one.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_results(output, FILES, overwrite=overwrite)
    clock = SystemClock()
    begin = clock.now()
    stacks = [open_stack(path) for path in (fixed, moving)]
    check_memory(stacks)
    both = opened(stacks[0], fixed_um, "fixed"), opened(stacks[1], moving_um, "moving")
    with progress("registering", 100, quiet=quiet) as show:
        found = registered(*both, model, method, fiducials, lambda share: show(round(100 * share)))
    if not found.believed:
        raise no_match(
            f"information {found.information:.3f} here, {found.elsewhere:.3f} at shifted places, "
            f"{found.overlap:.0%} shared"
        )
    moved = resampled(both[1], both[0], found.matrix)
    took = {"seconds": round(clock.now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
    said = {**report(stacks, both, found), "method": "fiducials" if fiducials else method, "model": model, **took}
    files = {
        "registered.tif": volume_bytes(moved, stacks[1].dtype, both[0].voxel_um),
        "transform.json": json_bytes({"convention": CONVENTION, "matrix": found.matrix}),
        "overlay.png": png_bytes(overlay(both[0], moved)),
        "report.json": json_bytes({**said, "versions": versions(), "files": FILES}),
    }
    write_results(output, files)
    sys.stderr.writelines([] if quiet else [f"note: {note}\n" for note in said["notes"]])
    sys.stdout.write(notation.dumps(plain(said), ensure_ascii=False) + "\n" if json else summary(said, output))
    return 0


def check_memory(stacks: list[Stack]) -> None:
    """Refuse volumes that do not fit into memory; says how much would be needed."""
    needed = COPIES * 4 * sum(len(s) * s.shape[0] * s.shape[1] for s in stacks)
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > free:
        raise InputError(
            f"registering takes {needed / 1e9:.1f} GB of memory; {free / 1e9:.1f} GB are free.",
            fix="bin both volumes first: stereotome process resample",
            code="register-memory",
        )


def opened(stack: Stack, size_um: tuple[float, float] | None, name: str) -> Volume:
    """Read a whole volume and find its voxel size.

    Raises
    ------
    InputError
        ``register-voxel``: no sensible voxel size is known. ``register-flat``: fewer than two planes.
    """
    if len(stack) < 2:
        raise InputError(f"{stack.source} holds one plane.", fix="give a volume.", code="register-flat")
    step = None if stack.z_um is None else float(np.ptp(stack.z_um)) / (len(stack) - 1)
    z_um, xy_um = size_um or (step, stack.pixel_um)
    if z_um is None or xy_um is None or not (0 < z_um < np.inf and 0 < xy_um < np.inf):
        raise InputError(
            f"{stack.source}: the size of a voxel is not known, or cannot be.",
            fix=f"give it along z and across in µm: --{name}-um 0.5 0.2",
            code="register-voxel",
        )
    return Volume(np.stack([grey(plane) for plane in stack]), (z_um, xy_um, xy_um))


def registered(
    fixed: Volume,
    moving: Volume,
    model: Model3,
    method: Method3,
    fiducials: Path | None,
    show: Callable[[float], None] | None = None,
) -> Registration:
    """Find the map by marks or by the pictures, and let the pictures judge it."""
    if fiducials is None:
        return judged(fixed, moving, from_pictures(fixed, moving, model, method, show))
    matrix, error_um = from_marks(model, *read_marks(fiducials))
    return judged(fixed, moving, matrix, error_um)


def read_marks(path: Path) -> tuple[Array, Array]:
    """Read places of marks in both volumes, (n, 3) µm each; marks seen in one volume only are left out.

    Raises
    ------
    InputError
        ``register-marks``: a column is missing, or a value is no number.
    """
    with reading(path), path.open(newline="", encoding="utf-8-sig") as file:
        lines = list(csv.DictReader(file))
    try:
        places = {(line["volume"], line["mark"]): [float(line[name]) for name in COLUMNS[2:]] for line in lines}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no table of marks in two volumes: {type(error).__name__} {error}.",
            fix=f"give CSV with the columns {', '.join(COLUMNS)}; volume is fixed or moving.",
            code="register-marks",
        ) from None
    both = sorted({mark for _, mark in places if ("fixed", mark) in places and ("moving", mark) in places})
    fixed, moving = (np.array([places[volume, m] for m in both]).reshape(-1, 3) for volume in ("fixed", "moving"))
    if not np.isfinite([fixed, moving]).all() or not both:
        raise InputError(
            f"{path} names no mark in both volumes, or a place that is no number.",
            fix="call the volumes fixed and moving, and marks alike in both.",
            code="register-marks",
        )
    return fixed, moving


def report(stacks: list[Stack], volumes: tuple[Volume, Volume], found: Registration) -> dict[str, Any]:
    """Return what was found, in numbers."""
    inputs = {name: about_stack(stack)["input"] for name, stack in zip(("fixed", "moving"), stacks, strict=True)}
    notes = [note for stack in stacks for note in stack.notes]
    return {
        "format": "stereotome-register",
        "version": 1,
        "input": inputs,
        "voxel_um": [volume.voxel_um for volume in volumes],
        "matrix": found.matrix,
        "convention": CONVENTION,
        "information": found.information,
        "information_elsewhere": found.elsewhere,
        "overlap": found.overlap,
        "mark_error_um": found.error_um,
        "notes": notes,
    }


def volume_bytes(volume: Array, dtype: np.dtype[Any], voxel_um: tuple[float, float, float]) -> bytes:
    """Encode a volume as OME-TIFF in the type it was taken in; 0 where nothing is shown."""
    file = BytesIO()
    top = np.iinfo(dtype).max
    values = np.rint(np.clip(np.nan_to_num(volume), 0, top)).astype(dtype)
    sizes = {f"PhysicalSize{axis}": size for axis, size in zip("ZYX", voxel_um, strict=True)}
    units = {f"PhysicalSize{axis}Unit": "µm" for axis in "ZYX"}
    tifffile.imwrite(file, values, ome=True, compression="zlib", metadata={"axes": "ZYX", **sizes, **units})
    return file.getvalue()


def overlay(fixed: Volume, moved: Array) -> Array:
    """Draw the three middle planes, fixed in red and moved in cyan: grey where both agree; RGB (h, w, 3) uint8."""
    figure = Figure(figsize=(12.0, 4.5), dpi=100, layout="constrained")
    z, y, x = fixed.voxel_um
    cuts = (("x", "y", y / x), ("x", "z", z / x), ("y", "z", z / y))
    for axes, axis, (across, down, aspect) in zip(figure.subplots(1, 3), range(3), cuts, strict=True):
        middle = fixed.grey.shape[axis] // 2
        red, cyan = (_stretched(np.take(v, middle, axis)) for v in (fixed.grey, np.nan_to_num(moved)))
        axes.imshow(np.stack([red, cyan, cyan], axis=-1), aspect=aspect, interpolation="nearest")
        axes.set(xlabel=f"{across}, voxels", ylabel=f"{down}, voxels")
    figure.suptitle("Middle planes: fixed red, registered cyan")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def _stretched(plane: Array) -> Array:
    low, high = np.percentile(plane, (1, 99))
    return np.asarray(np.clip((plane - low) / max(float(high - low), 1e-9), 0, 1))


def summary(said: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    error = "" if said["mark_error_um"] is None else f", marks to {said['mark_error_um']:.3g} µm"
    words = (
        f"{said['model']} by {said['method']}: information {said['information']:.3f}, "
        f"{said['information_elsewhere']:.3f} at shifted places; {said['overlap']:.0%} shared{error}; "
        f"{said['seconds']:.1f} s"
    )
    return "\n".join([words, *(str(folder / name) for name in FILES)]) + "\n"
