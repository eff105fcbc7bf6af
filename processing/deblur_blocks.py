"""Deblurring of stacks larger than memory: tile by tile through all planes, then put together plane by plane.

What all tiles must agree on is found first: background, noise and brightest voxel of the whole, and the number of
steps, which the tile with the most contrast decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from processing.block_job import at_once, begun
from processing.block_options import whole_needed
from processing.blockwise import MOST_PLANES, amount, fitted
from processing.deblur import WORKERS
from processing.deblur_known import Known, plane_said, summed
from processing.deblur_tiles import NAME, TITLE, Course, Deblurring, as_grey, halo_px, tile_bytes, tile_sides
from processing.marked import Marked
from processing.pieces import Tiled
from processing.slabs import Slabs
from processing.tiles import Tile, tiles

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.ome_zarr import FocalArray
    from processing.block_options import Blocks
    from processing.block_source import Source

    Array = NDArray[Any]

SURVEYED = 8  # planes that are looked at by one part
READ_BYTES = 24  # of a pixel of a plane while it is read, looked at, and written with its smaller versions


@dataclass(frozen=True)
class Survey(Marked):
    """What must be known of whole planes, and how much each tile of them shows."""

    source: Source
    count: int
    tiles: tuple[Tile, ...]

    @property
    def places(self) -> list[Tile]:
        """Some planes each."""
        return list(tiles((self.count,), (SURVEYED,), (0,)))

    def do(self, k: int) -> dict[str, Any]:
        """Look at some planes."""
        here = self.places[k].write[0]
        said, sums = [], []
        for z in range(here.start, here.stop):
            plane = self.source.stack[z]
            said.append(plane_said(plane))
            sums.append([moments(plane[tile.write[1:]][::2, ::2]) for tile in self.tiles])
        return {"planes": said, "moments": sums}

    def known(self) -> Known:
        """Return what is known of the whole."""
        return summed([said for found in self.found() for said in found["planes"]])

    def busiest(self) -> int:
        """Return the number of the tile with the most contrast."""
        planes = np.array([sums for found in self.found() for sums in found["moments"]], np.float64)
        count, total, squares = planes.sum(axis=0).T
        return int(np.argmax(squares / count - (total / count) ** 2))


def moments(pixels: Array) -> tuple[int, int, int]:
    """Return how many pixels there are, their sum, and that of their squares."""
    flat = pixels.ravel().astype(np.uint64)
    return flat.size, int(flat.sum()), int(flat @ flat)


@dataclass(frozen=True)
class Restoring(Tiled):
    """Every tile restored; the one with the most contrast alone first, since it decides how many steps all take."""

    source: Source
    psf: Array
    how: Deblurring
    busiest: int
    alone: bool

    def pending(self) -> list[int]:
        """Numbers of the tiles to be done now."""
        return [k for k in super().pending() if not self.alone or k == self.busiest]

    def do(self, k: int) -> dict[str, Any]:
        """Restore a tile."""
        place, stack = self.places[k], self.source.stack
        part = np.stack([stack[z][place.read[1:]] for z in range(len(stack))])
        steps = None if k == self.busiest else self.course()["steps"]
        made = self.how.restored(part, self.psf, steps=steps, noise_share=0.0)
        self.keep(NAME, k, as_grey(made.volume[place.inner], self.how.background, part.dtype))
        return {"steps": made.steps, "stopped": made.stopped, "residual": made.residual}

    def course(self) -> dict[str, Any]:
        """Return what the tile with the most contrast said."""
        return self.said(self.busiest)


@dataclass(frozen=True)
class Joined(Slabs):
    """Tiles put together to planes."""

    restored: Restoring

    def title(self, name: str) -> str:
        """Return what is written in the image, as in memory."""
        del name
        return TITLE

    def do(self, k: int) -> dict[str, Any]:
        """Put some planes together."""
        for z in self.planes(k):
            box = (slice(z, z + 1), *(slice(0, n) for n in self.shape[1:]))
            self.write(NAME, z, self.restored.read(NAME, box)[0])
        return {}


def deblur_by_blocks(
    source: Source,
    psf: Array,
    settle: Callable[[Known], Deblurring],
    layout: FocalArray,
    blocks: Blocks,
    output: Path,
    *,
    told: dict[str, Any],
    overwrite: bool,
    quiet: bool,
) -> tuple[Path, Deblurring, Known, Course]:
    """Deblur a stack tile by tile.

    Parameters
    ----------
    source : Source
    psf : array float32
    settle : callable
        Says how it is deblurred once the stack is known.
    layout : FocalArray
        Of the image that is made.
    blocks : Blocks
        What the user said.
    output : Path
        Folder of the results.
    told : dict
        What else must be the same for tiles to be used again.

    Returns
    -------
    Path, Deblurring, Known, Course
        The OME-Zarr image, among the blocks; how it was deblurred, and how that went.

    Raises
    ------
    InputError
        ``blockwise``: a linear inverse looks at the whole; ``memory``, ``scheduler``, ``blocks-left``,
        ``blocks-other``.
    """
    if told["method"] == "wiener":
        raise whole_needed("--method wiener")
    stack = source.stack
    shape = (len(stack), stack.shape[0], stack.shape[1])
    halo = halo_px(told["method"], psf.shape)
    workers = at_once(blocks) if blocks.scheduler else max(1, at_once(blocks) // WORKERS)
    plane = float(READ_BYTES * shape[1] * shape[2])

    def needs(side: int) -> float:
        return plane + max(tile_bytes(shape, psf.shape, max(halo), side), plane)

    what = "a tile of all planes with what is around it"
    side, count = fitted(amount(blocks.memory), tile_sides(shape), needs, workers, what)
    job = {**source.told(), **told, "psf": crc32(psf.tobytes())}
    with begun(output, job, {"side": side}, count, blocks, overwrite=overwrite, quiet=quiet) as going:
        there, side = source.absolute, going.plan["side"]
        cuts = tuple(tiles(shape, (shape[0], side, side), halo))
        survey = Survey(going.work / "survey", there, shape[0], cuts)
        going.do("looking at planes", survey)
        how = settle(survey.known())
        place = (going.work / "restored", shape, side, halo)
        for alone in (True, False):
            restoring = Restoring(*place, there, psf, how, survey.busiest(), alone)
            going.do("deblurring", restoring)
        joined = Joined(going.work / "joined", shape, min(MOST_PLANES, SURVEYED), ((NAME, layout),), restoring)
        going.do("joining tiles", joined)
        first = restoring.course()
    course = Course(first["steps"], first["stopped"], tuple(first["residual"]), len(cuts), halo)
    return joined.image(NAME), how, survey.known(), course
