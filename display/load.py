"""From files to what a scene holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.progress import progress
from acquire.store import is_run
from devices.errors import InputError
from display.scene import Band, Volume
from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

LIMITS_PERCENT = (0.0, 99.95)
SAMPLES = 2_000_000  # voxels that are looked at for the limits
EVEN = 1e-3  # spacings that differ by less are equal
ADDITIVE = ("#ff0000", "#00ff00", "#0000ff", "#ff00ff", "#ffff00", "#00ffff", "#ff8000", "#8000ff")
RGB = ADDITIVE[:3]


def load_volume(
    path: Path,
    *,
    step_um: float | None = None,
    channels: Iterable[int] | None = None,
    planes_are_bands: bool = False,
    quiet: bool = True,
) -> Volume:
    """Read a stack as a volume.

    Parameters
    ----------
    path : Path
        What `processing.stack.open_stack` reads.
    step_um : float, optional
        Distance of planes; goes before what the file says.
    channels : iterable of int, optional
        Channels to take as bands; the only one when left out.
    planes_are_bands : bool
        Every plane is a band of one plane of depth.
    quiet : bool
        Show no progress.

    Returns
    -------
    Volume
        Planes at equal steps: where they are not, the nearest plane stands in, and ``notes`` says so. In a run the
        plane at the highest z is nearest to the viewer, elsewhere plane 0.

    Raises
    ------
    InputError
        As `open_stack`.
    """
    stacks = [open_stack(path, step_um=step_um, channel=channel) for channel in channels or (None,)]
    arrays = [array for stack in stacks for array in _bands(_read(stack, quiet=quiet))]
    if planes_are_bands:
        arrays = [plane[None] for array in arrays for plane in array]
    first, notes = stacks[0], list(stacks[0].notes)
    spacing, unit = _spacing(first, planes_are_bands=planes_are_bands)
    if first.z_um is not None and not planes_are_bands:
        arrays, spacing, said = _evenly(arrays, first.z_um, spacing)
        notes += said
    if is_run(path) and first.z_um is not None and first.z_um[-1] > first.z_um[0]:
        arrays = [np.ascontiguousarray(array[::-1]) for array in arrays]
    depth = "t" if any("along time" in note for note in first.notes) else "z"
    return Volume(tuple(_named(arrays)), spacing, unit, depth, tuple(notes))


def as_volume(values: Array, *, spacing_um: tuple[float, float, float] = (1, 1, 1), colour: str = "gray") -> Volume:
    """Return an array (z, y, x), uint8 or uint16, as a volume of one band."""
    values = np.ascontiguousarray(values)
    return Volume((Band(values, limits_of(values), colour=colour),), spacing_um)


def limits_of(values: Array) -> tuple[float, float]:
    """Return the values shown as nothing and as full: the smallest, and what only 0.05 % exceed."""
    stride = max(values.size // SAMPLES, 1)
    low, high = np.percentile(values.reshape(-1)[::stride], LIMITS_PERCENT)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def _read(stack: Stack, *, quiet: bool) -> Array:
    volume = np.empty((len(stack), *stack.shape), stack.dtype)
    with progress("reading planes", len(stack), quiet=quiet) as tell:
        for k in range(len(stack)):
            volume[k] = stack[k]
            tell(k + 1)
    return volume


def _bands(volume: Array) -> list[Array]:
    return [volume] if volume.ndim == 3 else [np.ascontiguousarray(volume[..., c]) for c in range(volume.shape[3])]


def _named(arrays: list[Array]) -> Iterable[Band]:
    if len(arrays) == 1:
        yield Band(arrays[0], limits_of(arrays[0]))
        return
    if len(arrays) > len(ADDITIVE):
        raise InputError(f"{len(arrays)} bands are too many to be told apart.", fix="choose some: --channels 0,1,2")
    for k, array in enumerate(arrays):
        yield Band(array, limits_of(array), name=f"band {k}", colour=ADDITIVE[k])


def _spacing(stack: Stack, *, planes_are_bands: bool) -> tuple[tuple[float, float, float], str]:
    """Return (z, y, x) and their unit; lengths are in voxels unless all are known in µm."""
    pixel = stack.pixel_um
    if planes_are_bands or len(stack) == 1:
        return ((pixel,) * 3, "µm") if pixel else ((1.0, 1.0, 1.0), "voxels")
    if stack.z_um is None or pixel is None:
        return (1.0, 1.0, 1.0), "voxels"
    step = float(np.abs(np.diff(stack.z_um)).mean())
    return (step, pixel, pixel), "µm"


def _evenly(
    arrays: list[Array], z_um: NDArray[np.float64], spacing: tuple[float, float, float]
) -> tuple[list[Array], tuple[float, float, float], list[str]]:
    """Repeat planes so that all lie at equal steps: the smallest distance there is."""
    steps = np.abs(np.diff(z_um))
    if not steps.size or np.ptp(steps) <= EVEN * steps.mean():
        return arrays, spacing, []
    relative = float(steps.min() / steps.mean())
    count = round(float(steps.sum() / steps.min())) + 1
    places = np.abs(z_um - z_um[0])
    nearest = np.abs(places[:, None] - np.linspace(0, places[-1], count)).argmin(axis=0)
    words = f"planes lie {steps.min():.4g} to {steps.max():.4g} µm apart: each is shown as thick as it stands for"
    thinner = (spacing[0] * relative, *spacing[1:])
    return [np.ascontiguousarray(array[nearest]) for array in arrays], thinner, [words]
