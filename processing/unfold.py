"""Sizes of balls from the circles that sections show of them, with error bars, beside sizes measured directly.

A section shows few balls at their full width, and small ones less often than large ones. For balls of diameter D,
N_V in a volume, a section shows N_V (√(D² - a²) - √(D² - b²)) circles per area with diameters of a … b (Wicksell 1925).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

Method = Literal["ems", "saltykov"]
CLASSES = 15
FEWEST_CIRCLES = 10
ROUNDS = 200
SPREAD = 0.035  # to each neighbouring class; more would be better for few circles, less for many
WITHIN_CLASS = 16  # points at which a class of balls is looked at
BOOTSTRAPS = 100


@dataclass(frozen=True, eq=False)
class Unfolded:
    """How many balls there are of which size.

    Attributes
    ----------
    edges_um : array (classes + 1,)
        Ends of the classes of diameter.
    per_um3 : array (classes,)
        Balls of each class in a volume.
    error_per_um3 : array (classes,)
        Standard error, by drawing the circles again.
    mean_um, mean_error_um : float
        Mean diameter.
    """

    edges_um: Array
    per_um3: Array
    error_per_um3: Array
    mean_um: float
    mean_error_um: float


def kernel(edges_um: Array, *, upper: bool = False) -> Array:
    """Return how many circles of each class (rows) a ball of each class (columns) shows per area and per volume.

    Parameters
    ----------
    upper : bool
        All balls of a class have its largest diameter, as in the textbooks; else they are spread evenly over it.
    """
    low, high = edges_um[:-1, None], edges_um[1:, None]
    if upper:
        return _shown(edges_um[None, 1:], low, high)
    points, weights = np.polynomial.legendre.leggauss(WITHIN_CLASS)
    middle, half = (edges_um[1:] + edges_um[:-1]) / 2, np.diff(edges_um) / 2
    parts = [w / 2 * _shown((middle + half * p)[None], low, high) for p, w in zip(points, weights, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def _shown(diameter: Array, low: Array, high: Array) -> Array:
    def chord(width: Array) -> Array:
        return np.asarray(np.sqrt(np.maximum(diameter**2 - width**2, 0)))

    return chord(low) - chord(high)


def unfold(
    circles_um: Array,
    area_um2: float,
    *,
    weights: Array | None = None,
    edges_um: Array | None = None,
    method: Method = "ems",
    seed: int = 0,
) -> Unfolded:
    """Find the sizes of balls from those of circles.

    Parameters
    ----------
    circles_um : array (n,)
        Diameters of the circles.
    area_um2 : float
        Area of all sections together.
    weights : array (n,), optional
        How many circles each stands for: large ones are cut by the border more often.
    edges_um : array, optional
        Ends of the classes; 15 even ones when left out.
    method : {"ems", "saltykov"}
        Expectation and maximisation with smoothing (Silverman et al. 1990), or the textbook's subtraction from the
        largest class down (Saltykov 1967), where what gets below zero is set to zero.
    seed : int
        Of the circles drawn again for the errors.

    Raises
    ------
    InputError
        ``circles``: too few, or diameters that are none.
    """
    circles = np.asarray(circles_um, np.float64)
    if circles.size < FEWEST_CIRCLES or not np.isfinite(circles).all() or circles.min() <= 0:
        raise InputError(
            f"{circles.size} circles are too few, or have no diameter: sizes of balls cannot be found from them.",
            fix=f"give {FEWEST_CIRCLES} at least, each above zero.",
            code="circles",
        )
    edges = np.linspace(0, circles.max() * (1 + 1e-9), CLASSES + 1) if edges_um is None else np.asarray(edges_um)
    each = np.ones(circles.size) if weights is None else np.asarray(weights, np.float64)
    solve = _saltykov if method == "saltykov" else _ems
    matrix = kernel(edges, upper=method == "saltykov")

    rng, everything = np.random.default_rng(seed), np.arange(circles.size)
    again = [rng.integers(0, circles.size, rng.poisson(circles.size)) for _ in range(BOOTSTRAPS)]
    counts = [np.histogram(circles[some], edges, weights=each[some])[0] for some in (everything, *again)]
    solved = solve(matrix, np.array(counts).T / area_um2)
    best, drawn, middle = solved[:, 0], solved[:, 1:], (edges[1:] + edges[:-1]) / 2
    means = middle @ solved / np.maximum(solved.sum(axis=0), 1e-300)
    return Unfolded(edges, best, drawn.std(axis=1, ddof=1), float(means[0]), float(means[1:].std(ddof=1)))


def _ems(matrix: Array, counts: Array) -> Array:
    """Make the circles that are seen the likeliest, and smooth after each step; a column for each set of counts."""
    seen = np.maximum(matrix.sum(axis=0), 1e-300)[:, None]
    balls = np.tile(counts.sum(axis=0) / seen.sum(), (len(counts), 1))
    for _ in range(ROUNDS):
        expected = np.maximum(matrix @ balls, 1e-300)
        balls = balls * (matrix.T @ (counts / expected)) / seen
        padded = np.pad(balls, [(1, 1), (0, 0)])
        balls = SPREAD * (padded[:-2] + padded[2:]) + (1 - 2 * SPREAD) * balls
    return balls


def _saltykov(matrix: Array, counts: Array) -> Array:
    left, balls = counts.astype(np.float64), np.zeros_like(counts, np.float64)
    for k in range(len(counts) - 1, -1, -1):
        balls[k] = left[k] / matrix[k, k]
        left = left - matrix[:, k, None] * balls[k]
    return np.maximum(balls, 0)
