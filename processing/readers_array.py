"""Bare arrays (NPY, NPZ) and NIfTI volumes as stacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.readers import Choice, Recording, lay_out, to_um

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

ARRAYS = frozenset({".npy", ".npz"})
SAMPLES = frozenset({3, 4})  # a last axis of this length is colour
NIFTI_AXES = "xyztcuv"
ISOTROPIC = 0.02  # pixels whose sides differ by more have no one size


def is_nifti(path: Path) -> bool:
    """Tell from its name whether a file is a NIfTI volume."""
    return path.name.lower().endswith((".nii", ".nii.gz"))


def read_array(path: Path, choice: Choice) -> Recording:
    """Read an NPY or NPZ file as a stack of axes (z, y, x) or (z, y, x, bands).

    Raises
    ------
    InputError
        Damaged, no numbers, not one stack.
    """
    array = _load_npz(path) if path.suffix.lower() == ".npz" else np.load(path, mmap_mode="r", allow_pickle=False)
    layout = lay_out(_guess_axes(path, array.shape), array.shape, choice, path)
    return Recording(layout.count, lambda k: layout.upright(np.asarray(array[layout.index(k)])), notes=layout.notes)


def _load_npz(path: Path) -> Array:
    # opened here, because the library leaves a damaged archive open
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        return _only_stack(path, dict(archive))


def _only_stack(path: Path, arrays: Mapping[str, Array]) -> Array:
    most = max((array.ndim for array in arrays.values()), default=0)
    found = [name for name, array in arrays.items() if array.ndim == most]
    if most < 2 or len(found) > 1:
        raise InputError(
            f"{path} holds no single stack: its arrays are {', '.join(f'{n} {a.shape}' for n, a in arrays.items())}.",
            fix="save the stack alone, with axes (z, y, x).",
            code="stack-axes",
        )
    return arrays[found[0]]


def _guess_axes(path: Path, shape: tuple[int, ...]) -> str:
    colour = len(shape) > 2 and shape[-1] in SAMPLES
    axes = {2: "yx", 3: "zyx"}.get(len(shape) - colour)
    if axes is None or 0 in shape:
        raise InputError(
            f"{path} has shape {shape}.",
            fix="give an array with axes (z, y, x), or (z, y, x, 3) in colour.",
            code="stack-axes",
        )
    return axes + "s" * colour


def read_nifti(path: Path, choice: Choice) -> Recording:
    """Read a NIfTI volume as a stack along its third axis; planes are (y, x).

    Raises
    ------
    InputError
        Damaged, or no volume.
    """
    image = _nifti(path)
    volume = _with_samples(np.asanyarray(image.dataobj))
    sizes, (unit, _) = image.header.get_zooms(), image.header.get_xyzt_units()
    axes = NIFTI_AXES[: len(image.shape)] + "s" * (volume.ndim - len(image.shape))
    layout = lay_out(axes, volume.shape, choice, path)
    # a volume without a unit is in millimetres by the custom of the field
    x, y, *z = (to_um(float(size), "mm" if unit == "unknown" else unit) or 0.0 for size in sizes[:3])
    notes = ["the file names no unit of length: millimetres assumed."] if unit == "unknown" else []
    return Recording(
        layout.count,
        lambda k: layout.upright(volume[layout.index(k)]),
        step_um=z[0] if z else None,
        pixel_um=x if abs(x - y) <= ISOTROPIC * x else None,
        notes=(*layout.notes, *notes),
    )


def _nifti(path: Path) -> Any:
    """Open a volume; raises ValueError when it is damaged."""
    import nibabel  # noqa: PLC0415  other files do without
    from nibabel.filebasedimages import ImageFileError  # noqa: PLC0415
    from nibabel.spatialimages import HeaderDataError  # noqa: PLC0415

    try:
        return nibabel.load(path)
    except (HeaderDataError, ImageFileError) as cause:
        raise ValueError(str(cause)) from cause


def _with_samples(volume: Array) -> Array:
    """Give colour, which NIfTI keeps as one record a voxel, an axis of its own."""
    if volume.dtype.names is None:
        return volume
    return np.stack([volume[name] for name in volume.dtype.names], axis=-1)
