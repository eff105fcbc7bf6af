"""Where the steps of a ray lie in a volume, which bricks they pass, and what the volume holds there.

A sample lies at the middle of each of n equal steps between the points where a ray enters and leaves the volume.
Samples in a row are had in three passes (places, corners, blending): the compiler then does many of them at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from display.cpu import fast, inlined
from display.cpu.bricks import SIDE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.cpu.bricks import Bricks

    Array = NDArray[Any]
    Line = tuple[float, ...]

TINY = 1e-9
FAR = 1e9
START: Any = np.intp(0)  # with a type of its own: a plain 0 is a type as well, and everything compiled twice
# places of the numbers of a cast
LOW, PER_VALUE, STEP, PERSPECTIVE, THRESHOLD, FADE, FRONT, SURFACE, LIGHT_X = range(9)
ANSWER = LIGHT_X + 3
RUN = 64  # samples had at a time
BLOCK = 32  # samples the compiler does side by side; what is beyond the last is computed in vain


class Grid(NamedTuple):
    """A volume with a rim, as samples are drawn from it.

    Attributes
    ----------
    words : array (voxels,) uint32
        At each voxel what stands there and behind it along x: two neighbours come with one look.
    width, height, depth : int
    rise, row : int32
        Voxels from plane to plane and from row to row.
    bits, mask : uint32
        Of one voxel in a word.
    """

    words: Array
    width: Any
    height: Any
    depth: Any
    rise: Any
    row: Any
    bits: Any
    mask: Any


class Room(NamedTuple):
    """What one thread needs on its way along a ray; apart from the grid, since every call carries what it is given.

    Attributes
    ----------
    places : array (RUN,) int32
    corners : array (4 RUN,) uint32
    shares : array (3 RUN,) float32
    found : array (RUN,) float32
        The samples.
    stops, held : array (bricks,) int32, float32
        Of the bricks along a ray: the first step beyond each, and its bound.
    """

    places: Array
    corners: Array
    shares: Array
    found: Array
    stops: Array
    held: Array


def grid(bricks: Bricks) -> Grid:
    """Return a volume as samples are drawn from it."""
    depth, height, width = bricks.padded.shape
    bits = 8 * bricks.padded.itemsize
    mask = np.uint32(2**bits - 1)
    return Grid(bricks.words, width, height, depth, np.int32(height * width), np.int32(width), np.uint32(bits), mask)


def room(bricks: Bricks) -> Room:
    """Return room for one thread."""
    most = sum(bricks.low.shape) + 1
    return Room(
        np.empty(RUN, np.int32),
        np.empty(4 * RUN, np.uint32),
        np.empty(3 * RUN, np.float32),
        np.empty(RUN, np.float32),
        np.empty(most, np.int32),
        np.empty(most, np.float32),
    )


@inlined
def draw(grid: Grid, room: Room, line: Line, first: Any, count: Any) -> None:
    """Write the interpolated values at some steps, at most RUN, to ``room.found``."""
    x, y, z = np.float32(line[3]), np.float32(line[4]), np.float32(line[5])
    dx, dy, dz = np.float32(line[6]), np.float32(line[7]), np.float32(line[8])
    begin = np.float32(first)
    i0, j0, k0 = np.int32(x + begin * dx), np.int32(y + begin * dy), np.int32(z + begin * dz)
    whole = (count + BLOCK - 1) // BLOCK * BLOCK
    for s in range(whole):
        t = begin + np.float32(np.int32(s))
        px, py, pz = x + t * dx, y + t * dy, z + t * dz
        i, j, k = np.int32(px), np.int32(py), np.int32(pz)
        room.shares[s], room.shares[RUN + s] = px - np.float32(i), py - np.float32(j)
        room.shares[2 * RUN + s] = pz - np.float32(k)
        room.places[s] = (k - k0) * grid.rise + (j - j0) * grid.row + (i - i0)
    fetch(grid, room, np.int64(k0) * grid.rise + np.int64(j0) * grid.row + i0, count)
    for s in range(whole):
        fx, fy = room.shares[s], room.shares[RUN + s]
        a, b = across(grid, room.corners[s], fx), across(grid, room.corners[RUN + s], fx)
        c, d = across(grid, room.corners[2 * RUN + s], fx), across(grid, room.corners[3 * RUN + s], fx)
        front, back = a + fy * (b - a), c + fy * (d - c)
        room.found[s] = front + room.shares[2 * RUN + s] * (back - front)


@inlined
def fetch(grid: Grid, room: Room, start: Any, count: Any) -> None:
    """Read the four words around some places, which are counted from a start."""
    row, rise = np.uintp(grid.row), np.uintp(grid.rise)
    for s in range(count):
        place = np.uintp(start + room.places[s])
        room.corners[s], room.corners[RUN + s] = grid.words[place], grid.words[place + row]
        room.corners[2 * RUN + s] = grid.words[place + rise]
        room.corners[3 * RUN + s] = grid.words[place + rise + row]


@inlined
def walk(room: Room, bounds: Array, line: Line) -> Any:
    """Write the bound of every brick along a ray, and the first step beyond it; return how many there are.

    A step on the very border counts to either brick: both know the extremes of their border. After Amanatides and Woo
    (1987, Eurographics, 3).
    """
    n = np.intp(line[0])
    x, y, z = brick_of(line[3]), brick_of(line[4]), brick_of(line[5])
    tx, ty, tz = leaving(x, line[3], line[9]), leaving(y, line[4], line[10]), leaving(z, line[5], line[11])
    wx, wy, wz = SIDE * abs(line[9]), SIDE * abs(line[10]), SIDE * abs(line[11])
    across, down, ahead = (1 if line[9] > 0 else -1), (1 if line[10] > 0 else -1), (1 if line[11] > 0 else -1)
    count, begin = START, START
    while begin < n:
        leaves = min(tx, ty, tz)
        end = min(np.intp(leaves) + 1, n)
        if end > begin:
            room.stops[count], room.held[count] = end, bounds[z, y, x]
            count, begin = count + 1, end
        if leaves == tx:
            x, tx = x + across, tx + wx
        elif leaves == ty:
            y, ty = y + down, ty + wy
        else:
            z, tz = z + ahead, tz + wz
    return count


@fast
def begin_of(room: Room, m: Any) -> Any:
    """Return the first step in a brick along a ray."""
    return np.intp(room.stops[m - 1]) if m > 0 else START


@fast
def brick_of(place: float) -> Any:
    """Return the brick along one axis that holds a place."""
    return np.intp(place) // SIDE


@fast
def leaving(brick: Any, start: float, steps: float) -> Any:
    """Return where along a ray it leaves a brick along one axis, of which ``steps`` lead over a voxel."""
    if steps == 0:
        return FAR
    return ((brick + (1 if steps > 0 else 0)) * SIDE - start) * steps


@inlined
def next_run(room: Room, count: Any, sign: Any, m: Any, begin: Any, least: Any) -> tuple[Any, Any, Any]:
    """Return the next steps in bricks whose bound times a sign is above the least, from a brick and a step on.

    Returns
    -------
    m, begin, end : int
        Brick of the step after them; these steps, at most RUN, none when no brick is left.
    """
    while m < count and sign * room.held[m] <= least:
        begin = np.intp(room.stops[m])
        m += 1
    end = begin
    # to go on over one brick in which nothing is takes less than to begin anew
    while m < count and (sign * room.held[m] > least or (m + 1 < count and sign * room.held[m + 1] > least)):
        stop = np.intp(room.stops[m])
        end = min(stop, begin + RUN)
        if end < stop:
            break
        m += 1
    return m, begin, end


@fast
def ray(geometry: Array, i: int, j: int, numbers: Array) -> Line:
    """Return number, length in µm and place of the steps of a ray: (n, ds, near, x, y, z, dx, dy, dz, rx, ry, rz).

    x, y, z are the middle of step 0 and dx, dy, dz one step, in indices of the padded volume, rx, ry, rz steps a voxel.
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
        *steps_a_voxel(way, ds),
    )


@fast
def steps_a_voxel(way: tuple[float, float, float], ds: float) -> tuple[float, float, float]:
    """Return the steps that lead over one voxel along each axis; 0 where none do."""
    dx, dy, dz = way[0] * ds, way[1] * ds, way[2] * ds
    return (
        1 / dx if abs(dx) > TINY else 0.0,
        1 / dy if abs(dy) > TINY else 0.0,
        1 / dz if abs(dz) > TINY else 0.0,
    )


@fast
def backwards(line: Line) -> Line:
    """Return the same steps from the last to the first."""
    n, ds, near, x, y, z, dx, dy, dz, rx, ry, rz = line
    k = n - 1
    return n, -ds, near + n * ds, x + k * dx, y + k * dy, z + k * dz, -dx, -dy, -dz, -rx, -ry, -rz


@fast
def at(grid: Grid, line: Line, k: Any) -> Any:
    """Return the interpolated value at a step (float32), which need not be whole."""
    x, y, z = np.float32(line[3]), np.float32(line[4]), np.float32(line[5])
    dx, dy, dz = np.float32(line[6]), np.float32(line[7]), np.float32(line[8])
    return trilinear(grid, x + k * dx, y + k * dy, z + k * dz)


@inlined
def trilinear(grid: Grid, x: Any, y: Any, z: Any) -> Any:
    """Interpolate at a point (float32) given in indices of the volume with its rim."""
    i, j, k = np.int32(x), np.int32(y), np.int32(z)
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    place, row, rise = place_of(grid, i, j, k), np.uintp(grid.row), np.uintp(grid.rise)
    a, b = across(grid, grid.words[place], fx), across(grid, grid.words[place + row], fx)
    place += rise
    c, d = across(grid, grid.words[place], fx), across(grid, grid.words[place + row], fx)
    front, back = a + fy * (b - a), c + fy * (d - c)
    return front + fz * (back - front)


@inlined
def place_of(grid: Grid, i: Any, j: Any, k: Any) -> Any:
    """Return where a voxel stands."""
    return np.uintp(np.int64(k) * grid.rise + np.int64(j) * grid.row + i)


@fast
def voxel_at(grid: Grid, i: Any, j: Any, k: Any) -> Any:
    """Return the value of one voxel (float32)."""
    return np.float32(np.int32(grid.words[place_of(grid, i, j, k)] & grid.mask))


@inlined
def across(grid: Grid, word: Any, fx: Any) -> Any:
    """Interpolate between the two voxels of a word."""
    one = np.float32(np.int32(word & grid.mask))
    return one + fx * (np.float32(np.int32((word >> grid.bits) & grid.mask)) - one)
