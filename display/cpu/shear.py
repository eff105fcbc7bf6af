"""Moving volumes on the processor: planes are sheared over each other, and what they make is turned into place.

After Lacroute and Levoy (1994, SIGGRAPH, 451). Parallel views alone. One sample a plane, interpolated within it: a
picture differs a little from the ray caster's, and is made in a fraction of the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from display.cpu import fast, inlined, over_rows
from display.cpu.bricks import SIDE, Bricks
from display.cpu.cast import (
    LIGHT,
    MAX,
    MIN,
    OPAQUE,
    SUM,
    finer,
    first_opaque,
    flat,
    seen_above,
)
from display.cpu.sampling import FAR, LOW, PER_VALUE, START

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.cast import Casting
    from display.rays import Rays

    Array = NDArray[Any]

COARSER = 4  # entries of a table of colours left out: what remains stays where the processor has it at once
NOTHING: Any = np.bool_(0)
AXES = {0: (2, 0, 1), 1: (1, 0, 2), 2: (0, 1, 2)}  # array axes of a volume swept along x, y, z: planes, rows, columns


def shearable(kind: int, seen_by: Rays, numbers: Casting) -> bool:
    """Tell whether rays can be had this way: parallel ones, that gather and look for no surface."""
    return kind in {MAX, MIN, SUM, LIGHT} and seen_by.eye is None and numbers.surface == 0


def swept(bricks: Bricks, axis: int) -> Bricks:
    """Return bricks whose planes, rows and columns are those of a sweep along an axis (x, y, z)."""
    return Bricks(*(np.ascontiguousarray(np.transpose(part, AXES[axis])) for part in vars(bricks).values()))


def main_axis(seen_by: Rays) -> int:
    """Return the axis (x, y, z) along which rays pass most voxels."""
    return int(np.abs(seen_by.along).argmax())


@dataclass(frozen=True)
class Shear:
    """Where planes come to lie before the nearest of them.

    Attributes
    ----------
    planes : array (planes, 4)
        Index of each plane in a volume with a rim, the nearest first; what is added to a column and a row of the
        picture to find its value there; and the share of an emission that fog lets through from there to the nearest.
    size : (int, int)
        Columns and rows of the picture.
    shown : array (4,)
        Lowest and highest column, lowest and highest row of the volume with a rim.
    ds_um : float
        Length of a ray from plane to plane.
    """

    planes: Array
    size: tuple[int, int]
    shown: Array
    ds_um: float


def shear(along: Array, low: Array, high: Array, fade_per_um: float) -> Shear:
    """Return the shear for rays along (column, row, plane), voxels per µm, and a box of these."""
    slope, ds_um = along[:2] / along[2], float(1 / abs(along[2]))
    places = np.arange(np.ceil(low[2]), np.floor(high[2]) + 1)
    order = places if along[2] > 0 else places[::-1]
    moved = (order - order[:1])[:, None] * slope
    corner = np.floor(low[:2] - moved.max(axis=0, initial=0))
    size = np.ceil(high[:2] - moved.min(axis=0, initial=0)) - corner + 1
    fog = np.exp(-fade_per_um * ds_um * np.arange(len(order)))
    planes = np.column_stack([order + 1, moved + corner + 1, fog])
    shown = np.array([low[0], high[0], low[1], high[1]]) + 1
    return Shear(planes, (int(size[0]), int(size[1])), shown, ds_um)


def cast_sheared(
    kind: int,
    volume: Bricks,
    seen_by: Rays,
    box: tuple[Array, Array],
    size: tuple[int, int],
    numbers: Casting,
    table: Array | None = None,
) -> NDArray[np.float32]:
    """Cast a picture as `display.cpu.cast.cast` does; ``volume`` is `swept` along the `main_axis`."""
    order = [2 - k for k in reversed(AXES[main_axis(seen_by)])]  # of (x, y, z), for columns, rows and planes
    corner, right, down, along = (part[order] for part in (seen_by.corner, seen_by.right, seen_by.down, seen_by.along))
    sheared = shear(along, box[0][order], box[1][order], numbers.fade_per_um)
    if not len(sheared.planes):
        return np.zeros((size[1], size[0], 4), np.float32)
    wide, tall = sheared.size
    given, colours = flat(numbers), over_length(finer(table)[::COARSER], sheared.ds_um)
    bounds = volume.low if kind == MIN else volume.high
    spans = np.empty((*bounds.shape[:2], bounds.shape[2] + 2), np.int32)
    find_spans(kind, bounds, given, colours, spans)
    found = np.zeros((tall, wide, 4) if kind == LIGHT else (tall, 4, wide), np.float32)
    if kind <= MIN:
        found[:, 0] = -FAR
    over_rows(
        tall,
        lambda first, last: shear_rows(
            kind,
            volume.padded,
            spans,
            sheared.planes,
            sheared.shown,
            sheared.ds_um,
            given,
            colours,
            np.empty(wide, np.int32),
            first,
            last,
            found,
        ),
    )
    # a pixel's ray meets the nearest plane here
    near_um = (sheared.planes[0, 0] - 1 - corner[2]) / along[2]
    steps = np.column_stack([right - along * right[2] / along[2], down - along * down[2] / along[2]])[:2]
    place = (corner + along * near_um)[:2] + 1 - sheared.planes[0, 1:3]
    laid = found if kind == LIGHT else np.ascontiguousarray(found.transpose(0, 2, 1))
    seen = cv2.warpAffine(laid, np.column_stack([steps, place]), size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    if kind == SUM and numbers.fade_per_um > 0:
        j, i = np.mgrid[: size[1], : size[0]]
        reached_um = near_um - (i * right[2] + j * down[2]) / along[2]
        seen[..., 0] *= np.exp(-numbers.fade_per_um * (reached_um - numbers.front_um))
    return np.asarray(seen, np.float32)


def over_length(table: Array, length_um: float) -> NDArray[np.float32]:
    """Return what a length of matter adds, (entries, 4): its light, and what it takes away of the light behind it."""
    opacity = -np.expm1(-table[:, 3:] * length_um)
    return np.asarray(np.hstack([table[:, :3] * opacity, opacity]), np.float32)


@fast
def shear_rows(
    kind: int,
    volume: Array,
    spans: Array,
    planes: Array,
    shown: Array,
    ds: float,
    numbers: Array,
    table: Array,
    entries: Array,
    first: int,
    last: int,
    found: Array,
) -> None:
    """Lay all planes over some rows of the picture, the nearest first."""
    for v in range(first, last):
        row = found[v]
        for s in range(planes.shape[0]):
            y = v + planes[s, 2]
            if shown[2] <= y <= shown[3]:
                lay_plane(kind, volume, spans, planes[s], y, shown, numbers, table, entries, row)
        if kind != LIGHT:
            finish(kind, ds, numbers, row)


@fast
def shown_above(kind: int, numbers: Array, table: Array) -> float:
    """Return what a brick's highest value (or its lowest, times -1) must exceed so that anything is seen of it."""
    if kind == MIN:
        return float(-(numbers[LOW] + 1 / numbers[PER_VALUE]))
    return float(seen_above(table, numbers) if kind == LIGHT else numbers[LOW])


@fast
def find_spans(kind: int, bounds: Array, numbers: Array, table: Array, spans: Array) -> None:
    """Write for each row of bricks where there is something to see: first column and first beyond, in turn, then -1."""
    sign, least = (-1 if kind == MIN else 1), shown_above(kind, numbers, table)
    for k in range(bounds.shape[0]):
        for j in range(bounds.shape[1]):
            count, before = 0, NOTHING
            for i in range(bounds.shape[2]):
                shown = sign * np.float64(bounds[k, j, i]) > least
                if shown != before:
                    spans[k, j, count] = i * SIDE
                    count, before = count + 1, shown
            if before:
                spans[k, j, count] = bounds.shape[2] * SIDE
                count += 1
            spans[k, j, count] = -1


@inlined
def lay_plane(
    kind: int,
    volume: Array,
    spans: Array,
    plane: Array,
    y: float,
    shown: Array,
    numbers: Array,
    table: Array,
    entries: Array,
    row: Array,
) -> None:
    """Lay a row of a plane behind what is there, where there is something to see."""
    k, j, moved = int(plane[0]), int(y), int(np.floor(plane[1]))
    begin = max(START, int(np.ceil(shown[0] - plane[1])))
    end = min(row.size // 4, int(np.floor(shown[1] - plane[1])) + 1)
    fy, fx = np.float32(y - j), np.float32(plane[1] - moved)
    found = spans[k // SIDE, j // SIDE]
    n = 0
    while found[n] >= 0:
        first, last = max(begin, found[n] - moved), min(end, found[n + 1] - moved)
        if last > first:
            lay(
                kind, volume[k, j], volume[k, j + 1], moved, fx, fy, plane[3], numbers, table, entries, first, last, row
            )
        n += 2


@inlined
def lay(
    kind: int,
    near: Array,
    far: Array,
    moved: int,
    fx: Any,
    fy: Any,
    fog: float,
    numbers: Array,
    table: Array,
    entries: Array,
    begin: int,
    end: int,
    row: Array,
) -> None:
    """Lay a part of a row of a plane behind what is there."""
    low, scale = np.float32(numbers[LOW]), np.float32(numbers[PER_VALUE])
    # parts counted from 0: no index can then be negative, and the compiler does many voxels at once
    one, two = near[begin + moved : end + moved + 1], far[begin + moved : end + moved + 1]
    count = end - begin
    if kind == LIGHT:
        last = np.float32(table.shape[0] - 1)
        for u in range(count):
            v = min(max((within(one, two, u, fx, fy) - low) * scale, np.float32(0)), np.float32(1))
            entries[u] = np.int32(v * last + np.float32(0.5))
        add_matter(entries, count, table, row[begin:end])
        return
    out = row[0, begin:end]
    if kind == SUM:
        full = np.float32(fog)
        for u in range(count):
            out[u] += min(max((within(one, two, u, fx, fy) - low) * scale * full, np.float32(0)), full)
    else:
        sign = np.float32(1 if kind == MAX else -1)
        for u in range(count):
            out[u] = max(out[u], sign * within(one, two, u, fx, fy))


@fast
def add_matter(entries: Array, count: int, table: Array, row: Array) -> None:
    """Add the light of some voxels, and what they absorb, behind what is there."""
    lowest = first_opaque(table)
    for u in range(count):
        entry = entries[u]
        if entry >= lowest and row[u, 3] < np.float32(1 - OPAQUE):
            left = np.float32(1) - row[u, 3]
            for c in range(4):
                row[u, c] += left * table[np.uint32(entry), c]


@fast
def within(near: Array, far: Array, i: int, fx: Any, fy: Any) -> Any:
    """Interpolate between two rows of a plane."""
    a, b = np.float32(near[i]), np.float32(far[i])
    a += fx * (np.float32(near[i + 1]) - a)
    b += fx * (np.float32(far[i + 1]) - b)
    return a + fy * (b - a)


@fast
def finish(kind: int, ds: float, numbers: Array, row: Array) -> None:
    """Make what was gathered what `cast` returns."""
    for u in range(row.shape[1]):
        row[2, u] = 1
        if kind == SUM:
            row[0, u] *= ds
        elif row[0, u] > -FAR:
            value = -row[0, u] if kind == MIN else row[0, u]
            row[0, u] = min(max((value - numbers[LOW]) * numbers[PER_VALUE], 0.0), 1.0)
        else:  # no plane is there
            row[0, u] = row[2, u] = 0
