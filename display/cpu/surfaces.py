"""Surfaces that a ray meets: where the value passes a threshold or changes most, how they stand, and their light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.cpu import fast
from display.cpu.sampling import (
    ANSWER,
    LIGHT_X,
    LOW,
    PER_VALUE,
    START,
    SURFACE,
    THRESHOLD,
    TINY,
    Grid,
    Room,
    at,
    trilinear,
    walk,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Line = tuple[float, ...]

HALVINGS = 5  # of the step in which a surface is found


@fast
def slope(grid: Grid, line: Line, k: float, voxel: Array) -> tuple[float, float, float]:
    """Return the change of the value per µm along (x, y, z), by central differences over one voxel to each side."""
    x, y, z = line[3] + k * line[6], line[4] + k * line[7], line[5] + k * line[8]
    x, y, z = within(x, grid.width), within(y, grid.height), within(z, grid.depth)
    return (
        change(grid, x, y, z, 1.0, 0.0, 0.0) / voxel[0],
        change(grid, x, y, z, 0.0, 1.0, 0.0) / voxel[1],
        change(grid, x, y, z, 0.0, 0.0, 1.0) / voxel[2],
    )


@fast
def within(place: float, size: Any) -> Any:
    """Return the nearest place that has a voxel to each side."""
    return min(max(place, 1.0), size - 2.001)


@fast
def change(grid: Grid, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> Any:
    """Return half the difference of the values at both sides of a point."""
    more = trilinear(grid, np.float32(x + dx), np.float32(y + dy), np.float32(z + dz))
    return 0.5 * (more - trilinear(grid, np.float32(x - dx), np.float32(y - dy), np.float32(z - dz)))


@fast
def crossing(grid: Grid, line: Line, inside: float, outside: float, level: float) -> float:
    """Return where, between two steps, the value passes a level, by halving."""
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if at(grid, line, np.float32(middle)) >= level:
            inside = middle
        else:
            outside = middle
    return inside


@fast
def surface(grid: Grid, room: Room, bounds: Array, line: Line, numbers: Array, voxel: Array, seen: Array) -> None:
    """Find the first place along a ray where the value is not below the threshold: its normal and distance."""
    level = numbers[THRESHOLD] / numbers[PER_VALUE] + numbers[LOW]
    k = START
    for m in range(walk(room, bounds, line)):
        if room.held[m] >= level:
            for step in range(k, room.stops[m]):
                if at(grid, line, np.float32(step)) >= level:
                    outside = max(step - 1.0, -0.5)
                    place = crossing(grid, line, float(step), outside, level)
                    normal(slope(grid, line, place, voxel), line[2] + (place + 0.5) * line[1], seen)
                    return
        k = np.intp(room.stops[m])


@fast
def normal(change: tuple[float, float, float], t: float, seen: Array) -> None:
    """Write the unit normal of a surface, which points to where values fall, and its distance."""
    size = np.sqrt(change[0] ** 2 + change[1] ** 2 + change[2] ** 2)
    for a in range(3):
        seen[a] = -change[a] / size if size > TINY else (-1.0 if a == 2 else 0.0)
    seen[3] = t


@fast
def steepest(grid: Grid, line: Line, numbers: Array, voxel: Array, seen: Array) -> None:
    """Find the place along a ray where the value changes most, if by the threshold per voxel."""
    least = numbers[THRESHOLD] / numbers[PER_VALUE] / min(voxel[0], voxel[1], voxel[2])
    best, where = least * least, -1
    for k in range(int(line[0])):
        x, y, z = slope(grid, line, k, voxel)
        size = x * x + y * y + z * z
        if size > best:
            best, where = size, k
    if where >= 0:
        normal(slope(grid, line, float(where), voxel), line[2] + (where + 0.5) * line[1], seen)


@fast
def glimpse(
    grid: Grid,
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
    place = crossing(grid, line, two, one, level) if before else crossing(grid, line, one, two, level)
    x, y, z = slope(grid, line, place, voxel)
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
