"""Stereo pictures of results in a folder: a pair side by side and an anaglyph, each with a caption."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import tifffile

from devices.errors import InputError
from display.stereo import StereoPair, anaglyph, comfortable_pixel, side_by_side, stereo_pair, stereo_words
from processing.outputs import disk_error, write_durably
from processing.pictures import captioned, png_bytes, preview

if TYPE_CHECKING:
    from pathlib import Path

    from display.stereo import AnaglyphMethod

ANAGLYPH, PAIR = "anaglyph.png", "stereo_pair.png"


def write_stereo(
    results: Path, folder: Path, *, angle_deg: float = 8.0, depth_scale: float = 1.0, method: AnaglyphMethod = "grey"
) -> StereoPair:
    """Write ``anaglyph.png`` and ``stereo_pair.png`` (left view on the left) of an extended focus and its range.

    Larger ranges stand nearer to the eyes. Without range in µm and pixel size the depth is what is comfortable to look
    at, and the caption says so.

    Parameters
    ----------
    results : Path
        Folder that ``stereotome process focus`` or a run with live focus has written.
    folder : Path
        Where the pictures go; there already.
    angle_deg, depth_scale, method
        As in `display.stereo.stereo_pair` and `display.stereo.anaglyph`.

    Raises
    ------
    InputError
        ``results`` holds no results.
    StoreError
        The disk refused.
    """
    try:
        image = preview(tifffile.imread(results / "extended_focus.tif"))
        range_ = tifffile.imread(results / "range.tif")
        report = json.loads((results / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{results} holds no results of a focus measurement.",
            why=str(error),
            fix="make them: stereotome process focus STACK -o DIR",
        ) from None
    in_um = report["unit"] == "um" and report.get("pixel_um") is not None
    pixel = float(report["pixel_um"]) if in_um else comfortable_pixel(range_, angle_deg=angle_deg)
    pair = stereo_pair(image, range_, pixel_um=pixel, angle_deg=angle_deg, depth_scale=depth_scale)
    words = stereo_words(pair, angle_deg) + ("" if in_um else ", depth not to scale")
    _write(folder / ANAGLYPH, png_bytes(captioned(anaglyph(pair.left, pair.right, method=method), words)))
    _write(folder / PAIR, png_bytes(captioned(side_by_side(pair), f"{words}; left view on the left")))
    return pair


def _write(path: Path, content: bytes) -> None:
    part = path.with_name(path.name + ".part")
    try:
        write_durably(part, content)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise disk_error(path.parent, error) from None
