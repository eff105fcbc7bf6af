"""Extended focus and range of stacks whose planes are too large for memory: tile by tile, through all planes of each.

What a tile must know of whole planes is found first: noise and brightness of each, and how planes are registered. Tiles
are then measured with as much around them as the widest window looks at, and composed once it is known over which
depth, which the typical width of all focus curves tells.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from processing.block_job import at_once, begun
from processing.blockwise import amount, fitted
from processing.focus import (
    SHARPNESS,
    CheckedPlanes,
    FocusResult,
    FocusSweep,
    PlaneFacts,
    RangeImage,
    gather,
    made_choices,
    plane_facts,
    plane_positions,
    reach_of,
    registered,
    sure_widths,
)
from processing.focus_windows import CONFIDENT
from processing.marked import Marked
from processing.outputs import (
    SPAN_PERCENT,
    as_stored,
    image_words,
    measured,
    publish_focus,
    write_previews,
    write_tiff_in_bands,
)
from processing.pieces import READ_BYTES, Cut, Tiled, percentiles, ranked
from processing.registration import Placement, RegisteredPlanes
from processing.tiles import Tile, tiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path
    from typing import Literal

    from numpy.typing import NDArray

    from processing.block_job import Going
    from processing.block_options import Blocks
    from processing.block_source import Source
    from processing.focus_tracks import Method, Options
    from processing.stack import Stack
    from processing.tiles import Box

    Array = NDArray[Any]
    W = TypeVar("W", bound=Marked)

# Pixels around a tile that have a say in it, and of which its corners are multiples: windows and pyramids are halved
# from there as they are in the whole, and sums of single floats are taken in the same order.
HALO_PX: dict[Method, int] = {"brightfield": 256, "transparent": 640, "confocal": 64, "threshold": 0}
CORNER_PX: dict[Method, int] = {"brightfield": 256, "transparent": 128, "confocal": 64, "threshold": 64}
REGISTER_BYTES = 20  # of a pixel while planes are matched
SHOWN_PX = 2048  # longer side of the pictures for the eye, at most
LAYERS = ("range", "confidence", "plane", "width")


@dataclass(frozen=True)
class Registering(Marked):
    """How planes are matched: one part, since each follows from the one before."""

    source: Source
    wanted: bool | Literal["auto"]

    @property
    def places(self) -> list[Tile]:
        """One part."""
        return list(tiles((1,), (1,), (0,)))

    def do(self, k: int) -> dict[str, Any]:
        """Match all planes."""
        del k
        stack = self.source.stack
        placed, said = registered(CheckedPlanes(stack, stack.shape[:2]), wanted=self.wanted)
        places = [asdict(p) for p in placed.placements] if isinstance(placed, RegisteredPlanes) else []
        return {"placements": places, "registration": said}


@dataclass(frozen=True)
class Survey(Cut):
    """Planes as they are measured, and what must be known of each as a whole.

    Attributes
    ----------
    source : Source
    placements : tuple of Placement
        Of every plane; none where they are taken as they are.
    band : int, optional
        Of colour planes, that decides.
    """

    source: Source
    placements: tuple[Placement, ...]
    band: int | None

    def plane(self, z: int) -> Array:
        """Return a plane, registered where planes are."""
        stack = self.source.stack
        return (RegisteredPlanes(stack, self.placements) if self.placements else stack)[z]

    def look(self, plane: Array) -> PlaneFacts:
        """Return noise and brightness of a plane."""
        return plane_facts(plane, self.band)

    def facts(self) -> tuple[PlaneFacts, ...]:
        """Return what is known of every plane."""
        return tuple(PlaneFacts(*facts) for facts in self.looked())

    def parts(self, box: Box) -> Iterator[Array]:
        """Yield the same part of every plane."""
        return (self.part(z, *box) for z in range(self.count))


@dataclass(frozen=True)
class Measured(Tiled):
    """Range, confidence, plane and width of every tile; with the method transparent the picture, too."""

    planes: Survey
    options: Options
    facts: tuple[PlaneFacts, ...]
    z: tuple[float, ...]

    def do(self, k: int) -> dict[str, Any]:
        """Measure a tile through all planes."""
        place = self.places[k]
        rows, columns = (s.stop - s.start for s in place.read)
        sweep = FocusSweep((rows, columns), **self.options)
        for plane, about in zip(self.planes.parts(place.read), self.facts, strict=True):
            sweep.add(plane, about)
        image = sweep.finish(np.array(self.z))
        layers: tuple[Array, ...] = (image.range_, image.confidence, image.plane, image.width)
        for name, layer in zip(LAYERS, layers, strict=True):
            self.keep(name, k, layer[place.inner])
        if self.options["method"] == "transparent":
            self.keep("extended_focus", k, sweep.soft_picture()[place.inner])
        sure = int(np.sum(image.confidence[place.inner] >= CONFIDENT))
        return {"noise": image.noise, "sure": sure, "edge": int(np.sum(image.edge[place.inner]))}

    def sure_widths(self) -> Iterator[Array]:
        """Yield the widths of the focus curve that are known, tile by tile."""
        return (sure_widths(self.load("confidence", k), self.load("width", k)) for k in range(len(self.places)))

    def curve_width(self) -> float:
        """Typical width of the focus curve, as of the whole."""
        if not any(widths.size for widths in self.sure_widths()):
            return 0.0
        middle = ranked(self.sure_widths, lambda count: [(count - 1) // 2, count // 2])
        return float(np.median(np.array(middle, np.float32)))

    def span(self) -> list[float | None]:
        """Percentiles of the range, of what is sure where anything is."""

        def known(sure: bool) -> Iterator[Array]:  # noqa: FBT001  no one's but this function's
            for k in range(len(self.places)):
                range_ = self.load("range", k)
                there = np.isfinite(range_)
                yield range_[there & (self.load("confidence", k) >= CONFIDENT) if sure else there]

        for values in (partial(known, True), partial(known, False)):  # noqa: FBT003
            if any(some.size for some in values()):
                return list(percentiles(values, list(SPAN_PERCENT.values())))
        return [None] * len(SPAN_PERCENT)


@dataclass(frozen=True)
class Gathered(Tiled):
    """The extended focus of every tile, once its range and the depth that is averaged over are known."""

    ranges: Measured
    reach: float

    def do(self, k: int) -> dict[str, Any]:
        """Compose a tile from all planes."""
        place = self.places[k]
        layers = (np.array(self.ranges.load(name, k)) for name in LAYERS)
        range_, confidence, plane, width = layers
        image = RangeImage(range_, confidence, plane, width, plane == 0, 0.0, np.array(self.ranges.z))
        self.keep("extended_focus", k, gather(self.ranges.planes.parts(place.write), image, self.reach))
        return {}


@dataclass(frozen=True)
class InPieces:
    """What was found, in pieces, and small enough to be looked at.

    Attributes
    ----------
    shown : FocusResult
        Every n-th pixel of the images; all numbers are those of the whole.
    every : int
        That n.
    span : list of float
        Percentiles of the range.
    ranges, pictures : Tiled
        Where the layers lie in pieces.
    """

    shown: FocusResult
    every: int
    span: list[float | None]
    ranges: Measured
    pictures: Tiled

    def write(self, folder: Path, *, pixel_um: float | None, facts: dict[str, Any]) -> dict[str, Any]:
        """Write what `write_focus_result` does, images from top to bottom; returns the report."""

        def fill(aside: Path) -> list[str]:
            images = image_words(self.shown)
            for name, (layer, words) in images.items():
                bands = (as_stored(band) for band in self.bands(layer))
                write_tiff_in_bands(aside / name, bands, self.ranges.shape, pixel_um, words)
            size = None if pixel_um is None else pixel_um * self.every
            return [*images, *write_previews(aside, self.shown, size)]

        return publish_focus(folder, {**measured(self.shown, self.span), "pixel_um": pixel_um, **facts}, fill)

    def bands(self, layer: str) -> Iterator[Array]:
        """Yield an image from top to bottom."""
        return (self.pictures if layer == "extended_focus" else self.ranges).bands(layer)


def tile_bytes(stack: Stack, per_pixel: float, halo: int, side: int, *, register: bool) -> float:
    """Return about what measuring one tile takes, or reading one whole plane."""
    whole = stack.shape[0] * stack.shape[1]
    pixels = np.prod([min(n, side + 2 * halo) for n in stack.shape[:2]])
    read = READ_BYTES * whole * (3 if stack.colour else 1)
    return float(max(pixels * per_pixel, read + (REGISTER_BYTES * whole if register else 0)))


def tile_sides(stack: Stack, method: Method, count: int) -> range:
    """Return the sides a tile may have, the largest first: so that there is one for each of ``count`` workers."""
    corner = CORNER_PX[method]
    return range(corner * max(1, -(-max(stack.shape[:2]) // (count * corner))), corner - 1, -corner)


def focus_by_blocks(
    source: Source,
    options: Options,
    register: bool | Literal["auto"],  # noqa: FBT001  as in `focus_stack`
    per_pixel: float,
    blocks: Blocks,
    output: Path,
    *,
    overwrite: bool,
    quiet: bool,
) -> InPieces:
    """Measure a stack tile by tile; pieces lie in the folder of the results.

    Parameters
    ----------
    source : Source
    options, register
        As for `focus_stack`.
    per_pixel : float
        Bytes that measuring one pixel takes.
    blocks : Blocks
        What the user said.
    output : Path
        Folder of the results.

    Raises
    ------
    InputError
        ``memory``, ``blocks-left``, ``blocks-other``, ``scheduler``, and what `focus_stack` raises.
    """
    stack, method, workers = source.stack, options["method"], at_once(blocks)
    plane_positions(stack.z_um, len(stack))
    wanted = register if method in SHARPNESS else register is True
    halo, what = HALO_PX[method], f"a tile of {CORNER_PX[method]} pixels and {HALO_PX[method]} around it"
    sides = tile_sides(stack, method, workers)

    def needs(side: int) -> float:
        return tile_bytes(stack, per_pixel, halo, side, register=bool(wanted))

    side, count = fitted(amount(blocks.memory), sides, needs, workers, what)
    job = {**source.told(), **options, "register": register}
    with begun(output, job, {"side": side}, count, blocks, overwrite=overwrite, quiet=quiet) as going:
        return Focusing(going, source.absolute, options).done(wanted)


@dataclass(frozen=True)
class Focusing:
    """A stack being measured tile by tile."""

    going: Going
    source: Source
    options: Options

    def done(self, register: bool | Literal["auto"]) -> InPieces:  # noqa: FBT001  as above
        """Do all of it."""
        matching = Registering(self._at("registering"), self.source, register)
        told = self._did("matching planes", matching).said(0) if register else matching.do(0)
        ranges = self._measured(tuple(Placement(**p) for p in told["placements"]))
        width = ranges.curve_width()
        soft, z = self.options["method"] == "transparent", np.array(ranges.z)
        reach = reach_of(width, z) if self.options["method"] == "brightfield" else 0.0
        place = (self._at("gathered"), ranges.shape, ranges.side, (0, 0))
        pictures: Tiled = ranges if soft else self._did("gathering focus", Gathered(*place, ranges, reach))
        return self._shown(ranges, pictures, width, reach, told["registration"])

    def _measured(self, placements: tuple[Placement, ...]) -> Measured:
        stack, method, side = self.source.stack, self.options["method"], self.going.plan["side"]
        planes = (self._at("planes"), len(stack), stack.shape, str(stack.dtype), side)
        survey = self._did("cutting planes", Survey(*planes, self.source, placements, self.options.get("band")))
        z = plane_positions(stack.z_um, len(stack))
        place = (self._at("measured"), stack.shape[:2], side, (HALO_PX[method],) * 2)
        measured = Measured(*place, survey, self.options, survey.facts(), tuple(z.tolist()))
        return self._did("measuring focus", measured)

    def _shown(
        self, ranges: Measured, pictures: Tiled, width: float, reach: float, registration: dict[str, Any]
    ) -> InPieces:
        said, size = ranges.found(), int(np.prod(ranges.shape))
        every = -(-max(ranges.shape) // SHOWN_PX)
        share = {name: sum(s[name] for s in said) / size for name in ("sure", "edge")}
        parameters = made_choices(
            self.options,
            planes=len(ranges.z),
            blank=[k for k, about in enumerate(ranges.facts) if about.noise is None],
            width=width,
            reach=reach,
            share_in_end_planes=share["edge"],
        )
        result = FocusResult(
            extended_focus=thinned(pictures.bands("extended_focus"), every),
            **{name: thinned(ranges.bands(name), every) for name in LAYERS},
            unit="plane" if self.source.stack.z_um is None else "um",
            noise=said[0]["noise"],
            share_confident=share["sure"],
            parameters={**parameters, "registration": registration},
        )
        return InPieces(result, every, ranges.span(), ranges, pictures)

    def _at(self, name: str) -> Path:
        return self.going.work / name

    def _did(self, title: str, work: W) -> W:
        self.going.do(title, work)
        return work


def thinned(bands: Iterable[Array], every: int) -> Array:
    """Return every n-th pixel of an image that comes from top to bottom."""
    kept, start = [], 0
    for band in bands:
        kept.append(np.array(band[-start % every :: every, ::every]))
        start += len(band)
    return np.concatenate(kept)
