"""A volume as it was stored: its own values, never mapped, with what is known of its scale."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.progress import progress
from devices.errors import InputError
from processing.memory import check_memory
from processing.neighbours import CUBIC, Spacing, checked_spacing
from processing.planes import SIDE, Lazy
from processing.readers import Choice, Recording, as_picture, reading
from processing.resample import mean_step
from processing.stack import guarded, plausible_pixel, positions, read_any

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

EVEN = 0.01  # of the mean step; planes that differ by more are said to
SMALLER = "bin it first: stereotome process resample --bin 2; stereotome measure --memory 2GB goes slab by slab"
WORK_COPIES = 3  # of the volume that a measurement holds at most


@dataclass(frozen=True)
class GreyVolume:
    """Values and scale.

    Attributes
    ----------
    values : array, or volume to be read slab by slab (`processing.planes.Lazy`); (z, y, x)
        Of the type they were stored in.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x); None when it is not known.
    start_um : float
        Where the first plane is.
    source : str
    notes : tuple of str
        What was assumed, in words for the user.
    reversed : bool
        The file has its planes from high to low z; here they rise.
    """

    values: Any
    spacing_um: Spacing | None = None
    start_um: float = 0.0
    source: str = ""
    notes: tuple[str, ...] = ()
    reversed: bool = False

    @property
    def spacing(self) -> Spacing:
        """Distance of voxels; of cubes of size 1 when it is not known."""
        return self.spacing_um or CUBIC

    @property
    def unit(self) -> str:
        """Of lengths."""
        return "µm" if self.spacing_um else "voxels"


def read_volume(
    path: Path | str,
    *,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    quiet: bool = True,
) -> GreyVolume:
    """Read all of a volume that `processing.stack.open_stack` would read, its values as they are.

    Parameters
    ----------
    pixel_um, step_um : float, optional
        Size of a pixel and distance of planes; go before what the file says.
    channel, time : int, optional
        Which one to take, counted from 0.
    quiet : bool
        Show no progress.

    Raises
    ------
    InputError
        As `open_stack`; ``volume-shape`` for colour; ``spacing``, ``memory``.
    """
    opened = open_volume(path, pixel_um=pixel_um, step_um=step_um, channel=channel, time=time)
    planes = opened.values
    needed = WORK_COPIES * planes.dtype.itemsize * float(np.prod(planes.shape))
    check_memory(needed, opened.source, SMALLER)
    values = np.empty(planes.shape, planes.dtype)
    with progress("reading planes", len(planes), quiet=quiet) as tell:
        for k in range(len(planes)):
            values[k] = planes[k : k + 1][0]
            tell(k + 1)
    return replace(opened, values=values)


def open_volume(
    path: Path | str,
    *,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    side: int = SIDE,
) -> GreyVolume:
    """Open a volume as `read_volume` does, its planes to be read when they are asked for, ``side`` of them at once."""
    source = Path(path)
    with reading(source):
        recording = read_any(source, Choice(channel, time))
    if not recording.count:
        raise InputError(f"{source} holds no plane.", fix="give a stack of at least one plane.", code="stack-empty")
    recording = plausible_pixel(guarded(source, recording))
    z_um, said = positions(recording, step_um)
    spacing, notes = _spacing(recording, z_um, pixel_um)
    falling = z_um is not None and bool(z_um[0] > z_um[-1])
    values = _planes(recording, source, falling=falling, side=side)
    start_um = 0.0 if z_um is None or spacing is None else float(z_um[-1 if falling else 0])
    return GreyVolume(values, spacing, start_um, str(source), (*recording.notes, *said, *notes), falling)


def _planes(recording: Recording, source: Path, *, falling: bool, side: int) -> Lazy:
    """Return the planes in rising order."""
    first = as_picture(recording.read(0))
    if first.ndim != 2:
        raise InputError(
            f"{source} is in colour; one value for each voxel is needed.",
            fix="save one band, or give a file with channels and choose one: --channel N",
            code="volume-shape",
        )
    order = range(recording.count)[::-1] if falling else range(recording.count)

    def plane(k: int) -> Array:
        pixels = as_picture(recording.read(k))
        if pixels.shape != first.shape:
            raise InputError(
                f"{source}: {recording.label(0)} is {first.shape}, {recording.label(k)} is {pixels.shape}.",
                fix="give planes of one size; put images that do not belong to the stack elsewhere.",
                code="stack-shape",
            )
        return pixels.astype(first.dtype, copy=False)

    return Lazy((recording.count, *first.shape), first.dtype, lambda z: np.stack([plane(k) for k in order[z]]), side)


def _spacing(
    recording: Recording, z_um: NDArray[np.float64] | None, pixel_um: float | None
) -> tuple[Spacing | None, list[str]]:
    pixel = pixel_um if pixel_um is not None else recording.pixel_um
    if pixel is None or (z_um is None and recording.count > 1):
        missing = " and ".join(w for w, known in (("pixels", pixel), ("steps", z_um)) if known is None)
        words = f"the size of {missing} is not known: lengths are in voxels, which count as cubes of side 1"
        return None, [f"{words}; give --pixel-um and --step-um for µm."]
    if z_um is None:
        return checked_spacing((pixel, pixel, pixel)), ["one plane: it counts as thick as a pixel is wide."]
    step = mean_step(z_um)
    uneven = float(np.abs(np.abs(np.diff(z_um)) / step - 1).max())
    notes = [f"steps differ by up to {uneven:.0%}: their mean is taken; resample for more."] if uneven > EVEN else []
    return checked_spacing((step, pixel, pixel)), notes
