"""Frames kept by hand: a TIFF with what is known about it, a clip of them as a TIFF of many pages."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from display.console.eyes import Seen

NS_PER_S = 1_000_000_000


def write_snapshot(folder: Path, seen: Seen, about: Mapping[str, object]) -> Path:
    """Write a frame as it came, with when, where and by whom it was taken; return the file, never one that existed."""
    path = _free(folder, "snap", seen, ".tif")
    tifffile.imwrite(path, seen.pixels, **_resolution(about), metadata={"Info": json.dumps(_known(seen, about))})
    return path


def write_clip(folder: Path, frames: Sequence[Seen], about: Mapping[str, object]) -> Path:
    """Write frames of one size as pages of a file; a frame of another size ends the clip."""
    first = frames[0]
    alike = [
        seen for seen in frames if seen.pixels.shape == first.pixels.shape and seen.pixels.dtype == first.pixels.dtype
    ]
    path = _free(folder, "clip", first, ".tif")
    stack = np.stack([seen.pixels for seen in alike])
    told = {**_known(first, about), "frames": [_known(seen, {}) for seen in alike]}
    tifffile.imwrite(path, stack, **_resolution(about), metadata={"Info": json.dumps(told)})
    return path


def _known(seen: Seen, about: Mapping[str, object]) -> dict[str, Any]:
    header = seen.header
    taken = datetime.fromtimestamp(header.utc_ns / NS_PER_S, UTC).isoformat()
    return {"taken_utc": taken, "z_um": header.z_um, "exposure_ms": header.exposure_ms, **about}


def _resolution(about: Mapping[str, object]) -> dict[str, Any]:
    pixel_um = about.get("pixel_um")
    if not isinstance(pixel_um, float):
        return {"imagej": False}
    return {"resolution": (10_000 / pixel_um, 10_000 / pixel_um), "resolutionunit": "CENTIMETER"}


def _free(folder: Path, kind: str, seen: Seen, suffix: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    taken = datetime.fromtimestamp(seen.header.utc_ns / NS_PER_S, UTC).astimezone()
    names = (f"{kind}-{taken:%Y%m%d-%H%M%S}{f'-{n}' if n else ''}{suffix}" for n in range(100_000))
    return next(folder / name for name in names if not (folder / name).exists())
