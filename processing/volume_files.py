"""Volumes in a folder of results: OME-Zarr and OME-TIFF, all of it there or nothing."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile
import zarr

from acquire.ome_zarr import replace_json, sync_folder
from processing.outputs import disk_error
from processing.pictures import captioned, preview

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from acquire.ome_zarr import FocalArray

    Array = NDArray[Any]

REPORT = "report.json"
GAP_PX = 4
TALLEST = 8.0  # times a plane's height is shown, at most


def volume_names(name: str) -> tuple[str, str]:
    """Return the names under which a volume is written."""
    return f"{name}.ome.zarr", f"{name}.ome.tif"


def publish(folder: Path, fill: Callable[[Path], None]) -> None:
    """Have ``fill`` write files and folders aside, then show all of them, the report last.

    Raises
    ------
    StoreError
        ``disk-full`` or ``store``: the disk refused; earlier results are as they were.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as aside:
            fill(Path(aside))
            for made in sorted(Path(aside).iterdir(), key=lambda path: path.name == REPORT):
                _move(made, folder / made.name)
        sync_folder(folder)
    except OSError as error:
        raise disk_error(folder, error) from None


def _move(new: Path, old: Path) -> None:
    if old.is_dir():
        shutil.rmtree(old)
    new.replace(old)


def write_volume(folder: Path, name: str, title: str, layout: FocalArray, planes: Iterable[Array]) -> None:
    """Write the planes of a volume as both kinds, each plane asked for once.

    Parameters
    ----------
    folder : Path
        Is there.
    name, title : str
        Of the files, and what the volume is.
    layout : FocalArray
        Number, shape, type and spacing of the planes.
    planes : iterable of arrays
        uint8, uint16 or float32.
    """
    zarr_name, tiff_name = volume_names(name)
    (folder / zarr_name / "0").mkdir(parents=True)
    replace_json(folder / zarr_name / "zarr.json", layout.group_json(title))
    replace_json(folder / zarr_name / "0" / "zarr.json", layout.array_json(layout.planned))
    array: Any = zarr.open_array(folder / zarr_name / "0", mode="r+")

    def copied() -> Iterator[Array]:
        for k, plane in enumerate(planes):
            array[0, :, k] = plane[np.newaxis] if plane.ndim == 2 else np.moveaxis(plane, -1, 0)
            yield plane

    with tifffile.TiffWriter(folder / tiff_name, bigtiff=True, ome=True) as tiff:
        tiff.write(
            copied(),
            shape=(layout.planned, *layout.shape),
            dtype=layout.dtype,
            photometric="rgb" if layout.bands == 3 else "minisblack",
            compression="zlib",
            predictor=np.dtype(layout.dtype).kind != "f",  # floats would need another library
            metadata=_ome(title, layout),
        )


def _ome(title: str, layout: FocalArray) -> dict[str, Any]:
    sizes = {"X": layout.pixel_um, "Y": layout.pixel_um, "Z": abs(layout.step_um) or 1.0}
    metadata: dict[str, Any] = {"axes": "ZYXS" if layout.bands == 3 else "ZYX", "Name": title}
    for axis, size in sizes.items():
        if layout.pixel_um is not None and size is not None:
            metadata |= {f"PhysicalSize{axis}": size, f"PhysicalSize{axis}Unit": "µm"}
    return metadata


def middle_cuts(volume: Array, deep: float) -> Array:
    """Show the middle plane over the middle x-z cut, ``deep`` pixels for each plane; 8-bit picture."""
    return cuts_picture(volume[volume.shape[0] // 2], volume[:, volume.shape[1] // 2], deep)


def cuts_picture(plane: Array, cut: Array, deep: float = 1.0) -> Array:
    """Show a plane over an x-z cut."""
    top, shown = preview(plane), preview(cut)
    height = max(1, round(cut.shape[0] * min(deep, TALLEST)))
    below = cv2.resize(shown, (cut.shape[1], height), interpolation=cv2.INTER_NEAREST)
    return np.concatenate([top, np.full((GAP_PX, *top.shape[1:]), 255, np.uint8), below])


def side_by_side(before: Array, after: Array, deep: float, words: str) -> Array:
    """Show two volumes' middle cuts beside each other, with words below."""
    left, right = middle_cuts(before, deep), middle_cuts(after, deep)
    height = max(left.shape[0], right.shape[0])
    left, right = (
        np.pad(a, [(0, height - a.shape[0]), (0, GAP_PX), *[(0, 0)] * (a.ndim - 2)], constant_values=255)
        for a in (left, right)
    )
    return captioned(np.concatenate([left, right], 1), words)
