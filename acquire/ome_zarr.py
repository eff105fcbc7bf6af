"""The OME-Zarr 0.5 face of a run: one array (t, c, z, y, x), one shard a plane, and the files that make it readable."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

INNER_CHUNK_PX = 512
SMALL_INNER_CHUNK_PX = 256

Compression = str  # "lz4" | "zstd" | "none"


class HasPlace(Protocol):
    """A frame's header, or what was missed."""

    @property
    def section(self) -> int:
        """Section or point in time."""
        ...

    @property
    def band(self) -> int:
        """Band within it."""
        ...

    @property
    def plane(self) -> int:
        """Plane of the stack."""
        ...


@dataclass(frozen=True)
class FocalArray:
    """What the array of a run looks like: t is the section or point in time, c the band, z the plane of the stack.

    Attributes
    ----------
    planned : int
        Planes the array is laid out for, all sections and bands together; the published shape grows up to it, in z
        if there is one section, else in t.
    shape : tuple of int
        One frame: (height, width) or (height, width, bands).
    dtype : str
        ``"uint8"`` or ``"uint16"``.
    start_um, step_um : float
        Position of plane 0 and signed distance of planes, written as translation and scale of z.
    pixel_um : float or None
        Size of a pixel in the specimen.
    sections : int
        Sections, or points in time.
    channels : tuple of str
        Names of the bands; empty for one that has none.
    colours : tuple of str or None
        ``"#rrggbb"`` of each band.
    interval_s : float or None
        From one point in time to the next; None for sections.
    levels : int
        Arrays of the pyramid, 0 and on, each with half the pixels along y and x of the one before.
    """

    planned: int
    shape: tuple[int, ...]
    dtype: str
    start_um: float
    step_um: float
    pixel_um: float | None
    compression: Compression = "lz4"
    sections: int = 1
    channels: tuple[str, ...] = ()
    colours: tuple[str | None, ...] = ()
    interval_s: float | None = None
    levels: int = 1

    @property
    def bands(self) -> int:
        """Values of one pixel of a frame: 1, or 3 for a colour camera."""
        return 1 if len(self.shape) == 2 else self.shape[2]

    @property
    def channel_count(self) -> int:
        """Bands of the run, at least one; each takes `bands` places of the axis c."""
        return max(1, len(self.channels))

    @property
    def slots_each(self) -> int:
        """Planes of one section, all bands together."""
        return self.planned // self.sections

    @property
    def planes_each(self) -> int:
        """Planes of one stack."""
        return self.slots_each // self.channel_count

    def place(self, slot: int) -> tuple[int, int, int]:
        """Return section, band and plane of a slot."""
        stack, plane = divmod(slot, self.planes_each)
        return *divmod(stack, self.channel_count), plane

    def slot_of(self, header: HasPlace) -> int:
        """Return the slot of a frame or of what was missed."""
        return (header.section * self.channel_count + header.band) * self.planes_each + header.plane

    def extent(self, slots: Collection[int]) -> int:
        """Return how far the published shape reaches when these slots are to be seen."""
        axis = 2 if self.sections == 1 else 0
        return max((self.place(slot)[axis] for slot in slots), default=-1) + 1

    def array_json(self, extent: int) -> dict[str, Any]:
        """Return the array's ``zarr.json`` when ``extent`` sections, or planes of the only one, are published."""
        height, width = self.shape[:2]
        times, planes = (1, extent) if self.sections == 1 else (extent, self.planes_each)
        inner = (_inner(height), _inner(width))
        shard = [1, self.bands, 1, *(math.ceil(n / i) * i for n, i in zip((height, width), inner, strict=True))]
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": [times, self.channel_count * self.bands, planes, height, width],
            "data_type": self.dtype,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shard}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": 0,
            "codecs": [
                {
                    "name": "sharding_indexed",
                    "configuration": {
                        "chunk_shape": [1, self.bands, 1, *inner],
                        "codecs": self._codecs(),
                        "index_codecs": [_little_endian(), {"name": "crc32c"}],
                        "index_location": "end",
                    },
                }
            ],
            "attributes": {},
            "dimension_names": ["t", "c", "z", "y", "x"],
        }

    def _codecs(self) -> list[dict[str, Any]]:
        squeeze = {
            "name": "blosc",
            "configuration": {
                "cname": self.compression,
                "clevel": 1 if self.compression == "zstd" else 5,
                "shuffle": "bitshuffle",
                "typesize": 1 if self.dtype == "uint8" else 2,
                "blocksize": 0,
            },
        }
        packed = [] if self.compression == "none" else [squeeze]
        return [_little_endian(), *packed, {"name": "crc32c"}]

    def group_json(self, name: str, extra: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the image's ``zarr.json``: axes in µm, scale and translation, channels.

        Without a pixel size, x and y have scale 1 and no unit, and without a step too z has none. ``extra`` is under
        ``attributes.stereotome``: OME-Zarr itself has no place for what differs from plane to plane.
        """
        lateral: dict[str, str] = {} if self.pixel_um is None else {"unit": "micrometer"}
        along_z: dict[str, str] = {"unit": "micrometer"} if self.step_um or lateral else {}
        pixel = self.pixel_um or 1.0
        multiscale = {
            "name": name,
            "axes": [
                {"name": "t", "type": "time", **({"unit": "second"} if self.interval_s else {})},
                {"name": "c", "type": "channel"},
                {"name": "z", "type": "space", **along_z},
                {"name": "y", "type": "space", **lateral},
                {"name": "x", "type": "space", **lateral},
            ],
            "datasets": [self._dataset(level, pixel) for level in range(self.levels)],
        }
        ome = {"version": "0.5", "multiscales": [multiscale], "omero": {"channels": self._channels()}}
        attributes = {"ome": ome, "stereotome": extra or {}}
        return {"zarr_format": 3, "node_type": "group", "attributes": attributes}

    def _dataset(self, level: int, pixel_um: float) -> dict[str, Any]:
        """Say where a level of the pyramid lies: its first pixel is the middle of those it stands for."""
        side, first = pixel_um * 2**level, pixel_um * (2**level - 1) / 2
        return {
            "path": str(level),
            "coordinateTransformations": [
                {"type": "scale", "scale": [self.interval_s or 1.0, 1.0, self.step_um or 1.0, side, side]},
                {"type": "translation", "translation": [0.0, 0.0, self.start_um, first, first]},
            ],
        }

    def level(self, level: int) -> FocalArray:
        """Return the layout of a level of the pyramid; a last odd row or column has a pixel of its own."""
        height, width = (-(-n // 2**level) for n in self.shape[:2])
        return replace(self, shape=(height, width, *self.shape[2:]))

    def _channels(self) -> list[dict[str, Any]]:
        top = 255 if self.dtype == "uint8" else 65535
        window = {"min": 0, "max": top, "start": 0, "end": top}
        named = [(label, color) for band in range(self.channel_count) for label, color in self._parts(band)]
        return [{"label": label, "color": color, "window": window, "active": True} for label, color in named]

    def _parts(self, band: int) -> list[tuple[str, str]]:
        """Return names and colours of the places a band takes on the axis c."""
        name = self.channels[band] if self.channels else ""
        if self.bands == 1:
            colour = (self.colours[band] if self.colours else None) or "#FFFFFF"
            return [(name or "grey", colour.removeprefix("#").upper())]
        parts = (("red", "FF0000"), ("green", "00FF00"), ("blue", "0000FF"))
        return [(f"{name} {part}".strip(), colour) for part, colour in parts]


def _little_endian() -> dict[str, Any]:
    return {"name": "bytes", "configuration": {"endian": "little"}}


def _inner(size_px: int) -> int:
    """Return the side of the equal inner chunks that cover ``size_px`` with at most a few pixels to spare."""
    target = INNER_CHUNK_PX if size_px >= 2 * INNER_CHUNK_PX else SMALL_INNER_CHUNK_PX
    return math.ceil(size_px / math.ceil(size_px / target))


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def replace_json(path: Path, content: dict[str, Any]) -> None:
    """Replace a JSON file in one durable step: a reader sees the old one or the new one, never half of it."""
    replace_text(path, json.dumps(content, indent=1, ensure_ascii=False))


def replace_text(path: Path, text: str) -> None:
    """Replace a text file in one durable step."""
    part = path.with_name(path.name + ".part")
    with part.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)
