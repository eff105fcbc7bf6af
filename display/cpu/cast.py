"""The ray loop on the processor: the same steps and the same pictures as ``shaders/cast.frag.glsl``.

A sample lies at the middle of each of n equal steps between the points where a ray enters and leaves the volume. Bricks
without anything to see are leaped over by whole steps, so that leaping changes nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast, over_rows
from display.cpu.bricks import SIDE, Bricks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.rays import Rays

    Array = NDArray[Any]

MAX, MIN, SUM, LIGHT, FIRST, LAST, EDGE = range(7)
TINY = 1e-9


def cast(
    kind: int,
    bricks: Bricks,
    rays: Rays,
    box: tuple[Array, Array],
    size: tuple[int, int],
    *,
    step_um: float,
    limits: tuple[float, float],
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
    limits : (float, float)
        Values that count as 0 and 1.

    Returns
    -------
    array (height, width, 4) float32
        What the mode's snippet calls ``seen``.
    """
    seen = np.zeros((size[1], size[0], 4), np.float32)
    eye = np.zeros(3) if rays.eye is None else rays.eye
    geometry = np.stack([rays.corner, rays.right, rays.down, rays.along, eye, rays.voxel_um, *box])
    scale = np.array([limits[0], 1 / (limits[1] - limits[0]), step_um, rays.eye is not None])
    args = (bricks.padded, bricks.low, bricks.high, geometry, scale)
    over_rows(size[1], lambda first, last: cast_rows(kind, *args, first, last, seen))
    return seen


@fast
def cast_rows(
    kind: int, padded: Array, low: Array, high: Array, geometry: Array, scale: Array, first: int, last: int, seen: Array
) -> None:
    """Cast the rays of some rows."""
    for j in range(first, last):
        for i in range(seen.shape[1]):
            line = ray(geometry, i, j, scale[2], scale[3] > 0)
            if line[0] > 0:
                extreme(kind == MAX, padded, low, high, line, scale, seen[j, i])


@fast
def ray(geometry: Array, i: int, j: int, step_um: float, perspective: bool) -> tuple[float, ...]:  # noqa: FBT001
    """Return number, length in µm and place of the steps of a ray: (n, ds, near, x, y, z, dx, dy, dz).

    x, y, z are the middle of step 0 and dx, dy, dz one step, in indices of the padded volume.
    """
    voxel, box_low, box_high = geometry[5], geometry[6], geometry[7]
    start = geometry[0] + i * geometry[1] + j * geometry[2]
    way = start - geometry[4] if perspective else geometry[3].copy()
    reach = np.sqrt((way[0] * voxel[0]) ** 2 + (way[1] * voxel[1]) ** 2 + (way[2] * voxel[2]) ** 2)
    near, far = (-reach if perspective else -1e9), 1e9
    for a in range(3):
        way[a] = way[a] / reach
        d = way[a] if abs(way[a]) > TINY else TINY
        one, two = (box_low[a] - start[a]) / d, (box_high[a] - start[a]) / d
        near, far = max(near, min(one, two)), min(far, max(one, two))
    n = np.ceil((far - near) / step_um) if far > near else 0.0
    ds = (far - near) / max(n, 1.0)
    begin = start + 1 + (near + 0.5 * ds) * way
    return n, ds, near, begin[0], begin[1], begin[2], way[0] * ds, way[1] * ds, way[2] * ds


@fast
def brick_end(line: tuple[float, ...], k: int, bx: int, by: int, bz: int) -> int:
    """Return the first step after ``k`` that is outside of a brick, or the number of steps."""
    end = line[0]
    for b, o, d in ((bx, line[3], line[6]), (by, line[4], line[7]), (bz, line[5], line[8])):
        if d > TINY:
            end = min(end, np.ceil(((b + 1) * SIDE - o) / d))
        elif d < -TINY:
            end = min(end, np.floor((b * SIDE - o) / d) + 1)
    return max(int(end), k + 1)


@fast
def extreme(
    largest: bool,  # noqa: FBT001
    padded: Array,
    low: Array,
    high: Array,
    line: tuple[float, ...],
    scale: Array,
    seen: Array,
) -> None:
    """Find the largest or smallest value along a ray, and where it is."""
    n, ds, near, x, y, z, dx, dy, dz = line
    best, where, k = np.float32(-1.0 if largest else 1e9), 0, 0
    while k < n:
        bx, by, bz = int(x + k * dx) // SIDE, int(y + k * dy) // SIDE, int(z + k * dz) // SIDE
        end = brick_end(line, k, bx, by, bz)
        if (high[bz, by, bx] > best) if largest else (low[bz, by, bx] < best):
            for step in range(k, end):
                v = trilinear(padded, x + step * dx, y + step * dy, z + step * dz)
                if (v > best) if largest else (v < best):
                    best, where = v, step
        k = end
    seen[0] = min(max((best - scale[0]) * scale[1], 0.0), 1.0)
    seen[1] = near + (where + 0.5) * ds
    seen[2] = 1


@fast
def trilinear(padded: Array, x: float, y: float, z: float) -> Any:
    """Interpolate at a point given in indices of ``padded``."""
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    a, b, c, d = padded[k, j], padded[k, j + 1], padded[k + 1, j], padded[k + 1, j + 1]
    a0, b0, c0, d0 = np.float32(a[i]), np.float32(b[i]), np.float32(c[i]), np.float32(d[i])
    a1, b1, c1, d1 = np.float32(a[i + 1]), np.float32(b[i + 1]), np.float32(c[i + 1]), np.float32(d[i + 1])
    front = (a0 + fx * (a1 - a0)) * (1 - fy) + (b0 + fx * (b1 - b0)) * fy
    back = (c0 + fx * (c1 - c0)) * (1 - fy) + (d0 + fx * (d1 - d0)) * fy
    return front + fz * (back - front)
