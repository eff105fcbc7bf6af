"""What ``process focus`` leaves in a folder: measured images as TIFF, previews as PNG, and a report.

Nothing appears before all of it is durable: files are written aside and renamed at the end, the report last.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import resource
import shutil
import sys
import tempfile
from contextlib import suppress
from importlib.metadata import version
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from acquire.ome_zarr import sync_folder
from devices.errors import InputError, StoreError
from processing.pictures import confidence_map, png_bytes, preview, range_map, width_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from processing.focus import FocusResult
    from processing.stack import Stack

    Array = NDArray[Any]

FILES = (
    "extended_focus.tif",
    "range.tif",
    "confidence.tif",
    "plane.tif",
    "width.tif",
    "extended_focus.png",
    "range.png",
    "confidence.png",
    "width.png",
    "report.json",
)
REPORT, FILLED = "report.json", "filled.tif"
FORMAT, FORMAT_VERSION = "stereotome-focus", 1
PACKAGES = ("stereotome", "numpy", "opencv-contrib-python-headless", "numba", "tifffile")
FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
UM_PER_CM = 1e4


def check_folder(folder: Path, *, overwrite: bool = False) -> None:
    """Refuse a folder that holds results already; asked before the work, not after.

    Raises
    ------
    InputError
        ``output-exists``: the path is a file, or holds results and ``overwrite`` is False.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file.", fix="name a folder: -o DIR", code="output-exists")
    there = [name for name in (*FILES, FILLED) if (folder / name).exists()]
    if there and not overwrite:
        raise InputError(
            f"{folder} holds results already: {', '.join(there)}. Nothing was started.",
            fix=("choose another folder: -o DIR", "replace them: --overwrite"),
            code="output-exists",
        )


def write_focus_result(
    result: FocusResult,
    folder: Path,
    *,
    pixel_um: float | None = None,
    facts: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write images, previews and report of a focus measurement.

    Parameters
    ----------
    result : FocusResult
        What was measured.
    folder : Path
        Made if it does not exist.
    pixel_um : float, optional
        Size of a pixel in the specimen, kept as resolution of the TIFFs.
    facts : dict, optional
        More for the report, such as `about_stack` gives; JSON types.
    overwrite : bool
        Replace results that are there.

    Returns
    -------
    dict
        The report as written.

    Raises
    ------
    InputError
        As `check_folder`.
    StoreError
        ``disk-full`` or ``store``: the disk refused; earlier results are as they were.
    """
    check_folder(folder, overwrite=overwrite)

    def fill(aside: Path) -> list[str]:
        images = {name: (getattr(result, layer), words) for name, (layer, words) in image_words(result).items()}
        for name, (image, words) in images.items():
            write_durably(aside / name, tiff_bytes(as_stored(image), pixel_um, words))
        return [*images, *write_previews(aside, result, pixel_um)]

    about = {**measured(result, span_of(result)), "pixel_um": pixel_um, **(facts or {})}
    return publish_focus(folder, about, fill)


def publish_focus(folder: Path, about: dict[str, Any], fill: Callable[[Path], list[str]]) -> dict[str, Any]:
    """Have ``fill`` write files aside and return their names; then show them all, the report ``about`` them last."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as aside:
            files = [*fill(Path(aside)), REPORT]
            report = {**about, "versions": versions(), "files": files}
            words = json.dumps(report, indent=1, ensure_ascii=False, default=_plain) + "\n"
            write_durably(Path(aside) / REPORT, words.encode())
            for name in files:
                (Path(aside) / name).replace(folder / name)
            if FILLED not in files:
                (folder / FILLED).unlink(missing_ok=True)
        sync_folder(folder)
    except OSError as error:
        raise disk_error(folder, error) from None
    return report


def image_words(result: FocusResult) -> dict[str, tuple[str, str]]:
    """Return, for each TIFF, which layer of a result is in it, and what it says of itself."""
    unit = "um" if result.unit == "um" else "planes"
    span = f"range in {unit}{'' if result.unit == 'um' else ' counted from 0'}"
    images = {
        "extended_focus.tif": ("extended_focus", "extended focus"),
        "range.tif": ("range", span),
        "confidence.tif": ("confidence", "confidence of the range"),
        "plane.tif": ("plane", "plane nearest to the best focus, counted from 0"),
        "width.tif": ("width", f"width of the focus curve at half its height in {unit}; 0 unknown"),
    }
    return images if result.filled is None else {**images, FILLED: ("filled", "255 where the range was filled")}


def as_stored(image: Array) -> Array:
    """Return an image as it is written: masks are 0 and 255."""
    return np.where(image, np.uint8(255), np.uint8(0)) if image.dtype == np.bool_ else image


def write_previews(folder: Path, result: FocusResult, pixel_um: float | None) -> list[str]:
    """Draw what a result shows; returns the names of the pictures."""
    confident = float(result.parameters["confident"])
    pictures = {
        "extended_focus.png": preview(result.extended_focus),
        "range.png": range_map(result.range, result.confidence, confident, result.unit, pixel_um),
        "confidence.png": confidence_map(result.confidence, confident, pixel_um),
        "width.png": width_map(result.width, result.confidence, confident, result.unit, pixel_um),
    }
    for name, picture in pictures.items():
        write_durably(folder / name, png_bytes(picture))
    return list(pictures)


def tiff_options(image_shape: tuple[int, ...], pixel_um: float | None, description: str) -> dict[str, Any]:
    """Return how an image (h, w) or RGB (h, w, 3) is written; pixel sizes become pixels per centimetre."""
    per_cm = {} if pixel_um is None else {"resolution": (UM_PER_CM / pixel_um,) * 2, "resolutionunit": "CENTIMETER"}
    kind = "rgb" if len(image_shape) == 3 else "minisblack"
    about = {"description": description, "software": f"stereotome {version('stereotome')}", "metadata": None}
    return {"photometric": kind, **about, **per_cm}


def write_tiff_in_bands(
    path: Path, bands: Iterable[Array], shape: tuple[int, ...], pixel_um: float | None, description: str
) -> None:
    """Write an image of which only some rows are there at once; the same file as `tiff_bytes` of the whole."""
    rows = iter(bands)
    first = next(rows)
    whole = (*shape, *first.shape[2:])
    place = tifffile.imwrite(
        path, shape=whole, dtype=first.dtype, returnoffset=True, **tiff_options(whole, pixel_um, description)
    )
    assert place is not None
    with path.open("r+b") as file:
        file.seek(place[0])
        for band in chain([first], rows):
            file.write(np.ascontiguousarray(band).data)
        file.flush()
        os.fsync(file.fileno())


def tiff_bytes(image: Array, pixel_um: float | None, description: str) -> bytes:
    """Encode (h, w) or RGB (h, w, 3) as TIFF; the pixel size becomes a resolution in pixels per centimetre."""
    file = BytesIO()
    tifffile.imwrite(file, image, **tiff_options(image.shape, pixel_um, description))
    return file.getvalue()


SPAN_PERCENT = {"min": 0, "p1": 1, "median": 50, "p99": 99, "max": 100}


def span_of(result: FocusResult) -> list[float | None]:
    """Return percentiles of the range, of what is sure where anything is."""
    known = np.isfinite(result.range)
    sure = known & (result.confidence >= result.parameters["confident"])
    trusted = result.range[sure] if sure.any() else result.range[known]
    return list(np.percentile(trusted, list(SPAN_PERCENT.values()))) if trusted.size else [None] * len(SPAN_PERCENT)


def measured(result: FocusResult, span: Sequence[float | None]) -> dict[str, Any]:
    """Return what a report says of a result whose range has these percentiles."""
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "method": result.parameters["method"],
        "unit": result.unit,
        "range": dict(zip(SPAN_PERCENT, span, strict=True)),
        "share_confident": result.share_confident,
        "share_filled": None if result.filled is None else float(np.mean(result.filled)),
        "noise_grey_levels": float(result.noise),
        "parameters": result.parameters,
    }


def about_stack(stack: Stack) -> dict[str, Any]:
    """Describe the input for the report."""
    shape = {"planes": len(stack), "height": stack.shape[0], "width": stack.shape[1], "colour": stack.colour}
    z_um = None if stack.z_um is None else [round(float(z), 6) for z in stack.z_um]
    source = {"source": str(stack.source), **shape, "dtype": str(stack.dtype), "z_um": z_um}
    return {"input": source, "notes": list(stack.notes)}


def versions() -> dict[str, str]:
    """Return what the result was made with."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def peak_memory_mb() -> float:
    """Return the most memory this program ever held; a great parent's is in what `getrusage` says, and not its own."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kibibytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def _plain(value: object) -> object:
    """Turn numpy's numbers and arrays into JSON's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no place in a report")


def write_durably(path: Path, content: bytes | memoryview) -> None:
    """Write a file and wait until the disk has it."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def disk_error(folder: Path, error: OSError, kept: str = "No result was kept.") -> StoreError:
    """Return the words for a disk that refused to take results; ``kept`` says what became of them."""
    if error.errno in FULL:
        nearest = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        free_mb = shutil.disk_usage(nearest).free / 1e6
        return StoreError(
            f"the disk of {folder} is full: {free_mb:.0f} MB are free. {kept}",
            fix=("free some space", "choose another folder: -o DIR"),
            code="disk-full",
        )
    return StoreError(
        f"cannot write to {folder}: {os.strerror(error.errno or 0)}. {kept}",
        fix="choose a folder you may write to: -o DIR",
    )
