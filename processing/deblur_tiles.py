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

    from processing.tiles import Tile

    Tell = Callable[[int], None]

    Array = NDArray[Any]

Method = Literal["richardson-lucy", "wiener", "van-cittert"]
BYTES_PER_VOXEL = 64  # of a padded tile: fields of 4 bytes and their transforms
SMALLEST_TILE = 32


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
    """

    method: Method
    noise: float
    background: float
    most_steps: int = 30
    neighbours: int = 2

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
            return van_cittert(part, psf, neighbours=self.neighbours, **options)
        return richardson_lucy(part, psf, **options)


@dataclass(frozen=True)
class Restored:
    """A whole volume restored.

    Attributes
    ----------
    volume : array like the input
        The background is in it again; rounded, and kept within the type.
    first : Deblurred
        The tile with the most contrast, whose stop decided the number of steps of all.
    tiles : int
        How many there were.
    halo_px : tuple of int
        By how much each was larger than what was kept of it: planes, rows, columns.
    """

    volume: Array
    first: Deblurred
    tiles: int
    halo_px: tuple[int, ...]


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
    _keep(result, busiest, first.volume + np.float32(how.background))
    for done, cut in enumerate((c for c in cuts if c is not busiest), 1):
        part = how.restored(volume[cut.read], psf, steps=first.steps, noise_share=share, tell=part_told(done))
        _keep(result, cut, part.volume + np.float32(how.background))
    if tell:
        tell(1.0)
    return Restored(result, first, len(cuts), halo)


def _keep(result: Array, cut: Tile, part: Array) -> None:
    top = np.iinfo(result.dtype).max
    result[cut.write] = np.clip(np.rint(part[cut.inner]), 0, top).astype(result.dtype)


def halo_px(method: Method, psf: tuple[int, ...]) -> tuple[int, int, int]:
    """By how much a tile must be larger than what is kept; a linear inverse reaches further than the blur itself."""
    rows, columns = (2 * n if method == "wiener" else n // 2 for n in psf[1:])
    return 0, rows, columns


def tile_side(shape: tuple[int, ...], psf: tuple[int, ...], halo: int, memory: float) -> int:
    """Side in pixels of the largest tile that can be worked on within ``memory`` bytes.

    Raises
    ------
    InputError
        ``memory``: not even a tile of 32 pixels.
    """
    planes, around = shape[0] + psf[0], 2 * halo + max(psf[1:])
    room = int(np.sqrt(memory / BYTES_PER_VOXEL / planes)) - around
    side = max(shape[1:])
    if room >= side:
        return side
    if room < SMALLEST_TILE:
        least = BYTES_PER_VOXEL * planes * (SMALLEST_TILE + around) ** 2
        raise InputError(
            f"deblurring {planes} planes needs {least / 1e9:.2f} GB of memory for its smallest tile; "
            f"{memory / 1e9:.2f} GB are allowed.",
            fix=("allow more: --memory-gb G", "a smaller point spread function, or fewer planes"),
            code="memory",
        )
    return -(-side // -(-side // room))
