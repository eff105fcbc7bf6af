"""A focal stack from disk, whatever wrote it: planes read one at a time, their positions, and what was assumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from acquire.store import is_run
from devices.errors import InputError
from processing.readers import Choice, Recording, as_picture, reading
from processing.readers_array import ARRAYS, is_nifti, read_array, read_nifti
from processing.readers_folder import is_image, is_tiff, read_files, read_folder
from processing.readers_run import read_run
from processing.readers_tiff import read_tiff
from processing.readers_zarr import is_zarr, read_zarr

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

FULL_SCALE = 65535
PIXEL_UM = (5e-5, 1e5)  # half an ångström to a tenth of a metre
CAMERA_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16))


class Stack(Sequence["Array"]):
    """Planes of one size, in order, read when they are asked for.

    Attributes
    ----------
    source : Path
        What was opened.
    z_um : array (planes,) float64, optional
        Position of every plane, strictly rising or falling; None when unknown.
    pixel_um : float, optional
        Size of a pixel in the specimen.
    notes : tuple of str
        What was assumed, in words for the user.
    shape : tuple of int
        Of one plane: (height, width) or (height, width, 3).
    dtype : numpy.dtype
        uint8 or uint16, or that of the file where it was opened as it is.
    """

    def __init__(self, source: Path, recording: Recording, z_um: NDArray[np.float64] | None) -> None:
        first = recording.read(0)
        self.source = source
        self.z_um = z_um
        self.pixel_um = recording.pixel_um
        self.notes = recording.notes
        self.shape = first.shape
        self.dtype = first.dtype
        self._recording = recording

    def __len__(self) -> int:
        return self._recording.count

    @overload
    def __getitem__(self, index: int) -> Array: ...
    @overload
    def __getitem__(self, index: slice) -> list[Array]: ...
    def __getitem__(self, index: int | slice) -> Array | list[Array]:
        picked = range(len(self))[index]
        return self.plane(picked) if isinstance(picked, int) else [self.plane(k) for k in picked]

    @property
    def colour(self) -> bool:
        """True when planes are (height, width, 3)."""
        return len(self.shape) == 3

    def plane(self, k: int) -> Array:
        """Return plane ``k``, (height, width) or (height, width, 3), uint8 or uint16.

        Raises
        ------
        InputError
            The plane is damaged, or differs from the first one in size or type.
        """
        pixels = self._recording.read(range(len(self))[k])
        if (pixels.shape, pixels.dtype) != (self.shape, self.dtype):
            label = self._recording.label
            raise InputError(
                f"{self.source}: {label(0)} is {_words(self.shape, self.dtype)}, "
                f"{label(k)} is {_words(pixels.shape, pixels.dtype)}.",
                fix="give planes of one size and type; put images that do not belong to the stack elsewhere.",
                code="stack-shape",
            )
        return pixels


def _words(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    return f"{shape[1]}×{shape[0]} px {'colour' if len(shape) == 3 else 'grey'} {dtype}"


def open_stack(
    path: Path | str,
    *,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    exact: bool = False,
) -> Stack:
    """Open a stack of planes from a file or folder.

    Parameters
    ----------
    path : path
        A run folder, OME-Zarr, TIFF or OME-TIFF, a folder of PNG, JPEG or TIFF images (or a pattern such as
        ``"folder/pcb_*.jpg"``), NPY, NPZ or NIfTI.
    step_um : float, optional
        Distance of planes in µm; goes before what the file says.
    channel, time : int, optional
        Which channel (or image series) and time point to take, counted from 0.
    exact : bool
        Pixels keep their type and values; else they become 8 or 16 bit, see `camera_depth`.

    Returns
    -------
    Stack
        Never empty. ``notes`` says what was assumed.

    Raises
    ------
    InputError
        The input is missing, damaged, of an unknown kind, not one stack, or its spacing makes no sense.
    """
    source = Path(path)
    with reading(source):
        recording = read_any(source, Choice(channel, time))
    if not recording.count:
        raise InputError(f"{source} holds no plane.", fix="give a stack of at least one plane.", code="stack-empty")
    recording = plausible_pixel((as_pictures if exact else camera_depth)(guarded(source, recording)))
    z_um, said = positions(recording, step_um)
    recording = replace(recording, notes=(*recording.notes, *said))
    return _in_order(source, recording, z_um)


def read_any(source: Path, choice: Choice) -> Recording:
    """Find the reader for ``source`` and let it read."""
    if source.is_dir():
        return _read_folder(source, choice)
    if source.is_file():
        return _file_reader(source)(source, choice)
    matching = [path for path in source.parent.glob(source.name) if is_image(path)]
    if matching:
        return read_files(matching, choice, source)
    raise InputError(f"there is no {source}.", fix="check the name.", code="input-missing")


def guarded(source: Path, recording: Recording) -> Recording:
    """Have every plane that cannot be read named."""

    def read(k: int) -> Array:
        with reading(f"{source}: {recording.label(k)}"):
            return recording.read(k)

    return replace(recording, read=read)


def _read_folder(source: Path, choice: Choice) -> Recording:
    if is_run(source):
        return read_run(source, choice)
    if is_run(source.parent):  # the image within a run: its journal knows more than the image
        return read_run(source.parent, choice)
    return read_zarr(source, choice) if is_zarr(source) else read_folder(source, choice)


def _file_reader(source: Path) -> Callable[[Path, Choice], Recording]:
    if is_tiff(source):
        return read_tiff
    if is_image(source):
        return lambda path, choice: read_files([path], choice, path)
    if is_nifti(source):
        return read_nifti
    if source.suffix.lower() in ARRAYS:
        return read_array
    raise InputError(
        f"{source} is of no known kind.",
        fix="give a run folder, OME-Zarr, TIFF, a folder of PNG, JPEG or TIFF images, NPY, NPZ or NIfTI.",
        code="input-unknown",
    )


def positions(recording: Recording, step_um: float | None) -> tuple[NDArray[np.float64] | None, list[str]]:
    """Return the position of every plane in µm, None if unknown, and what to say about it."""
    places = np.arange(recording.count, dtype=np.float64) if recording.places is None else recording.places
    if recording.count == 1:
        said = ["one plane: it is its own extended focus, and nothing can be said about depth."]
        return None, said
    if step_um is not None:
        return checked_step(step_um, "--step-um") * places, _overruled(recording, step_um)
    if recording.z_um is not None and np.ptp(recording.z_um) != 0:
        return recording.z_um, []
    if recording.step_um is not None:
        step = checked_step(abs(recording.step_um), "the file") * math.copysign(1, recording.step_um)
        return recording.start_um + step * places, []
    return None, ["no spacing of planes is known: depth is in planes counted from 0; give --step-um for µm."]


def _overruled(recording: Recording, step_um: float) -> list[str]:
    known = recording.step_um
    if recording.z_um is not None:
        known = float(np.ptp(recording.z_um)) / (recording.count - 1)
    if known is None or math.isclose(abs(known), step_um, rel_tol=1e-3):
        return []
    return [f"--step-um {step_um:g} goes before the {abs(known):g} µm the file says."]


def plausible_pixel(recording: Recording) -> Recording:
    """Drop a pixel size no microscope has: files name a unit and mean another one, or give 0."""
    size = recording.pixel_um
    if size is None or PIXEL_UM[0] <= size <= PIXEL_UM[1]:
        return recording
    said = f"the file gives a pixel size of {size:g} µm, which cannot be, and is left out."
    return replace(recording, pixel_um=None, notes=(*recording.notes, said))


def checked_step(step_um: float, origin: str) -> float:
    """Return ``step_um`` if it is a positive number, else raise `InputError`."""
    if math.isfinite(step_um) and step_um > 0:
        return step_um
    raise InputError(
        f"{origin} gives a plane spacing of {step_um:g} µm.",
        fix="give the distance of planes as a positive number: --step-um 2.5",
        code="stack-spacing",
    )


def _in_order(source: Path, recording: Recording, z_um: NDArray[np.float64] | None) -> Stack:
    """Put planes in the order of their positions; a stage that was sent to and fro is no reason to refuse."""
    if z_um is None:
        return Stack(source, recording, None)
    if not np.isfinite(z_um).all() or np.unique(z_um).size < z_um.size:
        raise InputError(
            f"{source}: the file's z positions are not a number for each plane, all different.",
            fix="give the distance of planes: --step-um S",
            code="stack-spacing",
        )
    steps = np.diff(z_um)
    if (steps > 0).all() or (steps < 0).all():
        return Stack(source, recording, z_um)
    order = np.argsort(z_um)
    read, label = recording.read, recording.label
    ordered = replace(
        recording,
        read=lambda k: read(order[k]),
        label=lambda k: label(order[k]),
        notes=(*recording.notes, "planes were put in the order of their z positions."),
    )
    return Stack(source, ordered, z_um[order])


def as_pictures(recording: Recording) -> Recording:
    """Have every plane as grey or RGB, of its own number type; raises `InputError` where pixels are no numbers."""
    read = recording.read
    dtype = read(0).dtype
    if dtype.kind not in "biuf":
        raise InputError(f"Pixels are of type {dtype}.", fix="give pixels that are numbers.", code="stack-dtype")
    return replace(recording, read=lambda k: as_picture(read(k)))


def camera_depth(recording: Recording) -> Recording:
    """Have every plane as grey or RGB of 8 or 16 bit; other number types are mapped to 16 bit and said so.

    Whole numbers within 0 … 65535 keep their values. All else is mapped linearly, smallest value of the stack to 0,
    largest to 65535.

    Raises
    ------
    InputError
        Pixels that are no numbers.
    """
    read = recording.read
    dtype = read(0).dtype
    if dtype in CAMERA_TYPES:
        return replace(recording, read=lambda k: as_picture(read(k)))
    if dtype.kind not in "biuf":
        raise InputError(f"Pixels are of type {dtype}.", fix="give 8 or 16 bit planes.", code="stack-dtype")
    low, high = value_range(recording)
    if dtype.kind in "biu" and low >= 0 and high <= FULL_SCALE:
        return replace(recording, read=lambda k: as_picture(read(k)).astype(np.uint16))
    words = f"{dtype} pixels: {low:g} … {high:g} is mapped to 0 … {FULL_SCALE}."
    return replace(recording, read=_mapped(read, low, high), notes=(*recording.notes, words))


def _mapped(read: Callable[[int], Array], low: float, high: float) -> Callable[[int], Array]:
    scale = FULL_SCALE / (high - low) if high > low else 0.0
    return lambda k: np.rint((as_picture(read(k)).astype(np.float64) - low) * scale).astype(np.uint16)


def value_range(recording: Recording) -> tuple[float, float]:
    """Return the smallest and the largest pixel of all planes; raise `InputError` where one is not a number."""
    extremes = []
    for k in range(recording.count):
        plane = recording.read(k)
        if not np.isfinite(plane).all():
            raise InputError(
                f"{recording.label(k)} has pixels that are not numbers (NaN or infinite).",
                fix="replace them, for example by 0.",
                code="stack-nan",
            )
        extremes.append((float(plane.min()), float(plane.max())))
    return min(low for low, _ in extremes), max(high for _, high in extremes)
