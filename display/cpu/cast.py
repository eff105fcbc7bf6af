"""The ray loop on the processor: the same steps and the same pictures as ``shaders/cast.frag.glsl``.

A sample lies at the middle of each of n equal steps between the points where a ray enters and leaves the volume. Bricks
without anything to see are leaped over by whole steps, so that leaping changes nothing. Numbers come as one array, and
all modes are one kernel: it is compiled once for each type of voxel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from display.cpu import fast, over_rows
from display.cpu.sampling import (
    FADE,
    FAR,
    FRONT,
    LIGHT_X,
    LOW,
    PER_VALUE,
    RUN,
    START,
    SURFACE,
    THRESHOLD,
    TINY,
    Grid,
    Room,
    at,
    backwards,
    begin_of,
    draw,
    grid,
    next_run,
    ray,
    room,
    voxel_at,
    walk,
)
from display.cpu.surfaces import glimpse, steepest, surface

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.bricks import Bricks
    from display.rays import Rays

    Array = NDArray[Any]
    Line = tuple[float, ...]

MAX, MIN, SUM, LIGHT, FIRST, LAST, EDGE, ABSORB = range(8)
OPAQUE = 0.005  # light that still comes through when a ray is ended
OUTSIDE: Any = np.bool_(0)  # with a type of its own, as START
BARELY = 0.01  # of a value, by which something must be less to be surely less
TABLE = 2048  # entries of a table of colours
LAST_ENTRY = TABLE - 1


class Casting(NamedTuple):
    """Numbers of a cast.

    Attributes
    ----------
    low, per_value : float
        Value that counts as 0, and what a value counts above it.
    step_um : float
    perspective : bool
    threshold : float
        0 to 1.
    fade_per_um, front_um : float
        Light lost on the way, counted from ``front_um`` behind the screen plane.
    surface : float
        Opacity of the surface in translucent matter.
    light : tuple of 3 float
        To the light, (x, y, z).
    answer : tuple of 4 float
        Ambient, diffuse, specular, shininess.
    """

    low: float
    per_value: float
    step_um: float
    perspective: bool
    threshold: float = 0.5
    fade_per_um: float = 0.0
    front_um: float = 0.0
    surface: float = 0.0
    light: tuple[float, float, float] = (0.0, 0.0, -1.0)
    answer: tuple[float, float, float, float] = (0.15, 0.75, 0.25, 20.0)


def cast(
    kind: int,
    bricks: Bricks,
    rays: Rays,
    box: tuple[Array, Array],
    size: tuple[int, int],
    numbers: Casting,
    *,
    table: Array | None = None,
    lit: Bricks | None = None,
) -> NDArray[np.float32]:
    """Cast every ray of a picture.

    Parameters
    ----------
    kind : int
        What becomes of the samples: ``MAX`` and so on.
    box : (array (3,), array (3,))
        Opposite corners of what is shown, (x, y, z) in voxels.
    size : (int, int)
        Width and height of the picture.
    table : array (256, 4) float32, optional
        Light and absorption per µm of values, for ``LIGHT``.
    lit : Bricks of uint8, optional
        Share of the light that reaches each voxel, for ``LIGHT``.

    Returns
    -------
    array (height, width, 4) float32
        What the mode's snippet calls ``seen``.
    """
    seen = np.zeros((size[1], size[0], 4), np.float32)
    eye = np.zeros(3) if rays.eye is None else rays.eye
    geometry = np.stack([rays.corner, rays.right, rays.down, rays.along, eye, rays.voxel_um, *box])
    given, colours = flat(numbers), finer(table)
    bounds = bricks.low if kind == MIN else bricks.high
    volume = grid(bricks)
    light = volume if lit is None else grid(lit)

    def cast_some(*rows: int) -> None:
        cast_rows(kind, volume, room(bricks), bounds, geometry, given, colours, light, lit is not None, rows, seen)

    over_rows(size[1], cast_some)
    return seen


def flat(numbers: Casting) -> NDArray[np.float64]:
    """Return the numbers of a cast as one array."""
    return np.array([*numbers[:LIGHT_X], *numbers.light, *numbers.answer], np.float64)


def finer(table: Array | None) -> NDArray[np.float32]:
    """Return a table of colours with so many entries that the nearest one is as good as interpolating."""
    if table is None:
        return np.zeros((TABLE, 4), np.float32)
    places, given = np.linspace(0, 1, TABLE), np.linspace(0, 1, len(table))
    return np.stack([np.interp(places, given, column) for column in table.T], axis=1).astype(np.float32)


@fast
def cast_rows(
    kind: int,
    grid: Grid,
    room: Room,
    bounds: Array,
    geometry: Array,
    numbers: Array,
    table: Array,
    light: Grid,
    shadows: bool,  # noqa: FBT001
    rows: tuple[int, ...],
    seen: Array,
) -> None:
    """Cast the rays of some rows."""
    for j in range(rows[0], rows[1]):
        for i in range(seen.shape[1]):
            line = ray(geometry, i, j, numbers)
            if line[0] <= 0:
                continue
            if kind == MAX:
                extreme(np.float32(1), grid, room, bounds, line, numbers, seen[j, i])
            elif kind == MIN:
                extreme(np.float32(-1), grid, room, bounds, line, numbers, seen[j, i])
            elif kind == SUM:
                gather(grid, room, bounds, line, numbers, seen[j, i])
            elif kind == LIGHT:
                shine(grid, room, bounds, line, numbers, geometry[5], table, light, shadows, seen[j, i])
            else:
                rest(kind, grid, room, bounds, line, numbers, geometry[5], seen[j, i])


@fast
def rest(
    kind: int, grid: Grid, room: Room, bounds: Array, line: Line, numbers: Array, voxel: Array, seen: Array
) -> None:
    """Add lengths, or find the surface a mode shows."""
    if kind == ABSORB:
        absorb(grid, line, numbers, seen)
    elif kind == EDGE:
        steepest(grid, line, numbers, voxel, seen)
    else:
        surface(grid, room, bounds, line if kind == FIRST else backwards(line), numbers, voxel, seen)


@fast
def share(value: Any, numbers: Array) -> Any:
    """Return a value as 0 to 1 between the limits."""
    return min(max((value - numbers[LOW]) * numbers[PER_VALUE], 0.0), 1.0)


@fast
def extreme(sign: Any, grid: Grid, room: Room, bounds: Array, line: Line, numbers: Array, seen: Array) -> None:
    """Find the first of the largest (sign 1) or smallest (-1) values along a ray; beyond the limits all are equal.

    The brick that may hold most is looked at first: most of the others are then known to hold less.
    """
    low, top = np.float32(numbers[LOW]), np.float32(numbers[LOW] + 1 / numbers[PER_VALUE])
    best, cap = (low, top) if sign > 0 else (-top, -low)
    count = walk(room, bounds, line)
    begin, end = most_promising(sign, room, count)
    best, where = larger(sign, grid, room, line, begin, end, best, START, cap)
    m, k = START, START
    while m < count:
        # what is earlier and as large counts as well
        least = best - BARELY if k < where else (best if best < cap else np.float32(FAR))
        m, begin, k = next_run(room, count, sign, m, k, least)
        best, where = larger(sign, grid, room, line, begin, k, best, where, cap)
    seen[0], seen[1], seen[2] = share(sign * best, numbers), line[2] + (where + 0.5) * line[1], 1


@fast
def most_promising(sign: Any, room: Room, count: Any) -> tuple[Any, Any]:
    """Return the steps in the brick along a ray that may hold most."""
    best = START
    for m in range(count):
        if sign * room.held[m] > sign * room.held[best]:
            best = m
    begin = begin_of(room, best)
    return begin, min(np.intp(room.stops[best]), begin + RUN)


@fast
def larger(
    sign: Any, grid: Grid, room: Room, line: Line, begin: Any, end: Any, best: Any, where: Any, cap: Any
) -> tuple[Any, Any]:
    """Return the largest value of some steps and its place, if it is more or earlier than what is known."""
    draw(grid, room, line, begin, end - begin)
    most = best if begin >= where else best - BARELY
    for s in range(end - begin):
        most = max(most, sign * room.found[s])
    most = min(most, cap)
    if most > best or (most == best and begin < where):
        for s in range(end - begin):
            if sign * room.found[s] >= most:
                return most, (begin + s if most > best else min(where, begin + s))
    return best, where


@fast
def gather(grid: Grid, room: Room, bounds: Array, line: Line, numbers: Array, seen: Array) -> None:
    """Add the values along a ray times the length of a step, what is farther behind the front counting less."""
    near, ds, fade = line[2] - numbers[FRONT], line[1], numbers[FADE]
    low, scale = np.float32(numbers[LOW]), np.float32(numbers[PER_VALUE])
    count = walk(room, bounds, line)
    total, m, k = 0.0, START, START
    while m < count:
        m, begin, k = next_run(room, count, np.float32(1), m, k, low)
        draw(grid, room, line, begin, k - begin)
        for s in range(k - begin):
            v = min(max((room.found[s] - low) * scale, np.float32(0)), np.float32(1))
            total += v * (np.exp(-fade * max(near + (begin + s + 0.5) * ds, 0.0)) if fade > 0 else 1.0)
    seen[0], seen[1], seen[2] = total * ds, line[2], 1


@fast
def absorb(grid: Grid, line: Line, numbers: Array, seen: Array) -> None:
    """Add value times exact length in every voxel a ray goes through (Siddon 1985, Med. Phys. 12, 252)."""
    n, ds, near = line[0], line[1], line[2]
    total, t = 0.0, -0.5
    while t < n - 0.5 - TINY:
        x, y, z = line[3] + t * line[6], line[4] + t * line[7], line[5] + t * line[8]
        end = n - 0.5
        for o, d in ((x, line[6]), (y, line[7]), (z, line[8])):
            if d > TINY:
                end = min(end, t + (np.floor(o + 0.5 + 1e-6) + 0.5 - o) / d)
            elif d < -TINY:
                end = min(end, t + (np.ceil(o - 0.5 - 1e-6) - 0.5 - o) / d)
        end = max(end, t + 1e-7)
        m = 0.5 * (t + end)  # the middle of the way through this voxel says which one it is
        i, j, k = int(line[3] + m * line[6] + 0.5), int(line[4] + m * line[7] + 0.5), int(line[5] + m * line[8] + 0.5)
        total += share(voxel_at(grid, i, j, k), numbers) * (end - t)
        t = end
    seen[0], seen[1], seen[2] = total * ds, near, 1


@fast
def shine(
    grid: Grid,
    room: Room,
    bounds: Array,
    line: Line,
    numbers: Array,
    voxel: Array,
    table: Array,
    light: Grid,
    shadows: bool,  # noqa: FBT001
    seen: Array,
) -> None:
    """Add light and absorption along a ray, front to back, and a surface at the threshold if wanted."""
    lowest, walls = first_opaque(table), numbers[SURFACE] > 0
    least = seen_above(table, numbers)
    if walls:
        least = min(least, numbers[LOW] + numbers[THRESHOLD] / numbers[PER_VALUE] - BARELY)
    count = walk(room, bounds, line)
    before, left, m, k = OUTSIDE, np.float32(1), START, START
    while m < count and left > OPAQUE:
        m, begin, k = next_run(room, count, np.float32(1), m, k, np.float32(-FAR if before else least))
        draw(grid, room, line, begin, k - begin)
        if walls:
            before, left = cross(grid, room, line, begin, k, before, left, numbers, voxel, table, light, shadows, seen)
        else:
            left = matter(room, line, begin, k, left, lowest, numbers, table, light, shadows, seen)
    seen[3] = 1 - left


@fast
def seen_above(table: Array, numbers: Array) -> Any:
    """Return what values must exceed to have an entry of a table that absorbs."""
    return numbers[LOW] + (first_opaque(table) - 0.5) / (table.shape[0] - 1) / numbers[PER_VALUE]


@fast
def first_opaque(table: Array) -> int:
    """Return the first entry of a table that absorbs."""
    for k in range(table.shape[0]):
        if table[k, 3] > 0:
            return k
    return int(table.shape[0])


@fast
def entry_of(value: Any, low: Any, scale: Any) -> Any:
    """Return the entry of a table for a value."""
    v = min(max((value - low) * scale, np.float32(0)), np.float32(1))
    return np.int32(v * np.float32(LAST_ENTRY) + np.float32(0.5))


@fast
def matter(
    room: Room,
    line: Line,
    begin: int,
    end: int,
    left: Any,
    lowest: int,
    numbers: Array,
    table: Array,
    light: Grid,
    shadows: bool,  # noqa: FBT001
    seen: Array,
) -> Any:
    """Add the light of the steps just drawn and return the share that comes through them."""
    low, scale, ds = np.float32(numbers[LOW]), np.float32(numbers[PER_VALUE]), np.float32(line[1])
    red, green, blue = seen[0], seen[1], seen[2]
    for s in range(end - begin):
        entry = entry_of(room.found[s], low, scale)
        if entry >= lowest:
            through = fading(table[np.uint32(entry), 3] * ds)
            weight = left * (1 - through)
            if shadows:
                weight *= at(light, line, np.float32(begin + s)) * np.float32(1 / 255)
            red += weight * table[np.uint32(entry), 0]
            green += weight * table[np.uint32(entry), 1]
            blue += weight * table[np.uint32(entry), 2]
            left *= through
            if left <= OPAQUE:
                break
    seen[0], seen[1], seen[2] = red, green, blue
    return left


@fast
def cross(
    grid: Grid,
    room: Room,
    line: Line,
    begin: int,
    end: int,
    before: bool,  # noqa: FBT001
    left: Any,
    numbers: Array,
    voxel: Array,
    table: Array,
    light: Grid,
    shadows: bool,  # noqa: FBT001
    seen: Array,
) -> tuple[bool, Any]:
    """Add the light of the steps just drawn one by one, and that of a surface wherever they pass the threshold."""
    low, scale = np.float32(numbers[LOW]), np.float32(numbers[PER_VALUE])
    threshold, lowest = np.float32(numbers[THRESHOLD]), first_opaque(table)
    for s in range(end - begin):
        v = min(max((room.found[s] - low) * scale, np.float32(0)), np.float32(1))
        if (v >= threshold) != before:
            left *= np.float32(glimpse(grid, line, begin + s, before, left, numbers, voxel, seen))
            before = not before
        room.found[0] = room.found[s]
        left = matter(room, line, begin + s, begin + s + 1, left, lowest, numbers, table, light, shadows, seen)
        if left <= OPAQUE:
            break
    return before, left


@fast
def fading(x: Any) -> Any:
    """Return exp(-x) of x ≥ 0 within 1e-4, as the eighth power of a series: the library's is slower."""
    y = min(x, np.float32(16)) * np.float32(-0.125)
    p = np.float32(1) + y * (np.float32(1) + y * (np.float32(0.5) + y * (np.float32(1 / 6) + y * np.float32(1 / 24))))
    p *= p
    p *= p
    return p * p
