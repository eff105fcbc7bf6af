"""The ray loop on the processor: the same steps and the same pictures as ``shaders/cast.frag.glsl``.

A sample lies at the middle of each of n equal steps between the points where a ray enters and leaves the volume. Bricks
without anything to see are leaped over by whole steps, so that leaping changes nothing. Numbers come as one array, and
all modes are one kernel: it is compiled once for each type of voxel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from display.cpu import fast, over_rows
from display.cpu.bricks import SIDE, Bricks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.rays import Rays

    Array = NDArray[Any]
    Line = tuple[float, ...]

MAX, MIN, SUM, LIGHT, FIRST, LAST, EDGE, ABSORB = range(8)
TINY = 1e-9
FAR = 1e9
OPAQUE = 0.005  # light that still comes through when a ray is ended
START: Any = np.intp(0)  # with types of their own: a plain 0 is a type as well, and everything compiled twice
OUTSIDE: Any = np.bool_(0)
HALVINGS = 5  # of the step in which a surface is found
LOW, PER_VALUE, STEP, PERSPECTIVE, THRESHOLD, FADE, FRONT, SURFACE, LIGHT_X = range(
    9
)  # places of the numbers of a cast
ANSWER = LIGHT_X + 3
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
    given, colours = flat(numbers), finer(table)
    light = np.zeros((0, 0, 0), np.uint8) if lit is None else lit
    padded, low, high = bricks.padded, bricks.low, bricks.high
    over_rows(
        size[1],
        lambda first, last: cast_rows(kind, padded, low, high, geometry, given, colours, light, first, last, seen),
    )
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
    padded: Array,
    low: Array,
    high: Array,
    geometry: Array,
    numbers: Array,
    table: Array,
    lit: Array,
    first: int,
    last: int,
    seen: Array,
) -> None:
    """Cast the rays of some rows."""
    for j in range(first, last):
        for i in range(seen.shape[1]):
            line = ray(geometry, i, j, numbers)
            if line[0] <= 0:
                continue
            if kind == MAX:
                extreme(np.float32(1), padded, high, line, numbers, seen[j, i])
            elif kind == MIN:
                extreme(np.float32(-1), padded, low, line, numbers, seen[j, i])
            elif kind == SUM:
                gather(padded, high, line, numbers, seen[j, i])
            elif kind == LIGHT:
                shine(padded, high, line, numbers, geometry[5], table, lit, seen[j, i])
            else:
                rest(kind, padded, high, line, numbers, geometry[5], seen[j, i])


@fast
def rest(kind: int, padded: Array, high: Array, line: Line, numbers: Array, voxel: Array, seen: Array) -> None:
    """Add lengths, or find the surface a mode shows."""
    if kind == ABSORB:
        absorb(padded, line, numbers, seen)
    elif kind == EDGE:
        steepest(padded, line, numbers, voxel, seen)
    else:
        surface(padded, high, line if kind == FIRST else backwards(line), numbers, voxel, seen)


@fast
def ray(geometry: Array, i: int, j: int, numbers: Array) -> Line:
    """Return number, length in µm and place of the steps of a ray: (n, ds, near, x, y, z, dx, dy, dz).

    x, y, z are the middle of step 0 and dx, dy, dz one step, in indices of the padded volume.
    """
    voxel, box_low, box_high = geometry[5], geometry[6], geometry[7]
    corner, right, down, eye = geometry[0], geometry[1], geometry[2], geometry[4]
    x, y, z = (
        corner[0] + i * right[0] + j * down[0],
        corner[1] + i * right[1] + j * down[1],
        corner[2] + i * right[2] + j * down[2],
    )
    wx, wy, wz = geometry[3, 0], geometry[3, 1], geometry[3, 2]
    near, perspective = -FAR, numbers[PERSPECTIVE] > 0
    if perspective:
        wx, wy, wz = x - eye[0], y - eye[1], z - eye[2]
    reach = np.sqrt((wx * voxel[0]) ** 2 + (wy * voxel[1]) ** 2 + (wz * voxel[2]) ** 2)
    if perspective:
        near = -reach
    far, way, start = FAR, (wx / reach, wy / reach, wz / reach), (x, y, z)
    for a in range(3):
        d = way[a] if abs(way[a]) > TINY else TINY
        one, two = (box_low[a] - start[a]) / d, (box_high[a] - start[a]) / d
        near, far = max(near, min(one, two)), min(far, max(one, two))
    n = np.ceil((far - near) / numbers[STEP]) if far > near else 0.0
    ds = (far - near) / max(n, 1.0)
    t = near + 0.5 * ds
    return (
        n,
        ds,
        near,
        x + 1 + t * way[0],
        y + 1 + t * way[1],
        z + 1 + t * way[2],
        way[0] * ds,
        way[1] * ds,
        way[2] * ds,
    )


@fast
def backwards(line: Line) -> Line:
    """Return the same steps from the last to the first."""
    n, ds, near, x, y, z, dx, dy, dz = line
    k = n - 1
    return n, -ds, near + n * ds, x + k * dx, y + k * dy, z + k * dz, -dx, -dy, -dz


@fast
def brick(line: Line, k: int) -> tuple[int, int, int, int]:
    """Return the brick (z, y, x) of a step, and the first step beyond it or the number of steps.

    A step on the very border counts to either: a brick knows the extremes of its border, too.
    """
    x, y, z = int(line[3] + k * line[6]) // SIDE, int(line[4] + k * line[7]) // SIDE, int(line[5] + k * line[8]) // SIDE
    end = min(leaving(x, line[3], line[6]), leaving(y, line[4], line[7]), leaving(z, line[5], line[8]), line[0])
    return z, y, x, max(int(end), k + 1)


@fast
def leaving(place: int, start: float, step: float) -> Any:
    """Return the first step beyond a brick along one axis."""
    if abs(step) < TINY:
        return FAR
    return np.floor(((place + (1 if step > 0 else 0)) * SIDE - start) / step) + 1


@fast
def at(padded: Array, line: Line, k: Any) -> Any:
    """Return the interpolated value at a step (float32), which need not be whole."""
    x, y, z = np.float32(line[3]), np.float32(line[4]), np.float32(line[5])
    dx, dy, dz = np.float32(line[6]), np.float32(line[7]), np.float32(line[8])
    return trilinear(padded, x + k * dx, y + k * dy, z + k * dz)


@fast
def trilinear(padded: Array, x: Any, y: Any, z: Any) -> Any:
    """Interpolate at a point (float32) given in indices of ``padded``."""
    i, j, k = np.uint32(np.int32(x)), np.uint32(np.int32(y)), np.uint32(np.int32(z))
    fx, fy, fz = x - np.float32(np.int32(x)), y - np.float32(np.int32(y)), z - np.float32(np.int32(z))
    a0, a1 = np.float32(padded[k, j, i]), np.float32(padded[k, j, i + 1])
    b0, b1 = np.float32(padded[k, j + 1, i]), np.float32(padded[k, j + 1, i + 1])
    c0, c1 = np.float32(padded[k + 1, j, i]), np.float32(padded[k + 1, j, i + 1])
    d0, d1 = np.float32(padded[k + 1, j + 1, i]), np.float32(padded[k + 1, j + 1, i + 1])
    a, b, c, d = a0 + fx * (a1 - a0), b0 + fx * (b1 - b0), c0 + fx * (c1 - c0), d0 + fx * (d1 - d0)
    front, back = a + fy * (b - a), c + fy * (d - c)
    return front + fz * (back - front)


@fast
def share(value: Any, numbers: Array) -> Any:
    """Return a value as 0 to 1 between the limits."""
    return min(max((value - numbers[LOW]) * numbers[PER_VALUE], 0.0), 1.0)


@fast
def extreme(sign: Any, padded: Array, bounds: Array, line: Line, numbers: Array, seen: Array) -> None:
    """Find the first of the largest (sign 1) or smallest (-1) values along a ray; beyond the limits all are equal.

    The brick that may hold most is looked at first: most of the others are then known to hold less.
    """
    low, top = np.float32(numbers[LOW]), np.float32(numbers[LOW] + 1 / numbers[PER_VALUE])
    best, cap = (low, top) if sign > 0 else (-top, -low)
    most, begin, k = np.float32(-FAR), START, START
    while k < line[0]:
        bz, by, bx, end = brick(line, k)
        bound = sign * np.float32(bounds[bz, by, bx])
        if bound > most:
            most, begin = bound, k
        k = end
    best, where = larger(sign, padded, line, begin, brick(line, begin)[3], best, START, cap)
    k = START
    while k < line[0]:
        bz, by, bx, end = brick(line, k)
        bound = min(sign * np.float32(bounds[bz, by, bx]), cap)
        if bound > best or (bound == best and k < where):
            best, where = larger(sign, padded, line, k, end, best, where, cap)
        k = end
    seen[0], seen[1], seen[2] = share(sign * best, numbers), line[2] + (where + 0.5) * line[1], 1


@fast
def larger(
    sign: Any, padded: Array, line: Line, begin: int, end: int, best: Any, where: int, cap: Any
) -> tuple[Any, int]:
    """Return the largest value of some steps and its place, if it is more or earlier than what is known."""
    for step in range(begin, end):
        v = min(sign * at(padded, line, np.float32(step)), cap)
        if v > best or (v == best and step < where):
            best, where = v, step
    return best, where


@fast
def gather(padded: Array, high: Array, line: Line, numbers: Array, seen: Array) -> None:
    """Add the values along a ray times the length of a step, what is farther behind the front counting less."""
    ds, near, fade = line[1], line[2], numbers[FADE]
    total, k = 0.0, START
    while k < line[0]:
        bz, by, bx, end = brick(line, k)
        if high[bz, by, bx] > numbers[LOW]:
            for step in range(k, end):
                way = max(near + (step + 0.5) * ds - numbers[FRONT], 0.0)
                total += share(at(padded, line, np.float32(step)), numbers) * (np.exp(-fade * way) if fade > 0 else 1.0)
        k = end
    seen[0], seen[1], seen[2] = total * ds, near, 1


@fast
def absorb(padded: Array, line: Line, numbers: Array, seen: Array) -> None:
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
        change(padded, x, y, z, 1.0, 0.0, 0.0) / voxel[0],
        change(padded, x, y, z, 0.0, 1.0, 0.0) / voxel[1],
        change(padded, x, y, z, 0.0, 0.0, 1.0) / voxel[2],
    )


@fast
def change(padded: Array, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> Any:
    """Return half the difference of the values at both sides of a point."""
    more = trilinear(padded, np.float32(x + dx), np.float32(y + dy), np.float32(z + dz))
    return 0.5 * (more - trilinear(padded, np.float32(x - dx), np.float32(y - dy), np.float32(z - dz)))


@fast
def crossing(padded: Array, line: Line, inside: float, outside: float, level: float) -> float:
    """Return where, between two steps, the value passes a level, by halving."""
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if at(padded, line, np.float32(middle)) >= level:
            inside = middle
        else:
            outside = middle
    return inside


@fast
def surface(padded: Array, high: Array, line: Line, numbers: Array, voxel: Array, seen: Array) -> None:
    """Find the first place along a ray where the value is not below the threshold: its normal and distance."""
    level = numbers[THRESHOLD] / numbers[PER_VALUE] + numbers[LOW]
    k = START
    while k < line[0]:
        bz, by, bx, end = brick(line, k)
        if high[bz, by, bx] >= level:
            for step in range(k, end):
                if at(padded, line, np.float32(step)) >= level:
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
def steepest(padded: Array, line: Line, numbers: Array, voxel: Array, seen: Array) -> None:
    """Find the place along a ray where the value changes most, if by the threshold per voxel."""
    least = numbers[THRESHOLD] / numbers[PER_VALUE] / min(voxel[0], voxel[1], voxel[2])
    best, where = least * least, -1
    for k in range(int(line[0])):
        x, y, z = slope(padded, line, k, voxel)
        size = x * x + y * y + z * z
        if size > best:
            best, where = size, k
    if where >= 0:
        normal(slope(padded, line, float(where), voxel), line[2] + (where + 0.5) * line[1], seen)


@fast
def shine(
    padded: Array, high: Array, line: Line, numbers: Array, voxel: Array, table: Array, lit: Array, seen: Array
) -> None:
    """Add light and absorption along a ray, front to back, and a surface at the threshold if wanted."""
    before, k = OUTSIDE, START
    ds, left = np.float32(line[1]), np.float32(1)
    lowest, walls = first_opaque(table), numbers[SURFACE] > 0
    threshold = np.float32(numbers[THRESHOLD]) if walls else np.float32(FAR)
    low, scale = np.float32(numbers[LOW]), np.float32(numbers[PER_VALUE])
    while k < line[0] and left > OPAQUE:
        bz, by, bx, end = brick(line, k)
        top = share(high[bz, by, bx], numbers)
        if top * LAST_ENTRY + 0.5 > lowest or top >= threshold or before:
            for step in range(k, end):
                v = min(max((at(padded, line, np.float32(step)) - low) * scale, np.float32(0)), np.float32(1))
                if (v >= threshold) != before:
                    left *= np.float32(glimpse(padded, line, step, before, left, numbers, voxel, seen))
                    before = not before
                entry = np.int32(v * np.float32(LAST_ENTRY) + np.float32(0.5))
                if entry >= lowest:
                    left *= matter(np.uint32(entry), ds, left, table, lit, line, step, seen)
                    if left <= OPAQUE:
                        break
        k = end
    seen[3] = 1 - left


@fast
def first_opaque(table: Array) -> int:
    """Return the first entry of a table that absorbs."""
    for k in range(table.shape[0]):
        if table[k, 3] > 0:
            return k
    return int(table.shape[0])


@fast
def matter(entry: Any, ds: Any, left: Any, table: Array, lit: Array, line: Line, step: int, seen: Array) -> Any:
    """Add the light of one step and return the share that comes through it."""
    through = fading(table[entry, 3] * ds)
    weight = left * (1 - through)
    if lit.size > 0:
        weight *= at(lit, line, np.float32(step)) * np.float32(1 / 255)
    for c in range(3):
        seen[c] += weight * table[entry, c]
    return through


@fast
def fading(x: Any) -> Any:
    """Return exp(-x) of x ≥ 0 within 1e-4, as the eighth power of a series: the library's is slower."""
    y = min(x, np.float32(16)) * np.float32(-0.125)
    p = np.float32(1) + y * (np.float32(1) + y * (np.float32(0.5) + y * (np.float32(1 / 6) + y * np.float32(1 / 24))))
    p *= p
    p *= p
    return p * p


@fast
def glimpse(
    padded: Array,
    line: Line,
    step: int,
    before: bool,  # noqa: FBT001
    left: Any,
    numbers: Array,
    voxel: Array,
    seen: Array,
) -> float:
    """Add the light of a surface between two steps and return the share that comes through it."""
    level = numbers[THRESHOLD] / numbers[PER_VALUE] + numbers[LOW]
    one, two = float(step), max(step - 1.0, -0.5)
    place = crossing(padded, line, two, one, level) if before else crossing(padded, line, one, two, level)
    x, y, z = slope(padded, line, place, voxel)
    size = max(np.sqrt(x * x + y * y + z * z), TINY)
    way = (line[6] * voxel[0] / line[1], line[7] * voxel[1] / line[1], line[8] * voxel[2] / line[1])
    brightness = answered((-x / size, -y / size, -z / size), way, numbers)
    for c in range(3):
        seen[c] += left * numbers[SURFACE] * brightness
    return float(1 - numbers[SURFACE])


@fast
def answered(n: tuple[float, float, float], way: tuple[float, float, float], numbers: Array) -> float:
    """Return ambient, diffuse and mirrored light of a white surface: `lit` of ``shade.glsl``."""
    towards = n[0] * way[0] + n[1] * way[1] + n[2] * way[2]
    side = 1.0 if towards < 0 else -1.0
    lx, ly, lz = numbers[LIGHT_X], numbers[LIGHT_X + 1], numbers[LIGHT_X + 2]
    answer = numbers[ANSWER:]
    diffuse = max(side * (n[0] * lx + n[1] * ly + n[2] * lz), 0.0)
    hx, hy, hz = lx - way[0], ly - way[1], lz - way[2]
    size = max(np.sqrt(hx * hx + hy * hy + hz * hz), TINY)
    halfway = max(side * (n[0] * hx + n[1] * hy + n[2] * hz) / size, 0.0)
    mirrored = halfway ** answer[3] if diffuse > 0 else 0.0
    return float(answer[0] + answer[1] * diffuse + answer[2] * mirrored)
