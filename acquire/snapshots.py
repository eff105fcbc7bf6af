"""Frames kept by hand: a TIFF with what is known about it, a clip of them as a TIFF of many pages."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import tifffile

from acquire.frame import Frame, FrameHeader

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from acquire.replies import Picture

NS_PER_S = 1_000_000_000


def frame_of(picture: Picture) -> Frame:
    """Return a picture that was asked for as a frame; it is no plane of a run."""
    pixels = np.frombuffer(picture.pixels, picture.dtype).reshape(picture.shape)
    header = FrameHeader(-1, picture.z_um, picture.z_um, picture.exposure_ms, utc_ns=picture.utc_ns)
    return Frame(0, header, pixels)


class Taken(Protocol):
    """A frame: pixels (height, width[, bands]), and what is known about it."""

    @property
    def pixels(self) -> np.ndarray: ...  # noqa: D102
    @property
    def header(self) -> FrameHeader: ...  # noqa: D102


def write_snapshot(folder: Path, taken: Taken, about: Mapping[str, object]) -> Path:
    """Write a frame as it came, with when, where and by whom it was taken; return the file, never one that existed."""
    path = _free(folder, "snap", taken, ".tif")
    write_frames(path, [taken], about)
    return path


def write_clip(folder: Path, frames: Sequence[Taken], about: Mapping[str, object]) -> Path:
    """Write frames as pages of a file; return it, never one that existed."""
    path = _free(folder, "clip", frames[0], ".tif")
    write_frames(path, frames, about)
    return path


def write_frames(path: Path, frames: Sequence[Taken], about: Mapping[str, object]) -> None:
    """Write frames of one size as pages of a file; one of another size is left out."""
    first = frames[0]
    alike = [
        seen for seen in frames if seen.pixels.shape == first.pixels.shape and seen.pixels.dtype == first.pixels.dtype
    ]
    pages = first.pixels if len(alike) == 1 else np.stack([seen.pixels for seen in alike])
    told = _known(first, about) | ({"frames": [_known(seen, {}) for seen in alike]} if len(alike) > 1 else {})
    tifffile.imwrite(path, pages, **_resolution(about), metadata={"Info": json.dumps(told)})


def _known(taken: Taken, about: Mapping[str, object]) -> dict[str, Any]:
    header = taken.header
    when = datetime.fromtimestamp(header.utc_ns / NS_PER_S, UTC).isoformat()
    return {"taken_utc": when, "z_um": header.z_um, "exposure_ms": header.exposure_ms, **about}


def _resolution(about: Mapping[str, object]) -> dict[str, Any]:
    pixel_um = about.get("pixel_um")
    if not isinstance(pixel_um, float):
        return {"imagej": False}
    return {"resolution": (10_000 / pixel_um, 10_000 / pixel_um), "resolutionunit": "CENTIMETER"}


def _free(folder: Path, kind: str, taken: Taken, suffix: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    when = datetime.fromtimestamp(taken.header.utc_ns / NS_PER_S, UTC).astimezone()
    names = (f"{kind}-{when:%Y%m%d-%H%M%S}{f'-{n}' if n else ''}{suffix}" for n in range(100_000))
    return next(folder / name for name in names if not (folder / name).exists())
