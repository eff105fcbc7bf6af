"""Deblurring of a whole volume, tile by tile, within a limit of memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from devices.errors import InputError
from processing.deblur import Deblurred, noise_over_signal, richardson_lucy, van_cittert, wiener
from processing.tiles import tiles

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Tell = Callable[[int], None]

    Array = NDArray[Any]

Method = Literal["richardson-lucy", "wiener", "van-cittert"]
BYTES_PER_VOXEL = 64  # of a padded tile: fields of 4 bytes and their transforms
SMALLEST_TILE = 32
NAME, TITLE = "deblurred", "deblurred"  # of the volume in files


@dataclass(frozen=True)
class Deblurring:
    """How a volume is deblurred.

    Attributes
    ----------
    method : Method
    noise, background : float
        Camera noise (rms) and the level of no light, grey levels.
    most_steps : int
        Iterations at most.
    neighbours : int
        Planes to either side that Van Cittert's rule takes into account.
    brightest : float, optional
        The largest grey level of all, so that tiles go alike.
    """

    method: Method
    noise: float
    background: float
    most_steps: int = 30
    neighbours: int = 2
    brightest: float | None = None

    def restored(
        self, part: Array, psf: Array, *, steps: int | None, noise_share: float, tell: Tell | None = None
    ) -> Deblurred:
        """Deblur one part; ``steps`` fixes the number of iterations, so that all parts agree."""
        options: dict[str, Any] = {
            "noise": self.noise,
            "background": self.background,
            "most_steps": self.most_steps if steps is None else steps,
            "stop": steps is None,
            "tell": tell,
        }
        if self.method == "wiener":
            light = part.astype(np.float32) - np.float32(self.background)
            return Deblurred(wiener(light, psf, noise_share=noise_share), 1, "most", ())
        if self.method == "van-cittert":
            return van_cittert(part, psf, neighbours=self.neighbours, brightest=self.brightest, **options)
        return richardson_lucy(part, psf, **options)


@dataclass(frozen=True)
class Course:
    """How a restoration went.

    Attributes
    ----------
    steps, stopped, residual
        As in `Deblurred`, of the tile with the most contrast, whose stop decided the number of steps of all.
    tiles : int
        How many there were.
    halo_px : tuple of int
        By how much each was larger than what was kept of it: planes, rows, columns.
    """

    steps: int
    stopped: str
    residual: tuple[float, ...]
    tiles: int
    halo_px: tuple[int, ...]


@dataclass(frozen=True)
class Restored:
    """A whole volume restored, and how that went.

    Attributes
    ----------
    volume : array like the input
        The background is in it again; rounded, and kept within the type.
    course : Course
    """

    volume: Array
    course: Course


def deblur(
    volume: Array, psf: Array, how: Deblurring, *, memory: float, tell: Callable[[float], None] | None = None
) -> Restored:
    """Deblur a volume of any size.

    Parameters
    ----------
    volume : array (planes, rows, columns) uint8 or uint16
    psf : array float32
        Odd sides, sum 1.
    how : Deblurring
    memory : float
        Bytes for the work on one tile; the volume and its result are beside that.
    tell : callable, optional
        Is told the share of the work done, 0 to 1.

    Raises
    ------
    InputError
        ``memory``: even the smallest tile needs more.
    """
    halo = halo_px(how.method, psf.shape)
    side = tile_side(volume.shape, psf.shape, max(halo), memory)
    cuts = list(tiles(volume.shape, (volume.shape[0], side, side), halo))
    busiest = max(cuts, key=lambda cut: float(np.var(volume[cut.write][:, ::2, ::2], dtype=np.float64)))
    share = noise_over_signal(volume[busiest.read].astype(np.float32) - np.float32(how.background), how.noise)
    result = np.empty_like(volume)

    def part_told(done: int) -> Tell | None:
        return None if tell is None else lambda step: tell((done + step / how.most_steps) / len(cuts))

    first = how.restored(volume[busiest.read], psf, steps=None, noise_share=share, tell=part_told(0))
    result[busiest.write] = as_grey(first.volume[busiest.inner], how.background, result.dtype)
    for done, cut in enumerate((c for c in cuts if c is not busiest), 1):
        part = how.restored(volume[cut.read], psf, steps=first.steps, noise_share=share, tell=part_told(done))
        result[cut.write] = as_grey(part.volume[cut.inner], how.background, result.dtype)
    if tell:
        tell(1.0)
    return Restored(result, Course(first.steps, first.stopped, first.residual, len(cuts), halo))


def as_grey(light: Array, background: float, dtype: np.dtype[Any]) -> Array:
    """Return restored light as the camera would have it: the background in it again, rounded, within the type."""
    return np.clip(np.rint(light + np.float32(background)), 0, np.iinfo(dtype).max).astype(dtype)


def halo_px(method: Method, psf: tuple[int, ...]) -> tuple[int, int, int]:
    """By how much a tile must be larger than what is kept.

    Light from beyond a tile is estimated; what that gets wrong fades within the width of the blur, to a thousandth of
    the brightest. A linear inverse looks further, and its tiles differ from the whole whatever is around them.
    """
    rows, columns = (2 * n if method == "wiener" else n for n in psf[1:])
    return 0, rows, columns


def tile_side(shape: tuple[int, ...], psf: tuple[int, ...], halo: int, memory: float) -> int:
    """Side in pixels of the largest tile that can be worked on within ``memory`` bytes.

    Raises
    ------
    InputError
        ``memory``: not even a tile of 32 pixels.
    """
    sides = tile_sides(shape)
    for side in sides:
        if tile_bytes(shape, psf, halo, side) <= memory:
            return side
    least = tile_bytes(shape, psf, halo, sides[-1])
    raise InputError(
        f"deblurring {shape[0]} planes needs {least / 1e9:.2f} GB of memory for its smallest tile; "
        f"{memory / 1e9:.2f} GB are allowed.",
        fix=("allow more: --memory 8GB", "a smaller point spread function, or fewer planes"),
        code="memory",
    )


def tile_sides(shape: tuple[int, ...]) -> list[int]:
    """Return the sides a tile may have, the largest first: the whole, its half, its third, and on."""
    side = max(shape[1:])
    return [-(-side // count) for count in range(1, max(1, side // SMALLEST_TILE) + 1)]


def tile_bytes(shape: tuple[int, ...], psf: tuple[int, ...], halo: int, side: int) -> float:
    """Return about what the work on one tile takes."""
    voxels = shape[0] + psf[0]
    for length, spread in zip(shape[1:], psf[1:], strict=True):
        voxels *= min(length, side + 2 * halo) + spread
    return float(BYTES_PER_VOXEL * voxels)
