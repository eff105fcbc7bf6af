"""Volumes larger than memory: steps taken on slabs of whole planes, each written to OME-Zarr and then marked as done.

A slab is a task that stands for itself: it reads its planes and as many around them as its steps look at, and writes
shards that no other slab touches. So slabs can be taken in any order, by threads or other machines, more than once, and
left for another day. Whole planes, because a shard is a plane: two writers of one shard lose data silently.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from processing.block_source import when_changed
from processing.marked import Marked
from processing.step_inputs import Choices, Given, open_layers
from processing.tiles import tiles
from processing.volume_files import create_volume, write_plane
from processing.volume_filters import TYPES

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.ome_zarr import FocalArray
    from processing.pipeline import Pipeline
    from processing.tiles import Tile

    Array = NDArray[Any]

LABELS = "uint32"


def kernel_type(dtype: np.dtype[Any]) -> str:
    """Return the type in which planes of ``dtype`` are handed to operators."""
    if dtype == np.bool_:
        return "uint8"
    return dtype.name if dtype.name in (*TYPES, LABELS) else "float32"


@lru_cache(maxsize=4)
def _opened(source: Path, choices: Choices, _changed: int) -> Given:
    return open_layers(source, choices)


@dataclass(frozen=True)
class Volumes:
    """Where the layers lie: in the input, or in arrays that steps before have made.

    Attributes
    ----------
    source, choices
        The input.
    made : tuple of (name, path)
        OME-Zarr images of layers that have been made since.
    """

    source: Path
    choices: Choices
    made: tuple[tuple[str, Path], ...] = ()

    @property
    def given(self) -> Given:
        """The input, opened."""
        return _opened(self.source, self.choices, when_changed(self.source))

    def read(self, names: Sequence[str], z: slice) -> dict[str, Any]:
        """Read planes of some layers, and what there is besides pixels."""
        there = dict(self.made)
        layers = {name: _planes(there[name], z) if name in there else self._given_planes(name, z) for name in names}
        about = {k: v for k, v in self.given.about.items() if k != "z_um"}
        return {**about, **layers}

    def _given_planes(self, name: str, z: slice) -> Array:
        volumes = [np.stack(stack[z]) for stack in self.given.stacks[name]]
        pixels = np.stack(volumes) if name == "bands" else volumes[0]
        return pixels.astype(kernel_type(pixels.dtype), copy=False)


def _planes(image: Path, z: slice) -> Array:
    array: Any = zarr.open_array(image / "0", mode="r")
    return np.asarray(array[0, 0, z])


@dataclass(frozen=True)
class Slabs(Marked):
    """Work on slabs of planes, which make planes of images.

    Attributes
    ----------
    folder : Path
        Where images and marks are written.
    shape : tuple of int
        Of the whole volume, (z, y, x).
    side : int
        Planes of a slab.
    outs : tuple of (name, FocalArray)
        Images it makes.
    """

    shape: tuple[int, int, int]
    side: int
    outs: tuple[tuple[str, FocalArray], ...]

    @property
    def halo(self) -> int:
        """Planes around a slab that its steps look at."""
        return 0

    @property
    def places(self) -> list[Tile]:
        """All slabs in order."""
        return list(tiles(self.shape, (self.side, *self.shape[1:]), (self.halo, 0, 0)))

    def planes(self, k: int) -> range:
        """Return the planes of slab ``k``."""
        here = self.places[k].write[0]
        return range(here.start, here.stop)

    def image(self, name: str) -> Path:
        """Where the image of a layer lies."""
        return self.folder / f"{name}.ome.zarr"

    def title(self, name: str) -> str:
        """Return what is written in the image of a layer: its name, unless a subclass knows better."""
        return name

    def make_ready(self) -> None:
        """Make the images; of one that is gone, all slabs are done anew."""
        super().make_ready()
        for name, layout in self.outs:
            if not (self.image(name) / "zarr.json").exists():
                self.forget()
                create_volume(self.image(name), self.title(name), layout)

    def write(self, name: str, z: int, plane: Array) -> None:
        """Write a plane of an image."""
        write_plane(self.image(name), dict(self.outs)[name], z, plane)


@dataclass(frozen=True)
class Stage(Slabs):
    """Steps that are taken together on every slab, or a count made over all of them.

    Attributes
    ----------
    volumes : Volumes
        What it reads.
    """

    volumes: Volumes

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Return the planes that a slab makes of each layer, and what it has to say; for subclasses."""
        raise NotImplementedError

    def do(self, k: int) -> dict[str, Any]:
        """Do slab ``k``."""
        tile = self.places[k]
        made, said = self.compute(tile)
        for name, _ in self.outs:
            for z, plane in zip(self.planes(k), made[name], strict=True):
                self.write(name, z, plane)
        return said


@dataclass(frozen=True)
class LocalSteps(Stage):
    """Steps that look no further than their halos."""

    pipeline: Pipeline | None = None
    takes: tuple[str, ...] = ("volume",)

    @property
    def halo(self) -> int:
        """Planes that all steps together look at."""
        steps = self.pipeline.steps if self.pipeline else ()
        return sum(halo[0] for step in steps if (halo := step.halo) is not None)

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Take the steps on a slab with its surroundings and cut the slab out."""
        assert self.pipeline is not None
        layers = self.pipeline(self.volumes.read(self.takes, tile.read[0]))
        numbers = {
            layer.name: np.asarray(layers[layer.name]).tolist()
            for step in self.pipeline.steps
            for layer in step.operator.gives
            if not layer.shape
        }
        return {name: layers[name][tile.inner] for name, _ in self.outs}, numbers
