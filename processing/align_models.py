"""Maps of the plane that sections may need, from a shift to an affine map, and what can be read from them.

A map is a 3×3 matrix, float64, last row (0, 0, 1), from pixel (x, y, 1) of one picture to pixel (x, y, 1) of another;
pixel centres lie at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

Model = Literal["translation", "rigid", "uniaxial", "similarity", "affine"]
MODELS: tuple[Model, ...] = get_args(Model)
GRID = np.linspace(-0.35, 0.35, 9)  # where a section is looked at, in units of its sides: within what neighbours share
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class Deformation:
    """What a map does to lengths.

    Attributes
    ----------
    rotation_deg : float
        Counted from x towards y, as seen with y down.
    compression : float
        Shortening along ``direction_deg`` beyond that across it: 0.1 is ten per cent.
    direction_deg : float
        Axis of the shortening in the picture the map leads to, 0 … 180; no meaning where there is no compression.
    scale : float
        Length factor across that direction.
    """

    rotation_deg: float
    compression: float
    direction_deg: float
    scale: float


def frame(shape: tuple[int, ...]) -> Array:
    """Matrix from pixels to coordinates from the middle of a picture, in units of half its longer side."""
    height, width = shape[:2]
    half = max(height, width) / 2
    return np.array([[1 / half, 0, -(width - 1) / 2 / half], [0, 1 / half, -(height - 1) / 2 / half], [0, 0, 1]])


def about_centre(matrix: Array, shape: tuple[int, ...]) -> Array:
    """Return the map in the coordinates of `frame`."""
    to_frame = frame(shape)
    return np.asarray(to_frame @ matrix @ np.linalg.inv(to_frame))


def in_pixels(matrix: Array, shape: tuple[int, ...]) -> Array:
    """Return a map given in the coordinates of `frame` in pixels."""
    to_frame = frame(shape)
    return np.asarray(np.linalg.inv(to_frame) @ matrix @ to_frame)


def nearest(model: Model, matrix: Array) -> Array:
    """Return the map of ``model`` next to ``matrix``; the image of the origin stays where it is."""
    found = np.array(matrix, np.float64)
    left, lengths, right = np.linalg.svd(found[:2, :2])
    turn = left @ right
    if model == "translation":
        found[:2, :2] = np.eye(2)
    elif model == "rigid":
        found[:2, :2] = turn
    elif model == "similarity":
        found[:2, :2] = turn * lengths.mean()
    elif model == "uniaxial":
        found[:2, :2] = left @ np.diag(_one_length(lengths)) @ right
    return found


def _one_length(lengths: Array) -> Array:
    """Keep the length factor that differs most from one."""
    kept = int(np.argmax(np.abs(np.log(np.maximum(lengths, 1e-12)))))
    return np.where(np.arange(2) == kept, lengths, 1.0)


def nearest_in_pixels(model: Model, matrix: Array, shape: tuple[int, ...]) -> Array:
    """Return the map of the model next to one given in pixels; the middle of the section stays where it is."""
    middle = np.eye(3)
    middle[:2, 2] = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    return np.asarray(nearest(model, matrix @ middle) @ np.linalg.inv(middle))


def tangent(model: Model, matrix: Array) -> Array:
    """Directions in which a map may move: columns of D, row by row, where M becomes M (1 + D).

    Parameters
    ----------
    model : Model
        Which maps are allowed.
    matrix : array (3, 3)
        Map in the coordinates of `frame`; matters for ``uniaxial`` only, which is no group.

    Returns
    -------
    array (6, n)
        One column for each parameter: 2, 3, 5, 4 or 6 of them, in the order of `Model`.
    """
    shifts = [np.array([0, 0, 1, 0, 0, 0.0]), np.array([0, 0, 0, 0, 0, 1.0])]
    linear: dict[Model, list[Array]] = {
        "translation": [],
        "rigid": [QUARTER_TURN],
        "similarity": [QUARTER_TURN, np.eye(2)],
        "affine": [np.eye(4)[k].reshape(2, 2) for k in range(4)],
    }
    chosen = _uniaxial_directions(matrix[:2, :2]) if model == "uniaxial" else linear[model]
    return np.stack([*shifts, *(np.column_stack([d, np.zeros(2)]).ravel() for d in chosen)], axis=1)


def _uniaxial_directions(linear: Array) -> list[Array]:
    """Rotation, length and direction of L = R S: dL of each, brought to the right of L."""
    left, lengths, right = np.linalg.svd(linear)
    lengths = _one_length(lengths)
    turn, stretch = left @ right, right.T @ np.diag(lengths) @ right
    along = left @ np.diag((lengths != 1).astype(float) if (lengths != 1).any() else [1.0, 0.0]) @ right
    moves = (QUARTER_TURN @ linear, along, turn @ (QUARTER_TURN @ stretch - stretch @ QUARTER_TURN))
    back = np.linalg.inv(linear)
    return [back @ move for move in moves]


def applied(matrix: Array, points: Array) -> Array:
    """Map points (n, 2) as (x, y)."""
    return np.asarray(points @ matrix[:2, :2].T + matrix[:2, 2])


def grid(shape: tuple[int, ...]) -> Array:
    """Return 81 points (x, y) spread over the middle seven tenths of a picture."""
    y, x = np.meshgrid(GRID, GRID, indexing="ij")
    height, width = shape[:2]
    return np.column_stack([(x.ravel() + 0.5) * (width - 1), (y.ravel() + 0.5) * (height - 1)])


def distance_px(first: Array, second: Array, shape: tuple[int, ...]) -> float:
    """Mean distance in pixels of where two maps put the points of `grid`."""
    points = grid(shape)
    return float(np.linalg.norm(applied(first, points) - applied(second, points), axis=1).mean())


def deformation(matrix: Array) -> Deformation:
    """Take a map apart: L = R(θ) V diag(s, s (1 − c)) Vᵀ by singular values."""
    left, lengths, right = np.linalg.svd(matrix[:2, :2])
    turn = left @ right
    direction = np.degrees(np.arctan2(left[1, 1], left[0, 1])) % 180
    rotation = np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
    return Deformation(float(rotation), float(1 - lengths[1] / lengths[0]), float(direction), float(lengths[0]))


def fitted(model: Model, source: Array, target: Array, weights: Array | None = None) -> Array:
    """Return the map of ``model`` that brings points (n, 2) nearest to other points, by least squares.

    Raises
    ------
    ValueError
        Fewer points than the model needs.
    """
    needed = {"translation": 1, "rigid": 2, "similarity": 2, "uniaxial": 3, "affine": 3}[model]
    if len(source) < needed:
        raise ValueError(f"{model} needs {needed} points, there are {len(source)}")
    weight = np.ones(len(source)) if weights is None else weights
    middle = np.average(source, axis=0, weights=weight)
    centred = source - middle
    start: Model = "affine" if model == "uniaxial" else model  # a direction of shortening has to be seen first
    matrix = np.eye(3)
    for kind in (start, *[model] * (0 if model == "affine" else 20)):
        matrix = nearest(model, matrix @ (np.eye(3) + _point_step(kind, matrix, centred, target, weight)))
    back = np.eye(3)
    back[:2, 2] = -middle
    return np.asarray(matrix @ back)


def _point_step(model: Model, matrix: Array, source: Array, target: Array, weight: Array) -> Array:
    spread = np.sqrt((source**2).mean()) or 1.0
    scaled = np.column_stack([source / spread, np.ones(len(source))])
    rows = np.zeros((len(source), 2, 6))
    rows[:, 0, :3] = rows[:, 1, 3:] = scaled
    moved = np.einsum("ij,njk->nik", matrix[:2, :2], rows)
    units = np.diag([spread, spread, 1, spread, spread, 1])  # D of scaled points to that of points in pixels
    directions = tangent(model, matrix)
    columns = moved @ units @ directions * np.sqrt(weight)[:, None, None]
    missing = (target - applied(matrix, source)) * np.sqrt(weight)[:, None]
    step = np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), missing.ravel(), rcond=1e-9)[0]
    found = np.zeros((3, 3))
    found[:2] = (directions @ step).reshape(2, 3)
    return found
