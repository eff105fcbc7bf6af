"""Copies of a run for other programs: OME-TIFF and OME-Zarr 0.4, with sizes in µm and what is known of each plane."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tifffile
import zarr
from cyclopts import Parameter

from acquire.ome_zarr import sync_folder
from acquire.progress import progress
from acquire.recorder import disk_failed
from acquire.store import open_run
from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.store import PlaneRecord, StoredRun

TILE_PX = 512
NS_PER_S = 1e9
Format = Literal["ome-tiff", "ome-zarr-0.4"]


def export(
    run: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    format_: Annotated[Format, Parameter(name="--format")] = "ome-tiff",
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Copy a finished or interrupted run into a file that other programs read, every plane checked on the way.

    Parameters
    ----------
    run
        The run's folder.
    output
        The file or folder to write; must not exist.
    format_
        ome-tiff for Fiji and most others, ome-zarr-0.4 for readers that do not know 0.5 yet.
    quiet
        No progress.
    """
    stored = open_run(run)
    _check(stored, output)
    write = write_ome_tiff if format_ == "ome-tiff" else write_ome_zarr_04
    part = output.with_name(f".part-{output.name}")
    with progress("planes", len(stored.planes), quiet=quiet) as show:
        try:
            write(stored, part, show)
            part.replace(output)
            sync_folder(output.absolute().parent)
        except OSError as error:
            raise disk_failed(error) from error
        finally:
            _remove(part)
    for plane in stored.missing:
        sys.stderr.write(f"note: plane {plane} was never taken; the copy leaves it out.\n")
    sys.stdout.write(f"{output}\n")
    return 0


def _remove(part: Path) -> None:
    """Remove what a failed export left; nothing is there after a good one."""
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)


def _check(stored: StoredRun, output: Path) -> None:
    if output.exists():
        raise InputError(f"{output} exists already.", fix="choose another name: -o FILE", code="output-exists")
    if not stored.planes:
        raise InputError(f"{stored.folder} holds no plane.", why=f"The run is {stored.state}.", code="no-planes")


def write_ome_tiff(stored: StoredRun, path: Path, show: Callable[[int], None] = lambda _: None) -> None:
    """Write the durable planes as one BigTIFF with OME-XML, tiled and compressed without loss.

    Positions, exposure and time of each plane stand in its ``Plane`` element, in µm, ms and s.
    """
    layout = stored.layout
    shape = (len(stored.planes), *layout.shape[:2], *((layout.bands,) if layout.bands > 1 else ()))
    with tifffile.TiffWriter(path, bigtiff=True, ome=True) as tiff:
        tiff.write(
            _tiles(stored, show),
            shape=shape,
            dtype=layout.dtype,
            tile=(TILE_PX, TILE_PX),
            photometric="rgb" if layout.bands > 1 else "minisblack",
            compression="zlib",
            predictor=True,
            metadata=_ome(stored),
        )
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _tiles(stored: StoredRun, show: Callable[[int], None]) -> Iterator[np.ndarray]:
    """Give the tiles of all planes, row by row; those at the right and lower edge are filled up with zeros."""
    for done, plane in enumerate(sorted(stored.planes), start=1):
        pixels = stored.read(plane)
        for y in range(0, pixels.shape[0], TILE_PX):
            for x in range(0, pixels.shape[1], TILE_PX):
                tile = np.zeros((TILE_PX, TILE_PX, *pixels.shape[2:]), pixels.dtype)
                part = pixels[y : y + TILE_PX, x : x + TILE_PX]
                tile[: part.shape[0], : part.shape[1]] = part
                yield tile
        show(done)


def _ome(stored: StoredRun) -> dict[str, Any]:
    records = _records(stored)
    layout = stored.layout
    begin_ns = records[0].header.exposure_start_ns
    metadata: dict[str, Any] = {
        "axes": "ZYXS" if layout.bands > 1 else "ZYX",
        "Name": stored.manifest["name"],
        "PhysicalSizeZ": abs(layout.step_um) or 1.0,
        "PhysicalSizeZUnit": "µm",
        "Plane": {
            "PositionZ": [r.header.z_um for r in records],
            "PositionZUnit": ["µm"] * len(records),
            "ExposureTime": [r.header.exposure_ms for r in records],
            "ExposureTimeUnit": ["ms"] * len(records),
            "DeltaT": [(r.header.exposure_start_ns - begin_ns) / NS_PER_S for r in records],
            "DeltaTUnit": ["s"] * len(records),
        },
    }
    if layout.pixel_um is not None:
        for axis in "XY":
            metadata |= {f"PhysicalSize{axis}": layout.pixel_um, f"PhysicalSize{axis}Unit": "µm"}
    return metadata


def write_ome_zarr_04(stored: StoredRun, path: Path, show: Callable[[int], None] = lambda _: None) -> None:
    """Write the durable planes as OME-Zarr 0.4 (Zarr 2), one chunk a plane and band."""
    layout = stored.layout
    height, width = layout.shape[:2]
    planes = sorted(stored.planes)
    group = zarr.create_group(path, zarr_format=2)
    array = group.create_array(
        "0",
        shape=(1, layout.bands, len(planes), height, width),
        chunks=(1, 1, 1, height, width),
        dtype=layout.dtype,
        chunk_key_encoding={"name": "v2", "separator": "/"},
    )
    for index, plane in enumerate(planes):
        pixels = stored.read(plane)
        array[0, :, index] = pixels[np.newaxis] if layout.bands == 1 else np.moveaxis(pixels, -1, 0)
        show(index + 1)
    ome = layout.group_json(str(stored.manifest["name"]))["attributes"]["ome"]
    image = {**ome["multiscales"][0], "version": "0.4"}
    positions = [{"plane": r.plane, "z_um": r.header.z_um} for r in _records(stored)]
    group.attrs.update({"multiscales": [image], "omero": ome["omero"], "stereotome": {"planes": positions}})


def _records(stored: StoredRun) -> list[PlaneRecord]:
    return [stored.planes[plane] for plane in sorted(stored.planes)]
