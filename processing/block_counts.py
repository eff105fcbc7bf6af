"""What has to be known of a whole volume before the next step: its values counted, its parts numbered across slabs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from devices.errors import InputError
from processing.labels import MOST_LABELS, components
from processing.parts import joined, touching
from processing.slabs import LocalSteps, Stage
from processing.thresholds import found, histogram
from processing.volume_filters import checked

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.tiles import Tile

    Array = NDArray[Any]


@dataclass(frozen=True)
class Limits(Stage):
    """Smallest and largest value."""

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Find them in a slab."""
        grey = checked(self.volumes.read(["volume"], tile.read[0])["volume"])
        return {}, {"low": float(grey.min()), "high": float(grey.max())}

    def limits(self) -> tuple[float, float]:
        """Return them for the whole volume."""
        said = self.found()
        return min(s["low"] for s in said), max(s["high"] for s in said)


@dataclass(frozen=True)
class Counts(Stage):
    """How often each value is there."""

    limits: tuple[float, float] | None = None

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Count in a slab."""
        grey = checked(self.volumes.read(["volume"], tile.read[0])["volume"])
        counts, values = histogram(grey, self.limits)
        return {}, {"counts": counts.tolist(), "values": values.tolist()}

    def threshold(self, method: str) -> float:
        """Return the threshold of the whole volume."""
        said = self.found()
        return found(method, np.sum([s["counts"] for s in said], axis=0), np.array(said[0]["values"]))


@dataclass(frozen=True)
class SlabLabels(LocalSteps):
    """Connected parts numbered in each slab for itself, after steps that make what is labelled."""

    rule: int = 26
    by_value: bool = False

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Give the parts of a slab numbers of their own."""
        made, said = super().compute(tile)
        labels, count = components(made["volume"], rule=self.rule, by_value=self.by_value)
        parts = {"parts": int(count), "sizes": np.bincount(labels.ravel()).tolist()[1:]}
        return {**made, "volume": labels}, {"steps": said, **parts}

    def merge(self, least: int, kept: Path) -> int:
        """Find which parts of neighbouring slabs are one, and keep a number for each; returns how many there are.

        Parts are numbered in the order in which they are met plane by plane, as in memory.

        Parameters
        ----------
        least : int
            Smaller ones are dropped.
        kept : Path
            NPY: the number of every part, of one slab after the other; 0 for dropped ones.

        Raises
        ------
        InputError
            ``label-overflow``: more parts than 32 bits can count.
        """
        said = self.found()
        begins = np.concatenate([[0], np.cumsum([s["parts"] for s in said])])
        total = int(begins[-1])
        if total > MOST_LABELS:
            raise InputError(
                f"{total} parts are more than 32 bits can count.",
                fix="smooth first, or raise the threshold.",
                code="label-overflow",
            )
        count, part = joined(total, list(self._touching(begins)))
        sizes = np.bincount(part, np.concatenate([s["sizes"] for s in said]), count) if total else np.empty(0)
        first = np.unique(part, return_index=True)[1]
        order = np.argsort(first)
        order = order[sizes[order] >= least]
        numbers = np.zeros(count, np.uint32)
        numbers[order] = np.arange(1, len(order) + 1)
        np.save(kept, numbers[part])
        return len(order)

    def _touching(self, begins: Array) -> Iterator[Array]:
        """Yield pairs of parts that touch across the planes between two slabs."""
        labels: Any = zarr.open_array(self.image("volume") / "0", mode="r")
        for k, (above, _) in enumerate(pairwise(self.places)):
            z = above.write[0].stop
            upper, lower = (np.asarray(labels[0, 0, i]) for i in (z - 1, z))
            values = self.volumes.read(["volume"], slice(z - 1, z + 1))["volume"] if self.by_value else None
            yield touching(upper, lower, self.rule, values) - 1 + begins[[k, k + 1]]


@dataclass(frozen=True)
class Renumber(Stage):
    """Labels of slabs exchanged for those of the whole."""

    numbers: Path | None = None
    begins: tuple[int, ...] = ()

    def compute(self, tile: Tile) -> tuple[dict[str, Array], dict[str, Any]]:
        """Exchange them in a slab."""
        assert self.numbers is not None
        labels = self.volumes.read(["volume"], tile.read[0])["volume"]
        k = tile.write[0].start // self.side
        numbers: Array = np.load(self.numbers, mmap_mode="r")
        table = np.concatenate([np.zeros(1, np.uint32), numbers[self.begins[k] : self.begins[k + 1]]])
        return {"volume": table[labels]}, {}
