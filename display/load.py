"""From files to what a scene holds."""

from __future__ import annotations

import csv
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.progress import progress
from acquire.store import is_run
from devices.errors import InputError
from display.scene import Band, Transfer, Volume
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
RATIO_FLOOR = 0.1


def load_volume(
    path: Path,
    *,
    step_um: float | None = None,
    channels: Iterable[int] | None = None,
    planes_are_bands: bool = False,
    ratio: tuple[int, int] | None = None,
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
    ratio : (int, int), optional
        Show one band divided by another one.
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
    bands = tuple(_named(arrays)) if ratio is None else (_ratio(arrays, *ratio),)
    return Volume(bands, spacing, unit, depth, tuple(notes))


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


def _ratio(arrays: list[Array], above: int, below: int) -> Band:
    """Return a band whose full is the 99.5 percentile of the ratio; 0 where the lower band is below a tenth of full."""
    if max(above, below) >= len(arrays):
        raise InputError(f"there are {len(arrays)} bands, counted from 0.", fix="--ratio 0/1", code="usage")
    bottom = arrays[below].astype(np.float32)
    clear = bottom > RATIO_FLOOR * limits_of(arrays[below])[1]
    ratio = np.where(clear, arrays[above] / np.maximum(bottom, 1), 0)
    top = float(np.percentile(ratio[clear], 99.5)) if clear.any() else 1.0
    values = np.rint(np.clip(ratio / (top or 1.0), 0, 1) * 65535).astype(np.uint16)
    return Band(values, (0, 65535), f"band {above} / band {below}, full = {top:.3g}", colour="viridis")


def read_transfer(path: Path) -> tuple[Transfer, tuple[tuple[float, float, float, float], ...] | None]:
    """Read a table of opacity, and of colour where it has columns for it.

    Parameters
    ----------
    path : Path
        CSV with a line of names: value, opacity (0 to 1 over the smallest side of a voxel) and red, green, blue (0 to
        1), or either of them.

    Raises
    ------
    InputError
        ``opacity-table``: missing, not such a table, or values that do not rise.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{key.strip(): float(item) for key, item in row.items()} for row in csv.DictReader(file)]
        values = [row["value"] for row in rows]
        points = tuple((row["value"], row["opacity"]) for row in rows if "opacity" in row)
        colours = tuple((row["value"], row["red"], row["green"], row["blue"]) for row in rows if "red" in row)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise _no_table(path, f"{type(error).__name__}: {error}") from None
    shares = [share for row in (*points, *colours) for share in row[1:]]
    if len(values) < 2 or any(b <= a for a, b in pairwise(values)) or not all(0 <= share <= 1 for share in shares):
        raise _no_table(path, "values have to rise, at least two of them; opacity and colours lie between 0 and 1.")
    return Transfer(points), colours or None


def _no_table(path: Path, why: str) -> InputError:
    fix = "lines such as: value,opacity,red,green,blue / 0,0,0,0,0 / 255,0.3,1,1,1"
    return InputError(f"{path} is no table of opacities.", why=why, fix=fix, code="opacity-table")


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
