"""Volumes in a folder of results: OME-Zarr and OME-TIFF, all of it there or nothing."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from dataclasses import replace
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
SMALLEST_LEVEL_PX = 256
WRITTEN = ("uint8", "uint16", "uint32", "float32")  # number types of volumes in files
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


def levels_of(shape: tuple[int, ...]) -> int:
    """Return how many levels a pyramid of planes has: the last is no larger than 256 pixels."""
    return 1 + max(0, math.ceil(math.log2(max(shape[:2]) / SMALLEST_LEVEL_PX)))


def pyramid(layout: FocalArray) -> FocalArray:
    """Return the layout with smaller versions of every plane."""
    return replace(layout, levels=levels_of(layout.shape))


def create_volume(image: Path, title: str, layout: FocalArray) -> None:
    """Make an OME-Zarr image whose planes are not yet written; its ``zarr.json`` comes last."""
    for level in range(layout.levels):
        (image / str(level)).mkdir(parents=True, exist_ok=True)
        replace_json(image / str(level) / "zarr.json", layout.level(level).array_json(layout.planned))
    replace_json(image / "zarr.json", layout.group_json(title))


def write_plane(image: Path, layout: FocalArray, k: int, plane: Array) -> None:
    """Write plane ``k`` of an image, and its smaller versions; on the disk when this returns."""
    for level in range(layout.levels):
        array: Any = zarr.open_array(image / str(level), mode="r+")
        shard = image / str(level) / "c" / "0" / "0" / str(k) / "0" / "0"
        shard.unlink(missing_ok=True)  # half of one would be read first, and be refused
        array[0, :, k] = plane[np.newaxis] if plane.ndim == 2 else np.moveaxis(plane, -1, 0)
        if shard.exists():  # a plane that is all 0 has none
            with shard.open("rb") as file:
                os.fsync(file.fileno())
        if level + 1 < layout.levels:
            plane = halved(plane)


def stored_planes(image: Path) -> Iterator[Array]:
    """Yield the planes of an image that was written here."""
    array: Any = zarr.open_array(image / "0", mode="r")
    for k in range(array.shape[2]):
        plane = np.asarray(array[0, :, k])
        yield plane[0] if len(plane) == 1 else np.ascontiguousarray(np.moveaxis(plane, 0, -1))


def halved(plane: Array) -> Array:
    """Return a plane at half size: rounded means of four pixels; of labels one of the four, since means are none."""
    height, width = plane.shape[:2]
    if plane.dtype == np.uint32:
        return plane[::2, ::2]
    even = np.pad(plane, [(0, height % 2), (0, width % 2), *[(0, 0)] * (plane.ndim - 2)], mode="edge")
    size = (even.shape[1] // 2, even.shape[0] // 2)
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA))


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
        uint8, uint16, uint32 or float32.
    """
    zarr_name, tiff_name = volume_names(name)
    layout = pyramid(layout)
    create_volume(folder / zarr_name, title, layout)

    def copied() -> Iterator[Array]:
        for k, plane in enumerate(planes):
            write_plane(folder / zarr_name, layout, k, plane)
            yield plane

    write_tiff(folder / tiff_name, title, layout, copied())


def settle_volume(
    folder: Path,
    name: str,
    title: str,
    layout: FocalArray,
    made: Path | Iterable[Array],
    seen: Callable[[Iterable[Array]], Iterator[Array]],
) -> None:
    """Write a volume as both kinds, or move there the OME-Zarr image that blocks have made and write the other kind.

    Parameters
    ----------
    made : Path or iterable of arrays
        The image, or the planes.
    seen : callable
        Every plane passes through it.
    """
    if isinstance(made, Path):
        image, tiff = (folder / there for there in volume_names(name))
        made.replace(image)
        write_tiff(tiff, title, layout, seen(stored_planes(image)))
    else:
        write_volume(folder, name, title, layout, seen(made))


def write_tiff(path: Path, title: str, layout: FocalArray, planes: Iterator[Array]) -> None:
    """Write the planes of a volume as OME-TIFF, each asked for once; arguments as for `write_volume`."""
    with tifffile.TiffWriter(path, bigtiff=True, ome=True) as tiff:
        tiff.write(
            planes,
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


class MiddleCuts:
    """The middle cuts of a volume whose planes come one by one."""

    def __init__(self, count: int) -> None:
        self._middle, self._rows, self._plane = count // 2, list[Any](), np.empty(0)

    def seen(self, planes: Iterable[Array]) -> Iterator[Array]:
        """Hand the planes on, and keep what is shown of them."""
        for k, plane in enumerate(planes):
            self._rows.append(np.array(plane[plane.shape[0] // 2]))
            self._plane = plane if k == self._middle else self._plane
            yield plane

    def picture(self, deep: float = 1.0) -> Array:
        """Show them, as `middle_cuts` of the whole volume does."""
        return cuts_picture(self._plane, np.stack(self._rows), deep)


def cuts_picture(plane: Array, cut: Array, deep: float = 1.0) -> Array:
    """Show a plane over an x-z cut."""
    top, shown = (label_colours(p) if p.dtype == np.uint32 else preview(p) for p in (plane, cut))
    height = max(1, round(cut.shape[0] * min(deep, TALLEST)))
    below = cv2.resize(shown, (cut.shape[1], height), interpolation=cv2.INTER_NEAREST)
    return np.concatenate([top, np.full((GAP_PX, *top.shape[1:]), 255, np.uint8), below])


def label_colours(labels: Array) -> Array:
    """Paint every label in a colour of its own, background black; neighbours in number far apart in hue."""
    hue = (labels * np.uint32(67)) % np.uint32(180)
    light = 160 + 95 * (labels % np.uint32(2))
    hsv = np.stack([hue, np.full_like(hue, 190), np.where(labels > 0, light, 0)], axis=-1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))


def side_by_side(left: Array, right: Array, words: str) -> Array:
    """Show two pictures beside each other, with words below."""
    height = max(left.shape[0], right.shape[0])
    left, right = (
        np.pad(a, [(0, height - a.shape[0]), (0, GAP_PX), *[(0, 0)] * (a.ndim - 2)], constant_values=255)
        for a in (left, right)
    )
    return captioned(np.concatenate([left, right], 1), words)
