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
from processing.blockwise import amount, fitted
from processing.deblur import WORKERS
from processing.deblur_known import Known, plane_said, summed
from processing.deblur_tiles import NAME, TITLE, Course, Deblurring, as_grey, halo_px, tile_bytes, tile_sides
from processing.pieces import PLANES_EACH, READ_BYTES, Cut, Tiled
from processing.slabs import Slabs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.ome_zarr import FocalArray
    from processing.block_options import Blocks
    from processing.block_source import Source

    Array = NDArray[Any]


@dataclass(frozen=True)
class Survey(Cut):
    """What must be known of whole planes, and how much each tile of them shows."""

    source: Source

    def plane(self, z: int) -> Array:
        """Return a plane."""
        return self.source.stack[z]

    def look(self, plane: Array) -> dict[str, Any]:
        """Look at a plane."""
        sums = [moments(plane[rows, columns][::2, ::2]) for rows, columns in self.boxes]
        return {"said": plane_said(plane), "moments": sums}

    def known(self) -> Known:
        """Return what is known of the whole."""
        return summed([about["said"] for about in self.looked()])

    def busiest(self) -> int:
        """Return the number of the tile with the most contrast."""
        planes = np.array([about["moments"] for about in self.looked()], np.float64)
        count, total, squares = planes.sum(axis=0).T
        return int(np.argmax(squares / count - (total / count) ** 2))


def moments(pixels: Array) -> tuple[int, int, int]:
    """Return how many pixels there are, their sum, and that of their squares."""
    flat = pixels.ravel().astype(np.uint64)
    return flat.size, int(flat.sum()), int(flat @ flat)


@dataclass(frozen=True)
class Restoring(Tiled):
    """Every tile restored; the one with the most contrast alone first, since it decides how many steps all take."""

    planes: Survey
    psf: Array
    how: Deblurring
    busiest: int
    alone: bool

    def pending(self) -> list[int]:
        """Numbers of the tiles to be done now."""
        return [k for k in super().pending() if not self.alone or k == self.busiest]

    def do(self, k: int) -> dict[str, Any]:
        """Restore a tile."""
        place = self.places[k]
        part = np.stack([self.planes.part(z, *place.read[1:]) for z in range(self.shape[0])])
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
        return max(tile_bytes(shape, psf.shape, max(halo), side), plane)

    what = "a tile of all planes with what is around it"
    side, count = fitted(amount(blocks.memory), tile_sides(shape), needs, workers, what)
    job = {**source.told(), **told, "psf": crc32(psf.tobytes())}
    with begun(output, job, {"side": side}, count, blocks, overwrite=overwrite, quiet=quiet) as going:
        there, side = source.absolute, going.plan["side"]
        survey = Survey(going.work / "planes", shape[0], shape[1:], str(stack.dtype), side, there)
        going.do("cutting planes", survey)
        how = settle(survey.known())
        place = (going.work / "restored", shape, side, halo)
        for alone in (True, False):
            restoring = Restoring(*place, survey, psf, how, survey.busiest(), alone)
            going.do("deblurring", restoring)
        joined = Joined(going.work / "joined", shape, PLANES_EACH, ((NAME, layout),), restoring)
        going.do("joining tiles", joined)
        first = restoring.course()
    course = Course(first["steps"], first["stopped"], tuple(first["residual"]), len(restoring.places), halo)
    return joined.image(NAME), how, survey.known(), course
