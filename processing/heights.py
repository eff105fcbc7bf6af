"""Range images from files: TIFF, NPY, NPZ and, with the extra ``heights``, the formats of many instruments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from devices.errors import InputError
from processing.readers import reading, to_um

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

NAMES = ("height_um", "range_um", "range", "heights", "height", "elevation", "z")  # of arrays in NPZ files, best first
PIXELS = ("pixel_um", "pixel")
UM_PER_CM, UM_PER_INCH = 1e4, 25400.0
PER_UNIT = {2: UM_PER_INCH, 3: UM_PER_CM}  # of a TIFF's resolution
SMALLEST = 2
READER = "SurfaceTopography"


@dataclass(frozen=True, eq=False)
class Heights:
    """A range image.

    Attributes
    ----------
    values : array (y, x) float32
        Height, larger nearer to the viewer; NaN where nothing is known. At least 2 × 2, at least one known.
    pixel : (float, float)
        Size of a pixel along (y, x), in ``unit``.
    unit : str
        Of heights and pixels alike.
    notes : tuple of str
        What was assumed.
    """

    values: Array
    pixel: tuple[float, float] = (1.0, 1.0)
    unit: str = "µm"
    notes: tuple[str, ...] = ()

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest known height; a little apart where all is flat."""
        low, high = float(np.nanmin(self.values)), float(np.nanmax(self.values))
        return (low, high) if high > low else (low - 0.5, high + 0.5)


def read_heights(path: Path, *, pixel: float | None = None, unit: str | None = None) -> Heights:
    """Read a range image.

    Parameters
    ----------
    path : Path
        TIFF of one plane, NPY, NPZ with an array called `NAMES`, or a file that SurfaceTopography reads.
    pixel : float, optional
        Size of a pixel; goes before what the file says. Where neither says, 1, and ``notes`` says so.
    unit : str, optional
        What heights and pixels are measured in; goes before what the file says.

    Raises
    ------
    InputError
        No such file, not a range image, or a format that needs the extra.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such file.", fix="check the name.", code="input-missing")
    reader = {".tif": _tiff, ".tiff": _tiff, ".npy": _npy, ".npz": _npz}.get(path.suffix.lower(), _instrument)
    with reading(path):
        found = checked(path, reader(path))
    if pixel is not None:
        found = replace(found, pixel=(pixel, pixel), notes=())
    if not all(np.isfinite(p) and p > 0 for p in found.pixel):
        raise InputError(f"{path}: a pixel of {found.pixel} is none.", fix="give its size: --pixel 0.5", code="input")
    return found if unit is None else replace(found, unit=unit)


def checked(path: Path, heights: Heights) -> Heights:
    """Return range images in order, raise `InputError` for what is none."""
    values = np.asarray(heights.values)
    if values.ndim != 2 or min(values.shape) < SMALLEST or not np.issubdtype(values.dtype, np.number):
        raise InputError(
            f"{path}: no range image: {' × '.join(map(str, values.shape))} {values.dtype}.",
            fix=("give an image of one plane, a height in each pixel.", "of a stack: stereotome process focus"),
            code="heights",
        )
    known = np.where(np.isfinite(values), values, np.nan).astype(np.float32)
    if np.isnan(known).all():
        raise InputError(f"{path}: no pixel of the range image has a height.", code="heights")
    return replace(heights, values=np.ascontiguousarray(known))


def _tiff(path: Path) -> Heights:
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        if len(file.pages) != 1 and len(file.series[0].shape) != 2:
            return Heights(np.empty((len(file.pages), *page.shape), np.float32))
        tags, values = page.tags, page.asarray()
        per = PER_UNIT.get(int(tags["ResolutionUnit"].value)) if "ResolutionUnit" in tags else None
        sides = [_per_pixel(tags, name, per) for name in ("YResolution", "XResolution")]
        in_planes = "planes" in str(tags["ImageDescription"].value) if "ImageDescription" in tags else False
    unit = "planes" if in_planes else "µm"
    if sides[0] is None or sides[1] is None or in_planes:
        return Heights(values, unit=unit, notes=(f"the file does not say how large a pixel is: taken as 1 {unit}.",))
    return Heights(values, (sides[0], sides[1]), unit)


def _per_pixel(tags: Any, name: str, per: float | None) -> float | None:
    if per is None or name not in tags:
        return None
    above, below = tags[name].value
    return per * below / above if above else None


def _npy(path: Path) -> Heights:
    return Heights(
        np.load(path, allow_pickle=False), notes=("the file does not say how large a pixel is: taken as 1.",)
    )


def _npz(path: Path) -> Heights:
    with np.load(path, allow_pickle=False) as file:
        name = next((name for name in NAMES if name in file), None)
        if name is None:
            raise InputError(
                f"{path}: holds {', '.join(file.files) or 'nothing'}; none is called {', '.join(NAMES)}.",
                fix="name the array height_um.",
                code="heights",
            )
        pixel = next((np.broadcast_to(file[key], 2) for key in PIXELS if key in file), None)
        values = file[name]
    if pixel is None:
        return Heights(values, notes=("the file does not say how large a pixel is: taken as 1.",))
    return Heights(values, (float(pixel[0]), float(pixel[1])))


def _instrument(path: Path) -> Heights:
    """Read a file of an instrument's maker; lengths become µm."""
    if find_spec(READER) is None:
        raise InputError(
            f"{path}: reading files of instruments needs an extra.",
            fix=("pip install 'stereotome[heights]'", "or export the heights as TIFF or NPZ."),
            code="extra-missing",
        )
    from SurfaceTopography import open_topography  # type: ignore[import-not-found,unused-ignore]  # noqa: PLC0415
    from SurfaceTopography.Exceptions import (  # type: ignore[import-not-found,unused-ignore]  # noqa: PLC0415
        CannotDetectFileFormat,
    )

    try:
        found = open_topography(str(path)).topography()
    except (CannotDetectFileFormat, UnicodeDecodeError):
        raise InputError(
            f"{path}: a format that nobody here knows.", fix="export the heights as TIFF or NPZ.", code="heights"
        ) from None
    scale = to_um(1.0, str(found.unit))
    unit, factor = (str(found.unit), 1.0) if scale is None else ("µm", scale)
    values = np.ma.filled(np.ma.asarray(found.heights(), dtype=np.float64), np.nan).T * factor
    across, down = (float(size) * factor for size in found.physical_sizes)
    return Heights(values, (down / values.shape[0], across / values.shape[1]), unit)
