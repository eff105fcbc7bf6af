"""The ray loop on the processor: the same steps and the same pictures as ``shaders/cast.frag.glsl``.

A sample lies at the middle of each of n equal steps between the points where a ray enters and leaves the volume. Bricks
without anything to see are leaped over by whole steps, so that leaping changes nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from display.cpu import fast, inlined, over_rows
from display.cpu.bricks import SIDE, Bricks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.rays import Rays

    Array = NDArray[Any]
    Line = tuple[float, ...]
    Grid = tuple[Array, Array, Array]

MAX, MIN, SUM, LIGHT, FIRST, LAST, EDGE, ABSORB = range(8)
TINY = 1e-9
FAR = 1e9
OPAQUE = 0.005  # light that still comes through when a ray is ended
HALVINGS = 5  # of the step in which a surface is found


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
    lit: Array | None = None,
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
    lit : array like ``bricks.padded``, uint8, optional
        Share of the light that reaches each voxel, for ``LIGHT``.

    Returns
    -------
    array (height, width, 4) float32
        What the mode's snippet calls ``seen``.
    """
    seen = np.zeros((size[1], size[0], 4), np.float32)
    eye = np.zeros(3) if rays.eye is None else rays.eye
    geometry = np.stack([rays.corner, rays.right, rays.down, rays.along, eye, rays.voxel_um, *box])
    grid = (bricks.padded, bricks.low, bricks.high)
    colours = np.zeros((256, 4), np.float32) if table is None else table
    light = np.zeros((0, 0, 0), np.uint8) if lit is None else lit
    over_rows(size[1], lambda first, last: cast_rows(kind, grid, geometry, numbers, colours, light, first, last, seen))
    return seen


@fast
def cast_rows(
    kind: int,
    grid: Grid,
    geometry: Array,
    numbers: Casting,
    table: Array,
    lit: Array,
    first: int,
    last: int,
    seen: Array,
) -> None:
    """Cast the rays of some rows."""
    voxel = geometry[5]
    for j in range(first, last):
        for i in range(seen.shape[1]):
            line = ray(geometry, i, j, numbers)
            if line[0] > 0:
                if kind <= MIN:
                    extreme(kind == MAX, grid, line, numbers, seen[j, i])
                elif kind == SUM:
                    gather(grid, line, numbers, seen[j, i])
                elif kind == LIGHT:
                    shine(grid, line, numbers, voxel, table, lit, seen[j, i])
                elif kind == ABSORB:
                    absorb(grid[0], line, numbers, seen[j, i])
                else:
                    wall(kind, grid, line, numbers, voxel, seen[j, i])


@fast
def wall(kind: int, grid: Grid, line: Line, numbers: Casting, voxel: Array, seen: Array) -> None:
    """Find the surface a mode shows."""
    if kind == EDGE:
        steepest(grid, line, numbers, voxel, seen)
    else:
        surface(grid, line if kind == FIRST else backwards(line), numbers, voxel, seen)


@fast
def ray(geometry: Array, i: int, j: int, numbers: Casting) -> Line:
    """Return number, length in µm and place of the steps of a ray: (n, ds, near, x, y, z, dx, dy, dz).

    x, y, z are the middle of step 0 and dx, dy, dz one step, in indices of the padded volume.
    """
    voxel, box_low, box_high = geometry[5], geometry[6], geometry[7]
    start = geometry[0] + i * geometry[1] + j * geometry[2]
    way = start - geometry[4] if numbers.perspective else geometry[3].copy()
    reach = np.sqrt((way[0] * voxel[0]) ** 2 + (way[1] * voxel[1]) ** 2 + (way[2] * voxel[2]) ** 2)
    near, far = (-reach if numbers.perspective else -FAR), FAR
    for a in range(3):
        way[a] = way[a] / reach
        d = way[a] if abs(way[a]) > TINY else TINY
        one, two = (box_low[a] - start[a]) / d, (box_high[a] - start[a]) / d
        near, far = max(near, min(one, two)), min(far, max(one, two))
    n = np.ceil((far - near) / numbers.step_um) if far > near else 0.0
    ds = (far - near) / max(n, 1.0)
    begin = start + 1 + (near + 0.5 * ds) * way
    return n, ds, near, begin[0], begin[1], begin[2], way[0] * ds, way[1] * ds, way[2] * ds


@fast
def backwards(line: Line) -> Line:
    """Return the same steps from the last to the first."""
    n, ds, near, x, y, z, dx, dy, dz = line
    k = n - 1
    return n, -ds, near + n * ds, x + k * dx, y + k * dy, z + k * dz, -dx, -dy, -dz


@fast
def brick_of(line: Line, k: int) -> tuple[int, int, int]:
    """Return the brick (x, y, z) of a step."""
    return int(line[3] + k * line[6]) // SIDE, int(line[4] + k * line[7]) // SIDE, int(line[5] + k * line[8]) // SIDE


@fast
def brick_end(line: Line, k: int, brick: tuple[int, int, int]) -> int:
    """Return the first step after ``k`` that is outside of a brick, or the number of steps."""
    end = line[0]
    for a in range(3):
        b, o, d = brick[a], line[3 + a], line[6 + a]
        if d > TINY:
            end = min(end, np.ceil(((b + 1) * SIDE - o) / d))
        elif d < -TINY:
            end = min(end, np.floor((b * SIDE - o) / d) + 1)
    return max(int(end), k + 1)


@inlined
def at(padded: Array, line: Line, k: float) -> Any:
    """Return the interpolated value at a step, which need not be whole."""
    return trilinear(padded, line[3] + k * line[6], line[4] + k * line[7], line[5] + k * line[8])


@inlined
def trilinear(padded: Array, x: float, y: float, z: float) -> Any:
    """Interpolate at a point given in indices of ``padded``."""
    i, j, k = np.uint32(x), np.uint32(y), np.uint32(z)
    fx, fy, fz = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    # every voxel by its own index: views of rows would be counted, which takes longer than the arithmetic
    a0, a1 = np.float32(padded[k, j, i]), np.float32(padded[k, j, i + 1])
    b0, b1 = np.float32(padded[k, j + 1, i]), np.float32(padded[k, j + 1, i + 1])
    c0, c1 = np.float32(padded[k + 1, j, i]), np.float32(padded[k + 1, j, i + 1])
    d0, d1 = np.float32(padded[k + 1, j + 1, i]), np.float32(padded[k + 1, j + 1, i + 1])
    front = (a0 + fx * (a1 - a0)) * (1 - fy) + (b0 + fx * (b1 - b0)) * fy
    back = (c0 + fx * (c1 - c0)) * (1 - fy) + (d0 + fx * (d1 - d0)) * fy
    return front + fz * (back - front)


@inlined
def share(value: Any, numbers: Casting) -> Any:
    """Return a value as 0 to 1 between the limits."""
    return min(max((value - numbers.low) * numbers.per_value, 0.0), 1.0)


@fast
def extreme(largest: bool, grid: Grid, line: Line, numbers: Casting, seen: Array) -> None:  # noqa: FBT001
    """Find the largest or smallest value along a ray, and where it is."""
    padded, low, high = grid
    best, where, k = np.float32(-1.0 if largest else FAR), 0, 0
    while k < line[0]:
        brick = brick_of(line, k)
        end = brick_end(line, k, brick)
        i, j, m = brick
        if (high[m, j, i] > best) if largest else (low[m, j, i] < best):
            for step in range(k, end):
                v = at(padded, line, step)
                if (v > best) if largest else (v < best):
                    best, where = v, step
        k = end
    seen[0], seen[1], seen[2] = share(best, numbers), line[2] + (where + 0.5) * line[1], 1


@fast
def gather(grid: Grid, line: Line, numbers: Casting, seen: Array) -> None:
    """Add the values along a ray times the length of a step, what is farther behind the front counting less."""
    padded, _, high = grid
    ds, near, fade = line[1], line[2], numbers.fade_per_um
    total, k = 0.0, 0
    while k < line[0]:
        brick = brick_of(line, k)
        end = brick_end(line, k, brick)
        if high[brick[2], brick[1], brick[0]] > numbers.low:
            for step in range(k, end):
                way = max(near + (step + 0.5) * ds - numbers.front_um, 0.0)
                total += share(at(padded, line, step), numbers) * (np.exp(-fade * way) if fade > 0 else 1.0)
        k = end
    seen[0], seen[1], seen[2] = total * ds, near, 1


@fast
def absorb(padded: Array, line: Line, numbers: Casting, seen: Array) -> None:
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
        total += share(padded[k, j, i], numbers) * (end - t)
        t = end
    seen[0], seen[1], seen[2] = total * ds, near, 1


@fast
def slope(padded: Array, line: Line, k: float, voxel: Array) -> tuple[float, float, float]:
    """Return the change of the value per µm along (x, y, z), by central differences over one voxel to each side."""
    x, y, z = line[3] + k * line[6], line[4] + k * line[7], line[5] + k * line[8]
    depth, height, width = padded.shape
    x, y, z = min(max(x, 1.0), width - 2.001), min(max(y, 1.0), height - 2.001), min(max(z, 1.0), depth - 2.001)
    return (
        (trilinear(padded, x + 1, y, z) - trilinear(padded, x - 1, y, z)) / (2 * voxel[0]),
        (trilinear(padded, x, y + 1, z) - trilinear(padded, x, y - 1, z)) / (2 * voxel[1]),
        (trilinear(padded, x, y, z + 1) - trilinear(padded, x, y, z - 1)) / (2 * voxel[2]),
    )


@fast
def crossing(padded: Array, line: Line, inside: float, outside: float, level: float) -> float:
    """Return where, between two steps, the value passes a level, by halving."""
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if at(padded, line, middle) >= level:
            inside = middle
        else:
            outside = middle
    return inside


@fast
def surface(grid: Grid, line: Line, numbers: Casting, voxel: Array, seen: Array) -> None:
    """Find the first place along a ray where the value is not below the threshold: its normal and distance."""
    padded, _, high = grid
    level = numbers.threshold / numbers.per_value + numbers.low
    k = 0
    while k < line[0]:
        brick = brick_of(line, k)
        end = brick_end(line, k, brick)
        if high[brick[2], brick[1], brick[0]] >= level:
            for step in range(k, end):
                if at(padded, line, step) >= level:
                    outside = max(step - 1.0, -0.5)
                    place = crossing(padded, line, float(step), outside, level)
                    normal(slope(padded, line, place, voxel), line[2] + (place + 0.5) * line[1], seen)
                    return
        k = end


@fast
def normal(change: tuple[float, float, float], t: float, seen: Array) -> None:
    """Write the unit normal of a surface, which points to where values fall, and its distance."""
    size = np.sqrt(change[0] ** 2 + change[1] ** 2 + change[2] ** 2)
    for a in range(3):
        seen[a] = -change[a] / size if size > TINY else (-1.0 if a == 2 else 0.0)
    seen[3] = t


@fast
def steepest(grid: Grid, line: Line, numbers: Casting, voxel: Array, seen: Array) -> None:
    """Find the place along a ray where the value changes most, if by the threshold per voxel."""
    padded = grid[0]
    least = numbers.threshold / numbers.per_value / min(voxel[0], voxel[1], voxel[2])
    best, where = least * least, -1
    for k in range(int(line[0])):
        x, y, z = slope(padded, line, float(k), voxel)
        size = x * x + y * y + z * z
        if size > best:
            best, where = size, k
    if where >= 0:
        normal(slope(padded, line, float(where), voxel), line[2] + (where + 0.5) * line[1], seen)


@fast
def shine(grid: Grid, line: Line, numbers: Casting, voxel: Array, table: Array, lit: Array, seen: Array) -> None:
    """Add light and absorption along a ray, front to back, and a surface at the threshold if wanted."""
    padded, _, high = grid
    ds, left, before, k = line[1], 1.0, False, 0
    lowest = first_opaque(table)
    while k < line[0] and left > OPAQUE:
        brick = brick_of(line, k)
        end = brick_end(line, k, brick)
        top = share(high[brick[2], brick[1], brick[0]], numbers)
        if top * 255 > lowest or (numbers.surface > 0 and (top >= numbers.threshold or before)):
            for step in range(k, end):
                v = share(at(padded, line, step), numbers)
                inside = v >= numbers.threshold
                if numbers.surface > 0 and inside != before:
                    left *= glimpse(padded, line, step, before, left, numbers, voxel, seen)
                before = inside
                left *= matter(v, ds, left, table, lit, line, step, seen)
                if left <= OPAQUE:
                    break
        k = end
    seen[3] = 1 - left


@fast
def first_opaque(table: Array) -> int:
    """Return the last entry of a table before which nothing absorbs."""
    for k in range(table.shape[0]):
        if table[k, 3] > 0:
            return k - 1
    return int(table.shape[0])


@inlined
def matter(v: float, ds: float, left: float, table: Array, lit: Array, line: Line, step: int, seen: Array) -> float:
    """Add the light of one step and return the share that comes through it."""
    place = v * 255
    k = min(int(place), 254)
    part = place - k
    through = np.exp(-(table[k, 3] + part * (table[k + 1, 3] - table[k, 3])) * ds)
    weight = left * (1 - through)
    if lit.size > 0:
        weight *= at(lit, line, step) / 255.0
    for c in range(3):
        seen[c] += weight * (table[k, c] + part * (table[k + 1, c] - table[k, c]))
    return float(through)


@fast
def glimpse(
    padded: Array,
    line: Line,
    step: int,
    before: bool,  # noqa: FBT001
    left: float,
    numbers: Casting,
    voxel: Array,
    seen: Array,
) -> float:
    """Add the light of a surface between two steps and return the share that comes through it."""
    level = numbers.threshold / numbers.per_value + numbers.low
    one, two = float(step), max(step - 1.0, -0.5)
    place = crossing(padded, line, two, one, level) if before else crossing(padded, line, one, two, level)
    x, y, z = slope(padded, line, place, voxel)
    size = max(np.sqrt(x * x + y * y + z * z), TINY)
    way = (line[6] * voxel[0] / line[1], line[7] * voxel[1] / line[1], line[8] * voxel[2] / line[1])
    brightness = answered((-x / size, -y / size, -z / size), way, numbers)
    for c in range(3):
        seen[c] += left * numbers.surface * brightness
    return 1 - numbers.surface


@fast
def answered(n: tuple[float, float, float], way: tuple[float, float, float], numbers: Casting) -> float:
    """Return ambient, diffuse and mirrored light of a white surface: `lit` of ``shade.glsl``."""
    towards = n[0] * way[0] + n[1] * way[1] + n[2] * way[2]
    side = 1.0 if towards < 0 else -1.0
    light = numbers.light
    diffuse = max(side * (n[0] * light[0] + n[1] * light[1] + n[2] * light[2]), 0.0)
    hx, hy, hz = light[0] - way[0], light[1] - way[1], light[2] - way[2]
    size = max(np.sqrt(hx * hx + hy * hy + hz * hz), TINY)
    halfway = max(side * (n[0] * hx + n[1] * hy + n[2] * hz) / size, 0.0)
    mirrored = halfway ** numbers.answer[3] if diffuse > 0 else 0.0
    return float(numbers.answer[0] + numbers.answer[1] * diffuse + numbers.answer[2] * mirrored)
