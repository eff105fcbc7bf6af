"""What ``process align`` leaves in a folder: the aligned stack as OME-Zarr and OME-TIFF, transforms, report, picture.

Every section is resampled once, from its original pixels. Nothing appears before all of it is written.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile
import zarr

from acquire.ome_zarr import FocalArray, replace_json, sync_folder
from processing.align_fill import blended
from processing.align_pictures import curves_picture, curves_table, sections_picture, sections_table
from processing.outputs import disk_error, write_durably
from processing.result_folder import json_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from processing.align_fill import Bridge
    from processing.align_methods import Method
    from processing.align_stack import Alignment, Section
    from processing.stack import Stack

    Array = NDArray[Any]

ZARR, TIFF, TRANSFORMS = "aligned.ome.zarr", "aligned.ome.tif", "transforms.json"
FILES = (ZARR, TIFF, TRANSFORMS, "sections.csv", "sections.png", "report.json")
CURVES = ("mismatch.csv", "mismatch.png")
CONVENTION = (
    "matrix leads from output pixel (x, y, 1) to source pixel (x, y) of the section as taken; "
    "pixel centres at whole numbers, x to the right, y down"
)
LANCZOS = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
TILE_PX = 2048  # resampled at a time: cv2 takes no picture beyond 32767 pixels
REACH_PX = 6  # around what a tile needs, for the interpolation


def files_of(method: Method) -> tuple[str, ...]:
    """Return the names of what is written, the report last."""
    return (*FILES[:-1], *(CURVES if method == "mismatch" else ()), FILES[-1])


def resampled(section: Array, matrix: Array) -> Array:
    """Return the section, (h, w) or (h, w, 3), as seen through the map, 0 where it shows nothing (Lanczos, 8 taps)."""
    out = np.zeros_like(section)
    height, width = section.shape[:2]
    for y in range(0, height, TILE_PX):
        for x in range(0, width, TILE_PX):
            part = out[y : y + TILE_PX, x : x + TILE_PX]
            part[...] = _tile(section, matrix, (x, y), part.shape)
    return out


def _tile(section: Array, matrix: Array, corner: tuple[int, int], shape: tuple[int, ...]) -> Array:
    x, y = corner
    ends = np.array([(x, y, 1), (x + shape[1], y, 1), (x, y + shape[0], 1), (x + shape[1], y + shape[0], 1)])
    seen = (ends @ matrix[:2].T).astype(np.float64)
    limit = np.array([section.shape[1], section.shape[0]])
    low = np.clip(np.floor(seen.min(axis=0)).astype(int) - REACH_PX, 0, limit)
    high = np.clip(np.ceil(seen.max(axis=0)).astype(int) + REACH_PX, 0, limit)
    if (high <= low).any():
        return np.zeros(shape, section.dtype)
    source = np.ascontiguousarray(section[low[1] : high[1], low[0] : high[0]])
    local = np.array(matrix[:2], np.float64)
    local[:, 2] += matrix[:2, :2] @ (x, y) - low
    return np.asarray(cv2.warpAffine(source, local, (shape[1], shape[0]), flags=LANCZOS))


def transforms(alignment: Alignment) -> dict[str, Any]:
    """Return what stands in ``transforms.json``."""
    return {
        "format": "stereotome-transforms",
        "version": 1,
        "convention": CONVENTION,
        "reference": alignment.reference,
        "sections": [_section(section, alignment) for section in alignment.sections],
    }


def _section(section: Section, alignment: Alignment) -> dict[str, Any]:
    bent = section.deformation
    error, direction = alignment.compression_errors(section)
    compression = {
        "ratio": bent.compression,
        "direction_deg": bent.direction_deg,
        "uncertainty": error,
        "direction_uncertainty_deg": direction,
    }
    return {
        "index": section.index,
        "matrix": section.matrix,
        "model": alignment.model,
        "error_px": section.error_px,
        "compression": compression,
        "rotation_deg": bent.rotation_deg,
        "flags": list(section.flags),
    }


def write_alignment(
    folder: Path,
    stack: Stack,
    alignment: Alignment,
    report: Mapping[str, Any],
    show: Callable[[int], None],
    made: Mapping[int, Bridge],
) -> None:
    """Resample every section once and write all results; sections in ``made`` are drawn from those beside them.

    Raises
    ------
    StoreError
        ``disk-full`` or ``store``: the disk refused; earlier results are as they were.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as aside:
            part = Path(aside)
            _write_volumes(part, stack, alignment, show, made)
            write_durably(part / TRANSFORMS, json_bytes(transforms(alignment)))
            write_durably(part / "sections.csv", sections_table(alignment))
            write_durably(part / "sections.png", sections_picture(stack, part / TIFF, alignment))
            if CURVES[0] in report["files"]:
                write_durably(part / CURVES[0], curves_table(alignment))
                write_durably(part / CURVES[1], curves_picture(alignment))
            write_durably(part / "report.json", json_bytes(report))
            for name in report["files"]:
                _replace(part / name, folder / name)
        sync_folder(folder)
    except OSError as error:
        raise disk_error(folder, error) from None


def _replace(new: Path, old: Path) -> None:
    if old.is_dir():
        shutil.rmtree(old)
    new.replace(old)


def _write_volumes(
    part: Path, stack: Stack, alignment: Alignment, show: Callable[[int], None], made: Mapping[int, Bridge]
) -> None:
    layout = _layout(stack)
    array = _zarr_array(part / ZARR, layout, stack, alignment)

    def placed(k: int) -> Array:
        return resampled(stack[k], alignment.sections[k].matrix)

    def planes() -> Iterator[Array]:
        for k in range(len(alignment.sections)):
            bridge = made.get(k)
            plane = placed(k) if bridge is None else blended(placed(bridge.before), placed(bridge.after), bridge.share)
            array[0, :, k] = plane[np.newaxis] if plane.ndim == 2 else np.moveaxis(plane, -1, 0)
            show(k + 1)
            yield plane

    with tifffile.TiffWriter(part / TIFF, bigtiff=True, ome=True) as tiff:
        tiff.write(
            planes(),
            shape=(len(stack), *stack.shape),
            dtype=stack.dtype,
            photometric="rgb" if stack.colour else "minisblack",
            compression="zlib",
            predictor=True,
            metadata=_ome(stack, layout),
        )


def _layout(stack: Stack) -> FocalArray:
    z_um = stack.z_um
    start = 0.0 if z_um is None else float(z_um[0])
    step = 1.0 if z_um is None else float(z_um[-1] - z_um[0]) / (len(z_um) - 1)
    return FocalArray(len(stack), stack.shape, str(stack.dtype), start, step, stack.pixel_um)


def _zarr_array(path: Path, layout: FocalArray, stack: Stack, alignment: Alignment) -> Any:
    (path / "0").mkdir(parents=True)
    z_um = [] if stack.z_um is None else [{"plane": k, "z_um": float(z)} for k, z in enumerate(stack.z_um)]
    flags = {str(s.index): list(s.flags) for s in alignment.sections if s.flags}
    replace_json(path / "zarr.json", layout.group_json("aligned sections", {"planes": z_um, "flags": flags}))
    replace_json(path / "0" / "zarr.json", layout.array_json(len(stack)))
    return zarr.open_array(path / "0", mode="r+")


def _ome(stack: Stack, layout: FocalArray) -> dict[str, Any]:
    metadata: dict[str, Any] = {"axes": "ZYXS" if stack.colour else "ZYX", "Name": "aligned sections"}
    if stack.z_um is not None:
        metadata |= {"PhysicalSizeZ": abs(layout.step_um) or 1.0, "PhysicalSizeZUnit": "µm"}
    if stack.pixel_um is not None:
        for axis in "XY":
            metadata |= {f"PhysicalSize{axis}": stack.pixel_um, f"PhysicalSize{axis}Unit": "µm"}
    return metadata
