"""The command ``stereotome process crater``: unevenly eroded planes bent back to true depth."""

from __future__ import annotations

import json as notation
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
from processing.crater import checked_crater, depths_um, unbent
from processing.outputs import about_stack, peak_memory_mb, versions
from processing.pictures import png_bytes
from processing.readers import reading
from processing.result_folder import check_results, json_bytes, plain, write_results
from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

FILES = ("unbent.tif", "known.tif", "unbent.png", "report.json")
Switch = Parameter(negative="")


def crater(
    stack: Path,
    depth: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    heights: Annotated[bool, Switch] = False,
    planes: int | None = None,
    channel: int | None = None,
    time: int | None = None,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Bend the planes of a depth profile to the crater that was measured after it.

    Parameters
    ----------
    stack
        Planes in the order they were taken, the first at the untouched surface.
    depth
        Depth of the crater's floor below the surface in µm, down positive: TIFF or NPY of the size of a plane, such as
        the range.tif or elevation.tif of another command.
    output
        Folder for the planes at even depths, where they are known, picture and report.
    heights
        The crater is given as heights, up positive.
    planes
        How many depths to make; as many as there are planes when left out.
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
    clock = SystemClock()
    begin = clock.now()
    opened = open_stack(stack, step_um=1.0, channel=channel, time=time)
    if len(opened) < 2:
        raise InputError(f"{stack} holds one plane.", fix="give a depth profile.", code="crater-flat")
    floor = checked_crater(read_map(depth) * (-1.0 if heights else 1.0), opened.shape)
    depths = depths_um(floor, planes or len(opened))
    made, known = [], []
    with progress("bending planes", len(depths), quiet=quiet) as show:
        for k, (plane, there) in enumerate(unbent(opened, floor, depths)):
            made.append(plane)
            known.append(there)
            show(k + 1)
    took = {"seconds": round(clock.now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
    said = {**report(opened, depth, floor, depths, float(np.mean(known))), **took}
    files = {
        "unbent.tif": stacked(np.stack(made), depths, opened.pixel_um),
        "known.tif": stacked(np.stack(known).astype(np.uint8) * 255, depths, opened.pixel_um),
        "unbent.png": png_bytes(cuts(opened, np.stack(made), np.stack(known), depths)),
        "report.json": json_bytes({**said, "versions": versions(), "files": FILES}),
    }
    write_results(output, files)
    text = notation.dumps(plain(said), ensure_ascii=False) + "\n" if json else summary(said, output)
    sys.stdout.write(text)
    return 0


def read_map(path: Path) -> Array:
    """Read a map of depths, (height, width) float64."""
    with reading(path):
        values = np.load(path, allow_pickle=False) if path.suffix == ".npy" else tifffile.imread(path)
    return np.asarray(np.squeeze(values), np.float64)


def report(stack: Stack, depth: Path, floor: Array, depths: Array, known: float) -> dict[str, Any]:
    """Return what was done, in numbers."""
    return {
        "format": "stereotome-crater",
        "version": 1,
        "input": {**about_stack(stack)["input"], "z_um": None, "crater": str(depth)},
        "depths_um": depths,
        "floor_um": {"least": float(np.nanmin(floor)), "most": float(np.nanmax(floor))},
        "share_without_floor": float(np.isnan(floor).mean()),
        "share_known": known,
        "interpolation": "linear between planes",
    }


def stacked(volume: Array, depths: Array, pixel_um: float | None) -> bytes:
    """Encode planes at even depths as OME-TIFF."""
    file = BytesIO()
    sizes: dict[str, Any] = {"PhysicalSizeZ": float(depths[1] - depths[0]), "PhysicalSizeZUnit": "µm"}
    for axis in "XY" if pixel_um else "":
        sizes |= {f"PhysicalSize{axis}": pixel_um, f"PhysicalSize{axis}Unit": "µm"}
    axes = "ZYXS" if volume.ndim == 4 else "ZYX"
    kind = "rgb" if volume.ndim == 4 else "minisblack"
    tifffile.imwrite(file, volume, ome=True, photometric=kind, compression="zlib", metadata={"axes": axes, **sizes})
    return file.getvalue()


def cuts(stack: Stack, made: Array, known: Array, depths: Array) -> Array:
    """Draw the cut through the middle row as taken and at true depth; RGB (h, w, 3) uint8."""
    row = stack.shape[0] // 2
    before = np.stack([stack[k][row] for k in range(len(stack))])
    after = np.where(known[:, row, :, None] if made.ndim == 4 else known[:, row], made[:, row], 0)
    figure = Figure(figsize=(9.0, 4.5), dpi=100, layout="constrained")
    words = (("as taken", "plane", len(stack)), ("at true depth, black unknown", "depth, µm", float(depths[-1])))
    for axes, cut, (title, label, bottom) in zip(figure.subplots(1, 2), (before, after), words, strict=True):
        low, high = np.percentile(before, (0.5, 99.5))
        shown = np.clip((cut.astype(np.float32) - low) / max(float(high - low), 1.0), 0, 1)
        axes.imshow(shown, cmap="gray", aspect="auto", extent=(0, stack.shape[1], bottom, 0), interpolation="nearest")
        axes.set(title=f"Cut through the middle, {title}", xlabel="x, pixels", ylabel=label)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def summary(said: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    floor = said["floor_um"]
    words = (
        f"{len(said['depths_um'])} depths from 0 to {floor['most']:.4g} µm; floor between {floor['least']:.4g} "
        f"and {floor['most']:.4g} µm; {said['share_known']:.0%} of the voxels known; {said['seconds']:.1f} s"
    )
    return "\n".join([words, *(str(folder / name) for name in FILES)]) + "\n"
