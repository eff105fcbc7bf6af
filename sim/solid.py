"""A solid with structures in depth: cells with membranes, nuclei and organelles, and grain, at every point of space.

Nothing is stored: what lies at a place follows from the place and the seed alone, so the face of a block cut at any
depth is computed as truth. Cells are those of Worley (1996): a point belongs to the nearest of randomly placed centres,
one in each box of a grid, and lies in a membrane where the second nearest is hardly further.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

CELL_UM = 6.0
CELL_BOXES_UM, ORGANELLE_BOXES_UM, GRAIN_UM = CELL_UM, 1.6, 0.35
MEMBRANE_UM, EDGE_UM = 0.35, 0.12
MEMBRANE, NUCLEUS, ORGANELLE = 0.18, 0.42, 0.28
GRAIN = 0.12
FILLED = 0.6  # share of boxes that hold a nucleus or an organelle
CELLS, ORGANELLES, GRAINS = 0, 8, 16  # streams of random numbers; a centre takes four


@dataclass(frozen=True)
class Solid:
    """A block of tissue without end in any direction; the same seed gives the same one."""

    seed: int

    def face(
        self, size_px: tuple[int, int], pixel_um: float, depth_um: float, corner_um: tuple[float, float] = (0.0, 0.0)
    ) -> np.ndarray:
        """Return what lies at a depth.

        Parameters
        ----------
        size_px : (int, int)
            Width and height.
        pixel_um : float
            Distance of the points.
        depth_um : float
            Depth below the first face.
        corner_um : (float, float)
            Where x and y of the first point are.

        Returns
        -------
        ndarray, shape (height, width), float32
            Brightness from 0 to 1.
        """
        width, height = size_px
        x_um = corner_um[0] + pixel_um * np.arange(width)
        y_um = corner_um[1] + pixel_um * np.arange(height)
        out = np.empty((height, width), np.float32)
        _paint(self.seed, x_um, y_um, float(depth_um), out)
        return out


@njit(nogil=True, error_model="numpy", cache=True)
def _random(seed: int, stream: int, ix: int, iy: int, iz: int) -> float:
    """Return a number of 0 … 1 that belongs to a box: its coordinates, mixed (constants of Steele et al. 2014)."""
    mixed = np.uint64(seed) + np.uint64(stream) * np.uint64(0x9E3779B97F4A7C15)
    for number in (ix, iy, iz):
        mixed = (mixed ^ np.uint64(number)) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(32)
    return float(mixed >> np.uint64(11)) / 9007199254740992.0


@njit(nogil=True, error_model="numpy", cache=True)
def _centres(seed: int, stream: int, box_um: float, ends: tuple[int, int, int, int], iz: int) -> np.ndarray:
    """Return (rows, columns, 3, 4): x, y, z in µm of the centre in each box near a plane, and a number of its own."""
    first_x, last_x, first_y, last_y = ends
    found = np.empty((last_y - first_y + 1, last_x - first_x + 1, 3, 4))
    for row in range(found.shape[0]):
        for column in range(found.shape[1]):
            for layer in range(3):
                box = (first_x + column, first_y + row, iz - 1 + layer)
                for k in range(4):
                    place = _random(seed, stream + k, box[0], box[1], box[2])
                    found[row, column, layer, k] = (box[k] + place) * box_um if k < 3 else place
    return found


@njit(nogil=True, error_model="numpy", cache=True)
def _box(place_um: float, box_um: float) -> int:
    return int(np.floor(place_um / box_um))


@njit(nogil=True, error_model="numpy", cache=True)
def _ends(x_um: np.ndarray, y_um: np.ndarray, box_um: float) -> tuple[int, int, int, int]:
    """Return the first and last box along x and y, with one more on each side."""
    return (
        _box(x_um[0], box_um) - 1,
        _box(x_um[-1], box_um) + 1,
        _box(y_um[0], box_um) - 1,
        _box(y_um[-1], box_um) + 1,
    )


@njit(nogil=True, error_model="numpy", cache=True)
def _rise(value: float, edge: float) -> float:
    """Return 0 below -edge, 1 above +edge, and a smooth rise between."""
    part = min(max(0.5 + value / (2 * edge), 0.0), 1.0)
    return part * part * (3 - 2 * part)


@njit(nogil=True, error_model="numpy", cache=True)
def _paint(seed: int, x_um: np.ndarray, y_um: np.ndarray, z_um: float, out: np.ndarray) -> None:
    cells = _centres(seed, CELLS, CELL_BOXES_UM, _ends(x_um, y_um, CELL_BOXES_UM), _box(z_um, CELL_BOXES_UM))
    organelle_ends = _ends(x_um, y_um, ORGANELLE_BOXES_UM)
    organelles = _centres(seed, ORGANELLES, ORGANELLE_BOXES_UM, organelle_ends, _box(z_um, ORGANELLE_BOXES_UM))
    grain = _lattice(seed, _ends(x_um, y_um, GRAIN_UM), z_um)
    for row in range(y_um.size):
        for column in range(x_um.size):
            x, y = x_um[column], y_um[row]
            body = _cell(cells, x_um[0], y_um[0], x, y, z_um)
            inside = _organelle(organelles, x_um[0], y_um[0], x, y, z_um)
            value = body + inside * (ORGANELLE - body) if body > ORGANELLE else body
            out[row, column] = value + GRAIN * (_grain(grain, x_um[0], y_um[0], x, y) - 0.5)


@njit(nogil=True, error_model="numpy", cache=True)
def _cell(cells: np.ndarray, x0: float, y0: float, x: float, y: float, z: float) -> float:
    """Return the brightness of the cell at a place: membrane, nucleus or its own shade."""
    column = _box(x, CELL_BOXES_UM) - _box(x0, CELL_BOXES_UM)
    row = _box(y, CELL_BOXES_UM) - _box(y0, CELL_BOXES_UM)
    first, second, own = np.inf, np.inf, 0.0
    for i in range(row, row + 3):
        for j in range(column, column + 3):
            for k in range(3):
                centre = cells[i, j, k]
                square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
                if square < first:
                    first, second, own = square, first, centre[3]
                elif square < second:
                    second = square
    distance = np.sqrt(first)
    shade = 0.58 + 0.22 * own
    if own < FILLED:
        shade += (NUCLEUS - shade) * _rise((0.24 + 0.16 * own) * CELL_BOXES_UM - distance, EDGE_UM)
    return MEMBRANE + (shade - MEMBRANE) * _rise(np.sqrt(second) - distance - MEMBRANE_UM, EDGE_UM)


@njit(nogil=True, error_model="numpy", cache=True)
def _organelle(organelles: np.ndarray, x0: float, y0: float, x: float, y: float, z: float) -> float:
    """Return 1 inside an organelle, a ball of 0.25 to 0.55 µm, 0 outside, and between at its edge."""
    column = _box(x, ORGANELLE_BOXES_UM) - _box(x0, ORGANELLE_BOXES_UM)
    row = _box(y, ORGANELLE_BOXES_UM) - _box(y0, ORGANELLE_BOXES_UM)
    deepest = -1.0
    for i in range(row, row + 3):
        for j in range(column, column + 3):
            for k in range(3):
                centre = organelles[i, j, k]
                if centre[3] < FILLED:
                    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
                    deepest = max(deepest, 0.25 + 0.5 * centre[3] - np.sqrt(square))
    return _rise(deepest, EDGE_UM)


@njit(nogil=True, error_model="numpy", cache=True)
def _lattice(seed: int, ends: tuple[int, int, int, int], z_um: float) -> np.ndarray:
    """Return (rows, columns): random numbers at the corners of a grid, those of two layers mixed by depth."""
    first_x, last_x, first_y, last_y = ends
    layer = _box(z_um, GRAIN_UM)
    part = z_um / GRAIN_UM - layer
    found = np.empty((last_y - first_y + 2, last_x - first_x + 2))
    for row in range(found.shape[0]):
        for column in range(found.shape[1]):
            above = _random(seed, GRAINS, first_x + column, first_y + row, layer)
            below = _random(seed, GRAINS, first_x + column, first_y + row, layer + 1)
            found[row, column] = above + part * (below - above)
    return found


@njit(nogil=True, error_model="numpy", cache=True)
def _grain(lattice: np.ndarray, x0: float, y0: float, x: float, y: float) -> float:
    """Return the lattice's numbers between its corners, linearly."""
    column, row = _box(x, GRAIN_UM), _box(y, GRAIN_UM)
    right, down = x / GRAIN_UM - column, y / GRAIN_UM - row
    column -= _box(x0, GRAIN_UM) - 1
    row -= _box(y0, GRAIN_UM) - 1
    upper = lattice[row, column] + right * (lattice[row, column + 1] - lattice[row, column])
    lower = lattice[row + 1, column] + right * (lattice[row + 1, column + 1] - lattice[row + 1, column])
    return float(upper + down * (lower - upper))
