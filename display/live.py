"""The observer ``stereo``: extended focus and range as the planes arrive, then the stereo pair made from them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import tifffile

from acquire.store import open_run
from display.compose import compose
from display.shifted import comfortable_pixel, stereo_pair
from processing import live
from processing.outputs import write_durably
from processing.pictures import captioned, png_bytes, preview
from processing.range_operators import fill

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray


def observe(ring: Path, run: Path, out: Path, options: dict[str, Any], ready: Callable[[], None]) -> None:
    """Measure a run while it is taken, as `processing.live.observe`, and add its stereo pair; see `acquire.observe`.

    Parameters
    ----------
    options : dict
        Those of `processing.live.observe`, and ``angle_deg``, the angle between the two views.
    """
    live.observe(ring, run, out, options, ready)
    image = preview(tifffile.imread(out / "extended_focus.tif"))
    range_um, angle_deg = fill(tifffile.imread(out / "range.tif"))[0], options["angle_deg"]
    # without a pixel size depth cannot be to scale; it is then what is comfortable to look at
    pixel_um = open_run(run).layout.pixel_um or comfortable_pixel(range_um, angle_deg=angle_deg)
    write_stereo(image, range_um, out, pixel_um=pixel_um, angle_deg=angle_deg)


def write_stereo(
    image: NDArray[Any], range_um: NDArray[Any], folder: Path, *, pixel_um: float, angle_deg: float
) -> tuple[str, ...]:
    """Write ``stereo_left.png``, ``stereo_right.png`` and a red/cyan ``anaglyph.png``; return what is hard to look at.

    Parameters
    ----------
    image : ndarray, shape (y, x) or (y, x, 3), uint8
        What the surface looks like.
    range_um : ndarray, shape (y, x)
        Its height.
    """
    pair = stereo_pair(image, range_um, pixel_um=pixel_um, angle_deg=angle_deg)
    low_px, high_px = pair.parallax_px
    words = f"red/cyan, red left · views {angle_deg:g}° apart · parallax {low_px:+.1f} to {high_px:+.1f} px"
    pictures = {
        "stereo_left.png": pair.left,
        "stereo_right.png": pair.right,
        "anaglyph.png": captioned(compose(pair.left, pair.right, "anaglyph-grey"), words),
    }
    for name, picture in pictures.items():
        write_durably(folder / name, png_bytes(picture))
    return pair.warnings
