"""Compiled loops of the robust Gauss-Newton refinement: one pass over two pictures gives the normal equations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.compiled import kept

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    Function = TypeVar("Function", bound=Callable[..., Any])
    Array = np.ndarray[Any, Any]

UNKNOWNS = 8  # six of the map, gain, offset
SUMS = 27  # of one row
MARGIN = 2  # pixels from the border where gradients and cubic interpolation have their neighbours


def compiled(function: Function) -> Function:
    """Compile to machine code on first call, sums in any order, and keep it on disk."""
    return kept(function, fastmath=True)


@compiled
def clipped(low: float, high: float, offset: float, slope: float, limit: float) -> tuple[float, float]:
    """Shorten low … high to where 0 <= offset + slope x <= limit."""
    if abs(slope) < 1e-12:
        return (low, high) if 0.0 <= offset <= limit else (1.0, 0.0)
    first, second = -offset / slope, (limit - offset) / slope
    return max(low, min(first, second)), min(high, max(first, second))


@compiled
def row_span(y: int, matrix: Array, height: int, width: int) -> tuple[int, int]:
    """First and one past the last pixel of row ``y`` that the map leads to the inside of a picture of this size."""
    low, high = float(MARGIN), float(width - 1 - MARGIN)
    inside_x, inside_y = width - 1.0 - 2 * MARGIN, height - 1.0 - 2 * MARGIN
    low, high = clipped(low, high, matrix[0, 1] * y + matrix[0, 2] - MARGIN, matrix[0, 0], inside_x)
    low, high = clipped(low, high, matrix[1, 1] * y + matrix[1, 2] - MARGIN, matrix[1, 0], inside_y)
    return int(np.ceil(low)), int(np.floor(high)) + 1


@compiled
def sampled_residuals(a: Array, warped: Array, matrix: Array, gain: float, offset: float, stride: int) -> Array:
    """Differences ``warped - gain a - offset`` of every ``stride``-th pixel along x and y, (n,) float32."""
    height, width = a.shape
    found = np.empty((height // stride + 1) * (width // stride + 1), np.float32)
    count = 0
    for y in range(MARGIN, height - MARGIN, stride):
        first, last = row_span(y, matrix, height, width)
        for x in range(first, last, stride):
            found[count] = warped[y, x] - gain * a[y, x] - offset
            count += 1
    return found[:count]


@compiled
def row_sums(a: Array, w: Array, around: Array, span: Array, fit: Array, sums: Array) -> None:
    """Add one row to the 27 sums from which `normal_equations` are put together.

    ``a`` and ``w`` are rows of reference and warped picture, ``around`` (2, width) the rows above and below of their
    sum; ``span`` first and last pixel, middle and half side; ``fit`` gain, offset and one over the limit of residuals.
    """
    first, last, middle, unit = int(span[0]), int(span[1]), np.float32(span[2]), np.float32(1.0 / span[3])
    gain, offset, inverse = np.float32(fit[0]), np.float32(fit[1]), np.float32(fit[2])
    quarter, zero, one = np.float32(0.25), np.float32(0), np.float32(1)
    xx = xxu = xxuu = xy = xyu = xyuu = yy = yyu = yyuu = zero
    xa = xau = ya = yau = x1 = x1u = y1 = y1u = aa = a1 = n = zero
    xw = xwu = yw = ywu = aw = w1 = ww = zero
    for j in range(first, last):
        value, seen = a[j], w[j]
        residual = (seen - gain * value - offset) * inverse
        inlier = max(one - residual * residual, zero)
        weight = inlier * inlier
        gx = quarter * (a[j + 1] + w[j + 1] - a[j - 1] - w[j - 1])
        gy = quarter * (around[1, j] - around[0, j])
        u = (np.float32(j) - middle) * unit
        px, py, pa, ps = weight * gx, weight * gy, weight * value, weight * seen
        pxu, pyu = px * u, py * u
        xx, xxu, xxuu = xx + px * gx, xxu + pxu * gx, xxuu + pxu * gx * u
        xy, xyu, xyuu = xy + px * gy, xyu + pxu * gy, xyuu + pxu * gy * u
        yy, yyu, yyuu = yy + py * gy, yyu + pyu * gy, yyuu + pyu * gy * u
        xa, xau, ya, yau = xa + px * value, xau + pxu * value, ya + py * value, yau + pyu * value
        x1, x1u, y1, y1u = x1 + px, x1u + pxu, y1 + py, y1u + pyu
        aa, a1, n = aa + pa * value, a1 + pa, n + weight
        xw, xwu, yw, ywu = xw + px * seen, xwu + pxu * seen, yw + py * seen, ywu + pyu * seen
        aw, w1, ww = aw + pa * seen, w1 + ps, ww + ps * seen
    row = (
        *(xx, xxu, xxuu, xy, xyu, xyuu, yy, yyu, yyuu),
        *(xa, xau, ya, yau, x1, x1u, y1, y1u, aa, a1, n),
        *(xw, xwu, yw, ywu, aw, w1, ww),
    )
    for k in range(SUMS):
        sums[k] = row[k]


@compiled
def put_together(s: Array, v: float, matrix: Array, right: Array) -> None:
    """Add a row's sums to the normal equations; ``v`` is the row's coordinate."""
    by_power = (1.0, v, v * v)
    for p in range(3):  # x, y, 1 of the first factor
        for q in range(3):
            on_u, on_v = (p == 0) + (q == 0), (p == 1) + (q == 1)
            matrix[p, q] += s[on_u] * by_power[on_v]
            matrix[p, 3 + q] += s[3 + on_u] * by_power[on_v]
            matrix[3 + p, 3 + q] += s[6 + on_u] * by_power[on_v]
        at, factor = int(p == 0), by_power[int(p == 1)]
        matrix[p, 6] += s[9 + at] * factor
        matrix[3 + p, 6] += s[11 + at] * factor
        matrix[p, 7] += s[13 + at] * factor
        matrix[3 + p, 7] += s[15 + at] * factor
        right[p] += s[20 + at] * factor
        right[3 + p] += s[22 + at] * factor
    matrix[6, 6] += s[17]
    matrix[6, 7] += s[18]
    matrix[7, 7] += s[19]
    right[6] += s[24]
    right[7] += s[25]


@compiled
def normal_equations(
    a: Array, warped: Array, matrix: Array, fit: Array, out: Array, right: Array, sums: Array
) -> tuple[float, int]:
    """Fill the weighted normal equations of warped = gain a + offset - ∇ · D (u, v, 1) over all pixels both show.

    Parameters
    ----------
    a, warped : array (height, width) float32
        Reference, and the other picture as the present map shows it.
    matrix : array (3, 3) float64
        Present map in pixels, from reference to the other picture.
    fit : array (3,) float64
        Gain, offset, and one over the residual from which a pixel has no say (Tukey).
    out, right : array (8, 8), (8,) float64
        Zeros; filled with the upper half of the matrix, unknowns D row by row, gain, offset.
    sums : array (27,) float64
        Scratch.

    Returns
    -------
    weighted_square, pixels
        Weighted sum of ``warped`` squared, and how many pixels were looked at.
    """
    height, width = a.shape
    half = max(height, width) / 2
    around = np.empty((2, width), np.float32)
    span = np.empty(4)
    square, pixels = 0.0, 0
    for y in range(MARGIN, height - MARGIN):
        first, last = row_span(y, matrix, height, width)
        if last <= first:
            continue
        around[0] = a[y - 1] + warped[y - 1]
        around[1] = a[y + 1] + warped[y + 1]
        span[0], span[1], span[2], span[3] = first, last, (width - 1) / 2, half
        row_sums(a[y], warped[y], around, span, fit, sums)
        put_together(sums, (y - (height - 1) / 2) / half, out, right)
        square += sums[26]
        pixels += last - first
    return square, pixels
