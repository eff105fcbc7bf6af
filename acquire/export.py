"""Copies of a run for other programs: OME-TIFF, OME-Zarr 0.5 and 0.4, with sizes and what is known of each plane."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tifffile
import zarr
from cyclopts import Parameter

from acquire.depths import depths_nm
from acquire.grid import NM_PER_UM, grid_of
from acquire.ome_zarr import sync_folder
from acquire.progress import progress
from acquire.recorder import disk_failed
from acquire.store import open_run
from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.grid import Grid
    from acquire.store import StoredRun

TILE_PX = 512
NS_PER_S = 1e9
Format = Literal["ome-tiff", "ome-zarr", "ome-zarr-0.4"]
Axis = Literal["t", "z"]


def export(
    run: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    format_: Annotated[Format, Parameter(name="--format")] = "ome-tiff",
    sections: Axis = "t",
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
        ome-tiff for Fiji and most others, ome-zarr (0.5), ome-zarr-0.4 for readers that do not know 0.5 yet.
    sections
        The axis along which sections lie: t, beside the stack of each; z, with what was cut as spacing, for runs with
        one plane a section.
    quiet
        No progress.
    """
    stored = open_run(run)
    _check(stored, output)
    grid = grid_of(stored, sections)
    part = output.with_name(f".part-{output.name}")
    with progress("planes", grid.slots.size, quiet=quiet) as show:
        try:
            if format_ == "ome-tiff":
                write_ome_tiff(stored, grid, part, show)
            else:
                write_ome_zarr(stored, grid, part, version="0.5" if format_ == "ome-zarr" else "0.4", show=show)
            part.replace(output)
            sync_folder(output.absolute().parent)
        except OSError as error:
            raise disk_failed(error) from error
        finally:
            _remove(part)
    if grid.remark:
        sys.stderr.write(f"note: {grid.remark}.\n")
    for plane in stored.missing:
        left = "is black there" if plane in grid.slots else "is left out"
        sys.stderr.write(f"note: plane {plane} was never taken; in the copy it {left}.\n")
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


def write_ome_tiff(stored: StoredRun, grid: Grid, path: Path, show: Callable[[int], None] = lambda _: None) -> None:
    """Write a run as one BigTIFF with OME-XML, tiled and compressed without loss.

    Positions, exposure and time of each plane stand in its ``Plane`` element, in µm, ms and s.
    """
    layout = stored.layout
    samples = (layout.bands,) if layout.bands > 1 else ()
    with tifffile.TiffWriter(path, bigtiff=True, ome=True) as tiff:
        tiff.write(
            _tiles(stored, grid, show),
            shape=(*grid.slots.shape, *layout.shape[:2], *samples),
            dtype=layout.dtype,
            tile=(TILE_PX, TILE_PX),
            photometric="rgb" if samples else "minisblack",
            compression="zlib",
            predictor=True,
            metadata=_ome(stored, grid),
        )
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _tiles(stored: StoredRun, grid: Grid, show: Callable[[int], None]) -> Iterator[np.ndarray]:
    """Give the tiles of all planes, row by row; those at the right and lower edge are filled up with zeros."""
    for done, slot in enumerate(grid.slots.flat, start=1):
        pixels = _pixels(stored, slot)
        for y in range(0, pixels.shape[0], TILE_PX):
            for x in range(0, pixels.shape[1], TILE_PX):
                tile = np.zeros((TILE_PX, TILE_PX, *pixels.shape[2:]), pixels.dtype)
                part = pixels[y : y + TILE_PX, x : x + TILE_PX]
                tile[: part.shape[0], : part.shape[1]] = part
                yield tile
        show(done)


def _pixels(stored: StoredRun, slot: int) -> np.ndarray:
    """Return a plane, checked; black for one that was never taken."""
    if slot in stored.planes:
        return stored.read(slot)
    return np.zeros(stored.layout.shape, stored.layout.dtype)


def _ome(stored: StoredRun, grid: Grid) -> dict[str, Any]:
    layout = stored.layout
    told = facts_of(stored, grid)
    metadata: dict[str, Any] = {
        "axes": "TCZYXS" if layout.bands > 1 else "TCZYX",
        "Name": stored.manifest["name"],
        "PhysicalSizeZ": abs(grid.step_um) or 1.0,
        "PhysicalSizeZUnit": "µm",
        "Plane": {
            "PositionZ": [facts["z_um"] for facts in told],
            "PositionZUnit": ["µm"] * len(told),
            "ExposureTime": [facts["exposure_ms"] for facts in told],
            "ExposureTimeUnit": ["ms"] * len(told),
            "DeltaT": [facts["time_s"] for facts in told],
            "DeltaTUnit": ["s"] * len(told),
        },
    }
    if layout.channels:
        metadata["Channel"] = {"Name": list(layout.channels)}
    if layout.interval_s:
        metadata |= {"TimeIncrement": layout.interval_s, "TimeIncrementUnit": "s"}
    if layout.pixel_um is not None:
        for axis in "XY":
            metadata |= {f"PhysicalSize{axis}": layout.pixel_um, f"PhysicalSize{axis}Unit": "µm"}
    missing = [slot for slot in grid.slots.ravel().tolist() if slot not in stored.planes]
    remarks = [grid.remark] if grid.remark else []
    remarks += [f"never taken, black: planes {missing}"] if missing else []
    return metadata | ({"Description": "; ".join(remarks)} if remarks else {})


def facts_of(stored: StoredRun, grid: Grid) -> list[dict[str, Any]]:
    """Return the facts of all planes of an export; of sections along z, the depth is their place, not the stage's."""
    facts = [plane_facts(stored, slot) for slot in grid.slots.ravel().tolist()]
    depths = grid.slots.shape[2]
    if depths > stored.layout.planes_each:
        depth_nm, _ = depths_nm(stored, range(depths))
        place_um = grid.step_um * np.arange(depths) if depth_nm is None else (depth_nm - depth_nm[0]) / NM_PER_UM
        for k, told in enumerate(facts):
            told["z_um"] = grid.start_um + float(place_um[k % depths])
    return facts


def plane_facts(stored: StoredRun, slot: int) -> dict[str, Any]:
    """Return where, when and how long a plane was exposed; for one that was not, where it should have been."""
    section, band, plane = stored.layout.place(slot)
    begin_ns = min(record.header.exposure_start_ns for record in stored.planes.values())
    facts: dict[str, Any] = {"plane": slot, "section": section, "band": band}
    if slot not in stored.planes:
        z_um = stored.layout.start_um + plane * stored.layout.step_um
        return {**facts, "z_um": z_um, "exposure_ms": 0.0, "time_s": 0.0, "missing": True}
    header = stored.planes[slot].header
    time_s = (header.exposure_start_ns - begin_ns) / NS_PER_S
    return {**facts, "z_um": header.z_um, "exposure_ms": header.exposure_ms, "time_s": time_s}


def write_ome_zarr(
    stored: StoredRun,
    grid: Grid,
    path: Path,
    *,
    version: Literal["0.4", "0.5"],
    show: Callable[[int], None] = lambda _: None,
) -> None:
    """Write a run as OME-Zarr (0.4 in Zarr 2, 0.5 in Zarr 3), one chunk a plane."""
    layout = stored.layout
    (times, channels, planes), (height, width) = grid.slots.shape, layout.shape[:2]
    names = ("t", "c", "z", "y", "x")
    group = zarr.create_group(path, zarr_format=2 if version == "0.4" else 3)
    array = group.create_array(
        "0",
        shape=(times, channels * layout.bands, planes, height, width),
        chunks=(1, 1, 1, height, width),
        dtype=layout.dtype,
        chunk_key_encoding={"name": "v2" if version == "0.4" else "default", "separator": "/"},
        dimension_names=None if version == "0.4" else names,
    )
    for done, (t, c, z) in enumerate(np.ndindex(grid.slots.shape), start=1):
        pixels = _pixels(stored, int(grid.slots[t, c, z]))
        planar = pixels[np.newaxis] if layout.bands == 1 else np.moveaxis(pixels, -1, 0)
        array[t, c * layout.bands : (c + 1) * layout.bands, z] = planar
        show(done)
    group.attrs.update(_zarr_attributes(stored, grid, version))


def _zarr_attributes(stored: StoredRun, grid: Grid, version: str) -> dict[str, Any]:
    placed = replace(stored.layout, start_um=grid.start_um, step_um=grid.step_um)
    ome = placed.group_json(str(stored.manifest["name"]))["attributes"]["ome"]
    own: dict[str, Any] = {"planes": facts_of(stored, grid)}
    own |= {"remark": grid.remark} if grid.remark else {}
    if version == "0.5":
        return {"ome": ome, "stereotome": own}
    return {"multiscales": [{**ome["multiscales"][0], "version": "0.4"}], "omero": ome["omero"], "stereotome": own}
