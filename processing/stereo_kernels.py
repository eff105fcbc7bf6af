"""Compiled loops of stereo matching: census codes, path-wise smoothing of costs, sub-pixel parallax by least squares.

Cost arrays are (height, width, candidates): entry k of a pixel is what it costs to believe in its candidate k, the
parallax ``lowest + k``. `processing.stereo_match` gives these loops meaning and names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processing.compiled import compiled

if TYPE_CHECKING:
    Array = np.ndarray[Any, Any]

CENSUS_ROWS, CENSUS_COLUMNS = 3, 4  # to either side: 62 comparisons fill one 64-bit word
MOST_COST = 62
FEWEST_EQUATIONS = 12
MARGIN = 3  # pixels a cubic and its slope need to either side
FLAT = 1e-12
LOCKING_PX = 0.03  # what a single step leaves of the whole pixels it starts from


@compiled
def census(image: Array, out: Array) -> None:
    """Code which pixels of a 7×9 window are brighter than its centre; ``image`` carries the window's margins."""
    height, width = out.shape
    for i in range(height):
        for j in range(width):
            centre = image[i + CENSUS_ROWS, j + CENSUS_COLUMNS]
            code = np.uint64(0)
            for di in range(2 * CENSUS_ROWS + 1):
                for dj in range(2 * CENSUS_COLUMNS + 1):
                    if di != CENSUS_ROWS or dj != CENSUS_COLUMNS:
                        brighter = np.uint64(image[i + di, j + dj] > centre)
                        code = (code << np.uint64(1)) | brighter
            out[i, j] = code


@compiled
def bits_set(word: Any) -> Any:
    """Count the set bits of a 64-bit word by adding neighbours in parallel."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled
def census_costs(left: Array, right: Array, lowest: int, out: Array) -> None:
    """Count the comparisons that differ for every candidate; outside the right image the cost is the highest."""
    height, width, candidates = out.shape
    for i in range(height):
        for j in range(width):
            for k in range(candidates):
                x = j - lowest - k
                inside = 0 <= x < width
                out[i, j, k] = bits_set(left[i, j] ^ right[i, x]) if inside else MOST_COST


@compiled
def step_along_path(cost: Array, before: Array, small: int, large: int, out: Array, total: Array) -> None:
    """Take one pixel into a path: its cost and the cheapest way from the pixel before, changes of parallax priced."""
    candidates = cost.size
    least = before.min()
    jump = least + large
    for k in range(candidates):
        best = min(before[k], jump)
        if k > 0:
            best = min(best, before[k - 1] + small)
        if k + 1 < candidates:
            best = min(best, before[k + 1] + small)
        out[k] = cost[k] + best - least
        total[k] += np.uint16(out[k])


@compiled
def add_paths(costs: Array, grey: Array, small: int, large: int, edge: float, total: Array) -> None:
    """Add the costs along the four paths that come from the left and from above.

    A jump is cheaper where the image itself jumps: ``large`` is divided by 1 + |grey difference| / edge. Turned views
    of the arrays give the other four paths (Hirschmüller 2008, semi-global matching).
    """
    height, width, candidates = costs.shape
    above = np.zeros((3, width + 2, candidates), np.int32)
    here = np.zeros((3, width + 2, candidates), np.int32)
    along = np.zeros((2, candidates), np.int32)
    for i in range(height):
        along[:] = 0
        for j in range(width):
            cost = costs[i, j]
            jump = priced(grey, i, j, 0, -1, small, large, edge)
            step_along_path(cost, along[(j + 1) % 2], small, jump, along[j % 2], total[i, j])
            for way in range(3):
                jump = priced(grey, i, j, -1, way - 1, small, large, edge)
                step_along_path(cost, above[way, j + way], small, jump, here[way, j + 1], total[i, j])
        above, here = here, above


@compiled
def priced(grey: Array, i: int, j: int, di: int, dj: int, small: int, large: int, edge: float) -> int:
    """Price of a jump between pixel (i, j) and its neighbour on the path."""
    width = grey.shape[1]
    y, x = i + di, j + dj
    if y < 0 or x < 0 or x >= width:
        return large
    return max(small, int(large / (1.0 + abs(grey[i, j] - grey[y, x]) / edge)))


@compiled
def winners(total: Array, lowest: int, best: Array, ratio: Array, right: Array) -> None:
    """Choose the cheapest candidate of every left pixel and of every right pixel.

    ``ratio`` is the cost of the runner-up, two steps away or more, over that of the winner, less 1. ``right`` gets
    the parallax of the right view's pixels, NaN where no left pixel reaches.
    """
    height, width, candidates = total.shape
    for i in range(height):
        for j in range(width):
            row = total[i, j]
            k = int(np.argmin(row))
            second = row.max()
            for other in range(candidates):
                if abs(other - k) > 1 and row[other] < second:
                    second = row[other]
            ratio[i, j] = (second - row[k]) / max(row[k], 1)
            best[i, j] = lowest + k + between(row, k)
        for x in range(width):
            right[i, x] = np.nan
            least = np.inf
            for other in range(candidates):
                j = x + lowest + other
                if 0 <= j < width and total[i, j, other] < least:
                    least = total[i, j, other]
                    right[i, x] = lowest + other


@compiled
def between(row: Array, k: int) -> float:
    """Place of the minimum between candidates, from a symmetric V through three costs; 0 at the ends of the band."""
    if k == 0 or k + 1 == row.size:
        return 0.0
    down, up = float(row[k - 1] - row[k]), float(row[k + 1] - row[k])
    steeper = max(down, up)
    return 0.5 * (down - up) / steeper if steeper > 0 else 0.0


@compiled
def cubic(row: Array, x: float) -> Any:
    """Value of a row between pixels, by the cubic through four of them (Keys 1981, a = -1/2)."""
    j = int(np.floor(x))
    t = x - j
    a, b, c, d = row[j - 1], row[j], row[j + 1], row[j + 2]
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))


@compiled
def solve3(normal: Array, rhs: Array, out: Array) -> Any:
    """Solve a symmetric 3×3 system by elimination; returns entry (0, 0) of the inverse, or -1 where it is singular.

    The last unknowns are eliminated first, so that what is left of the first row is its Schur complement.
    """
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 2]
    d, e, f = normal[1, 1], normal[1, 2], normal[2, 2]
    minor = d * f - e * e
    if minor <= 1e-9 * d * f:
        return -1.0
    u, v = (b * f - c * e) / minor, (c * d - b * e) / minor
    left = a - b * u - c * v
    if left <= 1e-9 * a:
        return -1.0
    out[0] = (rhs[0] - u * rhs[1] - v * rhs[2]) / left
    out[1] = ((rhs[1] - b * out[0]) * f - (rhs[2] - c * out[0]) * e) / minor
    out[2] = ((rhs[2] - c * out[0]) * d - (rhs[1] - b * out[0]) * e) / minor
    return 1.0 / left


@compiled
def refine(
    left: Array, right: Array, start: Array, reach: int, tear: float, parallax: Array, sigma: Array, similarity: Array
) -> None:
    """Improve the parallax of every pixel by one least-squares step over the window around it.

    left, right : (height, width) float32; start : (height, width) float32, NaN where unknown. Neighbours whose
    parallax differs by more than ``tear`` lie on another surface and are left out. Unknown are the parallax at the
    centre and its slopes along x and y. ``sigma`` is the error of the first unknown, from the scatter of the
    residuals and what a single step leaves; ``similarity`` the correlation coefficient of the two windows.
    """
    height, width = left.shape
    normal, rhs, found, sums = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(7)
    for i in range(height):
        for j in range(width):
            parallax[i, j], sigma[i, j], similarity[i, j] = np.nan, np.nan, 0.0
            if np.isnan(start[i, j]):
                continue
            window_sums(left, right, start, (i, j, reach), tear, normal, rhs, sums)
            variance = solve3(normal, rhs, found) if sums[0] >= FEWEST_EQUATIONS else -1.0
            alike = correlation(sums)
            if variance < 0 or alike <= 0:
                continue
            unexplained = sums[1] - found[0] * rhs[0] - found[1] * rhs[1] - found[2] * rhs[2]
            parallax[i, j] = start[i, j] + min(max(found[0], -1.0), 1.0)
            sigma[i, j] = np.sqrt(variance * max(unexplained, 0.0) / (sums[0] - 3) + LOCKING_PX**2)
            similarity[i, j] = alike


@compiled
def window_sums(
    left: Array,
    right: Array,
    start: Array,
    window: tuple[int, int, int],
    tear: float,
    normal: Array,
    rhs: Array,
    sums: Array,
) -> None:
    """Sum the equations g (p + a dx + b dy) = r of a window: row, column, reach.

    g is the slope of the right view at a neighbour's own start, r what the views differ by there, corrected for the
    difference of the two starts. ``sums`` gets n, Σr² and, of both views, Σl, Σs, Σl², Σs², Σls.
    """
    height, width = left.shape
    i, j, reach = window
    normal[:], rhs[:], sums[:] = 0.0, 0.0, 0.0
    for y in range(max(i - reach, 0), min(i + reach + 1, height)):
        for x in range(max(j - reach, 0), min(j + reach + 1, width)):
            ahead = start[y, x] - start[i, j]
            at = x - start[y, x]
            if not abs(ahead) <= tear or at < MARGIN or at >= width - MARGIN:
                continue
            light, seen = left[y, x], cubic(right[y], at)
            g = 0.5 * (cubic(right[y], at - 1) - cubic(right[y], at + 1))
            r = light - seen + g * ahead
            add_equation(normal, rhs, g, g * (x - j), g * (y - i), r)
            add_products(sums, light, seen, r)


@compiled
def add_products(sums: Array, light: float, seen: float, r: float) -> None:
    """Add one pair of grey values to the sums a correlation coefficient and the scatter are made of."""
    sums[0] += 1
    sums[1] += r * r
    sums[2] += light
    sums[3] += seen
    sums[4] += light * light
    sums[5] += seen * seen
    sums[6] += light * seen


@compiled
def correlation(sums: Array) -> Any:
    """Return the correlation coefficient of two windows, 0 where one of them is flat."""
    n = max(sums[0], 1.0)
    spread = (sums[4] - sums[2] * sums[2] / n) * (sums[5] - sums[3] * sums[3] / n)
    return (sums[6] - sums[2] * sums[3] / n) / np.sqrt(spread) if spread > FLAT else 0.0


@compiled
def add_equation(normal: Array, rhs: Array, a: float, b: float, c: float, r: float) -> None:
    """Add one equation a u + b v + c w = r to the normal equations (upper triangle)."""
    normal[0, 0] += a * a
    normal[0, 1] += a * b
    normal[0, 2] += a * c
    normal[1, 1] += b * b
    normal[1, 2] += b * c
    normal[2, 2] += c * c
    rhs[0] += a * r
    rhs[1] += b * r
    rhs[2] += c * r
