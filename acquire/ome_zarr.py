"""The OME-Zarr 0.5 face of a run: one array (t, c, z, y, x), one shard a plane, and the files that make it readable."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

INNER_CHUNK_PX = 512
SMALL_INNER_CHUNK_PX = 256

Compression = str  # "lz4" | "zstd" | "none"


@dataclass(frozen=True)
class FocalArray:
    """What the array of a focal stack looks like.

    Attributes
    ----------
    planned : int
        Planes the array is laid out for; the published shape grows up to it.
    shape : tuple of int
        One frame: (height, width) or (height, width, bands).
    dtype : str
        ``"uint8"`` or ``"uint16"``.
    start_um, step_um : float
        Position of plane 0 and signed distance of planes, written as translation and scale of z.
    pixel_um : float or None
        Size of a pixel in the specimen.
    """

    planned: int
    shape: tuple[int, ...]
    dtype: str
    start_um: float
    step_um: float
    pixel_um: float | None
    compression: Compression = "lz4"

    @property
    def bands(self) -> int:
        """1 or 3."""
        return 1 if len(self.shape) == 2 else self.shape[2]

    def array_json(self, planes: int) -> dict[str, Any]:
        """Return the array's ``zarr.json`` when ``planes`` planes are published."""
        height, width = self.shape[:2]
        inner = (_inner(height), _inner(width))
        shard = [1, self.bands, 1, *(math.ceil(n / i) * i for n, i in zip((height, width), inner, strict=True))]
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": [1, self.bands, planes, height, width],
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

        Without a pixel size, x and y have scale 1 and no unit. ``extra`` is kept under ``attributes.stereotome``:
        OME-Zarr itself has no place for what differs from plane to plane.
        """
        lateral: dict[str, str] = {} if self.pixel_um is None else {"unit": "micrometer"}
        pixel = self.pixel_um or 1.0
        multiscale = {
            "name": name,
            "axes": [
                {"name": "t", "type": "time"},
                {"name": "c", "type": "channel"},
                {"name": "z", "type": "space", "unit": "micrometer"},
                {"name": "y", "type": "space", **lateral},
                {"name": "x", "type": "space", **lateral},
            ],
            "datasets": [
                {
                    "path": "0",
                    "coordinateTransformations": [
                        {"type": "scale", "scale": [1.0, 1.0, self.step_um or 1.0, pixel, pixel]},
                        {"type": "translation", "translation": [0.0, 0.0, self.start_um, 0.0, 0.0]},
                    ],
                }
            ],
        }
        ome = {"version": "0.5", "multiscales": [multiscale], "omero": {"channels": self._channels()}}
        attributes = {"ome": ome, "stereotome": extra or {}}
        return {"zarr_format": 3, "node_type": "group", "attributes": attributes}

    def _channels(self) -> list[dict[str, Any]]:
        colours = {"red": "FF0000", "green": "00FF00", "blue": "0000FF"}
        names = {"grey": "FFFFFF"} if self.bands == 1 else colours
        top = 255 if self.dtype == "uint8" else 65535
        window = {"min": 0, "max": top, "start": 0, "end": top}
        return [{"label": label, "color": color, "window": window, "active": True} for label, color in names.items()]


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
    part = path.with_name(path.name + ".part")
    with part.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=1, ensure_ascii=False)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)
