"""What steps of a pipeline begin with: a range image, a stack, or bands, as named layers."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from devices.errors import InputError
from processing.memory import check_memory
from processing.neighbours import CUBIC, Spacing, neighbours
from processing.pipeline import Pipeline, Step
from processing.readers import reading
from processing.resample import mean_step
from processing.stack import Stack, open_stack

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Layers = dict[str, Any]

RANGE_FILES = {"range": ("range.tif", "elevation.tif"), "confidence": ("confidence.tif",)}
UM_PER_CM = 1e4
CENTIMETRE = 3  # of the TIFF tag ResolutionUnit
UNKNOWN = "the size of the voxels is not known: lengths are in voxels, which count as cubes."


@dataclass(frozen=True)
class Choices:
    """What a user says about the input; goes before what the file says.

    Attributes
    ----------
    pixel_um, step_um : float, optional
        Size of a pixel and distance of planes.
    channel, time : int, optional
        Which channel and time point, counted from 0.
    bands : tuple of int
        Channels that become the layer ``bands``.
    """

    pixel_um: float | None = None
    step_um: float | None = None
    channel: int | None = None
    time: int | None = None
    bands: tuple[int, ...] = ()


@dataclass(frozen=True)
class Given:
    """An input that was opened but not yet read.

    Attributes
    ----------
    about : dict
        Layers that are no pixels: positions, sizes.
    maps : dict
        Layers of a range image.
    stacks : dict
        The stacks of ``volume`` or of ``bands``.
    notes : tuple of str
        What the user is told.
    scaled : bool
        The size of the voxels is known.
    """

    source: Path
    about: Layers
    maps: Layers = field(default_factory=dict)
    stacks: dict[str, Sequence[Stack]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    scaled: bool = True

    @property
    def names(self) -> list[str]:
        """Names of all layers there are."""
        return [*self.maps, *self.stacks, *self.about]

    @property
    def spacing_um(self) -> Spacing:
        """Distance of voxels along (z, y, x); 1 where it is not known."""
        spacing: Spacing = self.about.get("spacing_um", CUBIC)
        return spacing

    def read(self) -> Layers:
        """Read everything.

        Raises
        ------
        InputError
            ``memory``, or what a plane that cannot be read says.
        """
        stacks = [stack for group in self.stacks.values() for stack in group]
        needed = 3.0 * sum(len(s) * int(np.prod(s.shape)) * s.dtype.itemsize for s in stacks)
        check_memory(needed, f"{self.source} in memory", "go block by block: --memory 2GB")
        pixels = {name: [np.stack([s[k] for k in range(len(s))]) for s in group] for name, group in self.stacks.items()}
        layers = {name: np.stack(volumes) if name == "bands" else volumes[0] for name, volumes in pixels.items()}
        return {**self.maps, **layers, **self.about}


def open_layers(source: Path, choices: Choices) -> Given:
    """Open a range image, a stack, or channels of one."""
    found = range_files(source)
    if "range" in found:
        return _open_maps(source, found, choices)
    if not choices.bands:
        return opened_stack(open_exact(source, choices), choices.pixel_um)
    stacks = [open_exact(source, replace(choices, channel=channel)) for channel in choices.bands]
    if len({(len(s), s.shape) for s in stacks}) > 1:
        raise InputError(f"{source}: its bands differ in size.", fix="name others: --bands 0,1", code="stack-shape")
    first = opened_stack(stacks[0], choices.pixel_um)
    return replace(first, stacks={"bands": stacks})


def open_exact(source: Path, choices: Choices) -> Stack:
    """Open a stack whose values stay as they are, whatever their type."""
    return open_stack(source, step_um=choices.step_um, channel=choices.channel, time=choices.time, exact=True)


def opened_stack(stack: Stack, pixel_um: float | None = None) -> Given:
    """Return a stack as the layer ``volume``, with its sizes and what is to be said about them."""
    pixel = pixel_um if pixel_um is not None else stack.pixel_um
    about: Layers = {name: value for name, value in (("z_um", stack.z_um), ("pixel_um", pixel)) if value is not None}
    if stack.z_um is None or pixel is None or len(stack) < 2:
        spacing, note = CUBIC, UNKNOWN
    else:
        spacing = (mean_step(stack.z_um), pixel, pixel)
        note = neighbours(26, spacing).note
    about["spacing_um"] = spacing
    notes = (*stack.notes, *([note] if note else []))
    return Given(stack.source, about, stacks={"volume": [stack]}, notes=notes, scaled=note != UNKNOWN)


def _open_maps(source: Path, found: dict[str, Path], choices: Choices) -> Given:
    maps = {name: read_map(path) for name, path in found.items()}
    if len({layer.shape for layer in maps.values()}) > 1:
        raise InputError(
            f"{source}: range and confidence differ in size.", fix="give those of one run", code="stack-shape"
        )
    pixel = choices.pixel_um or tiff_pixel_um(found["range"])
    return Given(source, {"pixel_um": pixel} if pixel else {}, maps)


def range_files(source: Path) -> dict[str, Path]:
    """Return the files of a range image; none where ``source`` is a stack."""
    if source.is_dir():
        there = {name: [source / f for f in files if (source / f).is_file()] for name, files in RANGE_FILES.items()}
        return {name: files[0] for name, files in there.items() if files}
    if source.is_file() and source.suffix.lower() in {".tif", ".tiff"}:
        with reading(source), tifffile.TiffFile(source) as file:
            page: Any = file.pages.first
            if len(file.pages) == 1 and page.dtype.kind == "f" and len(page.shape) == 2:
                return {"range": source}
    return {}


def read_map(path: Path) -> NDArray[np.float32]:
    """Read a map; infinite values count as not known."""
    with reading(path):
        values = np.asarray(tifffile.imread(path), np.float32)
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def tiff_pixel_um(path: Path) -> float | None:
    """Return the size of a pixel that our TIFFs carry."""
    with reading(path), tifffile.TiffFile(path) as file:
        tags: Any = file.pages.first.tags
        if "XResolution" not in tags or int(tags["ResolutionUnit"].value) != CENTIMETRE:
            return None
        over, under = tags["XResolution"].value
        return UM_PER_CM * under / over if over else None


def read_steps(path: Path | None, words: tuple[str, ...]) -> Pipeline:
    """Return the steps of a file, or those of the command line.

    Raises
    ------
    InputError
        ``operator-params``: none at all, or both; ``input-missing``, ``input-damaged``.
    """
    if (path is None) == (not words):
        raise InputError(
            "steps are named on the command line or in a file.", fix="range.median:side_px=5", code="operator-params"
        )
    if path is None:
        return Pipeline(tuple(Step.parse(word) for word in words))
    if not path.is_file():
        raise InputError(f"there is no {path}.", fix="check the name.", code="input-missing")
    with reading(path):
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("step", [])
    pipeline = Pipeline.from_tables(tables)
    if not pipeline.steps:
        raise InputError(
            f"{path} holds no step.", fix='write [[step]] with operator = "family.name"', code="operator-params"
        )
    return pipeline
