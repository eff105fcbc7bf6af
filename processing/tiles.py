"""Tiles with overlap: work on a part of an array at a time, with the same result as on the whole."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Box = tuple[slice, ...]


@dataclass(frozen=True)
class Tile:
    """Where to read, and which part of what was read is written where.

    Attributes
    ----------
    read : tuple of slice
        In the whole: the tile with its surroundings, as far as the array goes.
    inner : tuple of slice
        In what was read: the tile alone.
    write : tuple of slice
        In the whole: the tile alone.
    """

    read: Box
    inner: Box
    write: Box


def tiles(shape: Sequence[int], side: Sequence[int], halo: Sequence[int]) -> Iterator[Tile]:
    """Cut an array into tiles of ``side`` with ``halo`` elements around each; all in elements along each axis."""
    spans = [_spans(*axis) for axis in zip(shape, side, halo, strict=True)]
    for picked in product(*spans):
        yield Tile(*(tuple(boxes) for boxes in zip(*picked, strict=True)))


def cut(layers: Mapping[str, Any], box: Box, shape: Sequence[int]) -> dict[str, Any]:
    """Cut a part out of all layers whose last axes are those of ``shape``; the others stay whole."""
    return {
        name: value[(..., *box)] if tuple(getattr(value, "shape", ())[-len(box) :]) == tuple(shape) else value
        for name, value in layers.items()
    }


def _spans(length: int, side: int, halo: int) -> list[tuple[slice, slice, slice]]:
    spans = []
    for start in range(0, length, max(1, side)):
        stop = min(start + max(1, side), length)
        low, high = max(0, start - halo), min(length, stop + halo)
        spans.append((slice(low, high), slice(start - low, stop - low), slice(start, stop)))
    return spans
