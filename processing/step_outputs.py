"""What steps of a pipeline leave: maps, volumes and tables as files with pictures, all else in the report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.ome_zarr import FocalArray
from processing.outputs import tiff_bytes, write_durably
from processing.pictures import png_bytes
from processing.relief_picture import range_picture, relief_picture
from processing.result_folder import csv_bytes
from processing.table import Picture, Table
from processing.volume_files import WRITTEN, middle_cuts, volume_names, write_volume

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.neighbours import Spacing
    from processing.pipeline import Pipeline

    Array = NDArray[Any]
    Layers = dict[str, Any]


def files_of(pipeline: Pipeline) -> list[str]:
    """Return the names of all files that the steps could leave."""
    names = {layer.name for step in pipeline.steps for layer in step.operator.gives}
    ends = ("{}.tif", "{}.csv", "{}.npy", "{}.png")
    files = [f for name in sorted(names) for f in (*volume_names(name), *(end.format(name) for end in ends))]
    return [*files, "relief.png", "report.json"]


def write_layers(part: Path, made: Layers, spacing_um: Spacing | None, start_um: float = 0.0) -> list[str]:
    """Write each layer as what it is; returns the names of the files.

    Parameters
    ----------
    made : dict
        Layers that the steps made.
    spacing_um : tuple of float or None
        Of the volumes; None where it is not known, and then the files name none.
    start_um : float
        Position of their first plane.
    """
    pixel_um = 1.0 if spacing_um is None else spacing_um[2]
    for name, value in made.items():
        if isinstance(value, Table):
            write_durably(part / f"{name}.csv", csv_bytes(value.columns, value.rows))
        elif isinstance(value, Picture):
            write_durably(part / f"{name}.png", png_bytes(value.pixels))
        elif np.ndim(value) == 2:
            write_map(part, name, np.asarray(value), made.get("pixel_um", pixel_um))
        elif np.ndim(value) >= 3:
            write_any_volume(part, name, np.asarray(value), spacing_um, start_um)
    if np.ndim(made.get("range", 0)) == 2:
        write_durably(part / "relief.png", png_bytes(relief_picture(made["range"], pixel_um)))
    return sorted(path.name for path in part.iterdir())


def write_map(part: Path, name: str, values: Array, pixel_um: float | None) -> None:
    """Write a map with its picture."""
    kept = np.where(values, np.uint8(255), np.uint8(0)) if values.dtype == np.bool_ else values
    write_durably(part / f"{name}.tif", tiff_bytes(kept, pixel_um, name))
    write_durably(part / f"{name}.png", png_bytes(range_picture(kept.astype(np.float32), name, pixel_um)))


def write_any_volume(part: Path, name: str, volume: Array, spacing_um: Spacing | None, start_um: float) -> None:
    """Write a volume with a picture of its middle cuts; types that pictures do not have as NPY."""
    if volume.dtype.name not in WRITTEN:
        np.save(part / f"{name}.npy", volume)
        return
    layout = layout_of(volume.shape, str(volume.dtype), spacing_um, start_um)
    write_volume(part, name, name, layout, iter(volume))
    deep = 1.0 if spacing_um is None else spacing_um[0] / spacing_um[2]
    write_durably(part / f"{name}.png", png_bytes(middle_cuts(volume, deep)))


def layout_of(shape: tuple[int, ...], dtype: str, spacing_um: Spacing | None, start_um: float) -> FocalArray:
    """Return how a volume (z, y, x) is written; without sizes where none are known."""
    if spacing_um is None:
        return FocalArray(shape[0], shape[1:], dtype, 0.0, 0.0, None)
    return FocalArray(shape[0], shape[1:], dtype, start_um, spacing_um[0], spacing_um[2])


def summed_up(value: Any) -> dict[str, Any]:
    """Describe a layer for the report: an array by its extent, a table by its size, anything else by itself."""
    if isinstance(value, Table):
        return {"columns": list(value.columns), "rows": len(value.rows)}
    if isinstance(value, Picture):
        return {"shape": value.pixels.shape, "dtype": "picture"}
    known = value[np.isfinite(value)] if value.dtype.kind == "f" else value
    spread = {"min": known.min(), "mean": known.mean(dtype=np.float64), "max": known.max()} if known.size else {}
    return {"shape": value.shape, "dtype": str(value.dtype), **{k: float(v) for k, v in spread.items()}}
