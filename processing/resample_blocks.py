"""Cubic voxels of a stack larger than memory: slabs of the new planes, each from the few old ones it lies between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from processing.block_job import at_once, begun
from processing.blockwise import MOST_PLANES, amount, fitted
from processing.pieces import READ_BYTES
from processing.resample import KEPT, NAME, TITLE, CubicPlanes, Method
from processing.slabs import Slabs

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.ome_zarr import FocalArray
    from processing.block_options import Blocks
    from processing.block_source import Source

SUM_BYTES, WRITE_COPIES = 16, 4  # of a pixel of a new plane


@dataclass(frozen=True)
class CubicSlabs(Slabs):
    """Slabs of the planes of cubic voxels."""

    source: Source
    pixel_um: float
    side_um: float
    method: Method

    def title(self, name: str) -> str:
        """Return what is written in the image, as in memory."""
        del name
        return TITLE

    def do(self, k: int) -> dict[str, Any]:
        """Make the planes of a slab one after the other."""
        stack = self.source.stack
        assert stack.z_um is not None
        planes = CubicPlanes(stack, stack.z_um, self.pixel_um, self.side_um, self.method)
        for z in self.planes(k):
            self.write(NAME, z, planes[z])
        return {}


def resampled_by_blocks(
    source: Source,
    pixel_um: float,
    planes: CubicPlanes,
    layout: FocalArray,
    blocks: Blocks,
    output: Path,
    *,
    overwrite: bool,
    quiet: bool,
) -> Path:
    """Make the planes of cubic voxels slab by slab, the same bit for bit as one after the other.

    Returns
    -------
    Path
        The OME-Zarr image, among the blocks.

    Raises
    ------
    InputError
        ``memory``: not even one plane at a time fits; ``blocks-left``, ``blocks-other``, ``scheduler``.
    """
    workers = at_once(blocks)
    wanted = max(1, min(MOST_PLANES, -(-len(planes) // (2 * workers))))
    needs = plane_bytes(source, layout)
    side, count = fitted(amount(blocks.memory), [wanted], lambda _: needs, workers, "a plane and what it is made of")
    job = {**source.told(), "pixel_um": pixel_um, "side_um": planes.side_um, "method": planes.method}
    with begun(output, job, {"planes": side}, count, blocks, overwrite=overwrite, quiet=quiet) as going:
        outs = ((NAME, layout),)
        shape = (len(planes), *planes.shape)
        how = (source.absolute, pixel_um, planes.side_um, planes.method)
        slabs = CubicSlabs(going.work / "resampled", shape, going.plan["planes"], outs, *how)
        going.do("resampling", slabs)
    return slabs.image(NAME)


def plane_bytes(source: Source, layout: FocalArray) -> float:
    """Return about what making one plane takes: the old ones that are kept at the new size, sums, and writing."""
    old = source.stack.shape[0] * source.stack.shape[1] * layout.bands
    new = layout.shape[0] * layout.shape[1] * layout.bands
    return float(old * READ_BYTES + new * (SUM_BYTES + source.stack.dtype.itemsize * (KEPT + WRITE_COPIES)))
