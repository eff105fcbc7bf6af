"""Compiled loops of the focus measurement: gradient energy, running peak, sub-plane fit, merge and gather.

They are table-driven, single-threaded and cached on disk; `processing.focus` gives them meaning and names.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from processing.compiled import compiled

Array = np.ndarray[Any, Any]

SAMPLES = 5  # sharpness kept around the peak of a pixel: two planes before it, itself, two after
CENTRE = SAMPLES // 2
BLOCK = 64  # pixels gathered or skipped together
SOBEL_GAIN = 8.0


@compiled
def row_gradient(above: Array, row: Array, below: Array, step: int, smooth: Array, change: Array) -> None:
    """Smooth and differentiate across three rows; ``smooth`` and ``change`` carry ``step`` replicated ends."""
    n = row.size
    smooth_row, change_row = smooth[step : step + n], change[step : step + n]
    for j in range(n):
        up, middle, down = np.float32(above[j]), np.float32(row[j]), np.float32(below[j])
        smooth_row[j] = up + middle + middle + down
        change_row[j] = down - up
    for ends in (smooth, change):
        ends[:step] = ends[step : 2 * step]
        ends[step + n :] = ends[n : step + n]


@compiled
def add_squares(smooth: Array, change: Array, step: int, energy: Array) -> None:
    """Add the squared Sobel gradient of one row to ``energy``."""
    n = smooth.size - 2 * step
    left, right = smooth[:n], smooth[2 * step :]
    before, here, after = change[:n], change[step : step + n], change[2 * step :]
    for j in range(n):  # slices, not shifted indices: the compiler makes vector instructions of these alone
        across = right[j] - left[j]
        along = before[j] + here[j] + here[j] + after[j]
        energy[j] += across * across + along * along


@compiled
def gradient_energy(plane: Array, bands: int, gain: float, out: Array) -> None:
    """Mean squared gradient of 2×2 pixels, all bands together, at half resolution, times ``gain`` squared.

    Parameters
    ----------
    plane : array (height, width * bands) uint8 or uint16
        A plane with its bands interleaved.
    out : array ((height + 1) // 2, (width + 1) // 2) float32
        Energy in (grey levels per pixel)².
    """
    height, n = plane.shape
    smooth = np.empty(n + 2 * bands, np.float32)
    change = np.empty(n + 2 * bands, np.float32)
    energy = np.empty(2 * bands * out.shape[1], np.float32)
    scale = np.float32(gain * gain / (SOBEL_GAIN * SOBEL_GAIN * 4 * bands))
    for i in range(out.shape[0]):
        energy[:] = 0
        for r in (2 * i, min(2 * i + 1, height - 1)):
            row_gradient(plane[max(r - 1, 0)], plane[r], plane[min(r + 1, height - 1)], bands, smooth, change)
            add_squares(smooth, change, bands, energy)
        for j in range(n, energy.size):
            energy[j] = energy[j - bands]
        for j in range(out.shape[1]):
            total = np.float32(0)
            for b in range(2 * bands):
                total += energy[2 * bands * j + b]
            out[i, j] = total * scale


@compiled
def halve(fine: Array, out: Array) -> None:
    """Mean of 2×2 pixels; a last odd row or column counts twice."""
    height, width = fine.shape
    quarter = np.float32(0.25)
    for i in range(out.shape[0]):
        top, bottom = fine[2 * i], fine[min(2 * i + 1, height - 1)]
        for j in range(out.shape[1]):
            right = min(2 * j + 1, width - 1)
            out[i, j] = (top[2 * j] + top[right] + bottom[2 * j] + bottom[right]) * quarter


@compiled
def track_peak(value: Array, before: Array, earlier: Array, k: int, plane: Array, samples: Array, total: Array) -> None:
    """Take plane ``k`` into the running peak; all arrays are flat, ``samples`` is (5, pixels).

    A sample of 0 stands for "no such plane".
    """
    for i in range(value.size):
        now = value[i]
        total[i] += now
        if now > samples[CENTRE, i] or k == 0:
            plane[i] = k
            samples[0, i], samples[1, i], samples[2, i] = earlier[i], before[i], now
            samples[3, i], samples[4, i] = 0, 0
        elif k == plane[i] + 1:
            samples[3, i] = now
        elif k == plane[i] + 2:
            samples[4, i] = now


@compiled
def first_above(
    value: Array, threshold: float, k: int, plane: Array, fraction: Array, before: Array, top: Array
) -> None:
    """Take plane ``k`` into the search for the first value at or over ``threshold``; all arrays are flat.

    ``fraction`` is how far before plane ``plane`` the threshold was passed, in steps, by linear interpolation; NaN
    while it was not. ``top`` is the largest value so far.
    """
    for i in range(value.size):
        now = np.float32(value[i])
        top[i] = max(top[i], now)
        if np.isnan(fraction[i]) and now >= threshold:
            plane[i] = k
            fraction[i] = 0.0 if k == 0 else (now - threshold) / (now - before[i])
        before[i] = now


@compiled
def vertex(offset: Array, value: Array) -> tuple[float, float]:
    """Vertex and curvature of the weighted parabola y = -1/√value over ``offset``, weights value².

    The tails of a focus curve fall like 1/(1 + (d/w)²)², for which this is exact and gives curvature -1/w²; squared
    weights (Guo 2011, IEEE Signal Process. Mag. 28:134) leave the tails of a coarsely sampled curve without a say.

    Parameters
    ----------
    offset, value : array (5,) float64
        Distance from the peak plane, and sharpness relative to it; a value of 0 is missing.
    """
    m0 = m1 = m2 = m3 = m4 = b0 = b1 = b2 = 0.0
    known = 0
    for i in range(SAMPLES):
        if value[i] <= 0:
            continue
        known += 1
        x = offset[i]
        w = value[i] * value[i]
        y = -w / np.sqrt(value[i])
        m0 += w
        m1 += w * x
        m2 += w * x * x
        m3 += w * x * x * x
        m4 += w * x * x * x * x
        b0 += y
        b1 += y * x
        b2 += y * x * x
    if known < 3:
        return 0.0, 0.0
    c00, c01, c02 = m2 * m4 - m3 * m3, m2 * m3 - m1 * m4, m1 * m3 - m2 * m2
    c11, c12, c22 = m0 * m4 - m2 * m2, m1 * m2 - m0 * m3, m0 * m2 - m1 * m1
    slope = b0 * c01 + b1 * c11 + b2 * c12
    bend = b0 * c02 + b1 * c12 + b2 * c22
    determinant = m0 * c00 + m1 * c01 + m2 * c02
    if bend >= 0 or determinant <= 0:
        return 0.0, 0.0
    return -slope / (2 * bend), bend / determinant


@compiled
def fit_peaks(
    samples: Array, total: Array, plane: Array, z: Array, position: Array, confidence: Array, width: Array, top: Array
) -> None:
    """Sub-plane position, confidence (max - mean) / mean, half-value width and maximum of every pixel.

    Positions stay between the two neighbours of the peak plane; the width is 0 where the curve has none.
    """
    count = z.size
    offset = np.zeros(SAMPLES)
    value = np.zeros(SAMPLES)
    for i in range(total.size):
        k = plane[i]
        peak = float(samples[CENTRE, i])
        position[i], confidence[i], width[i], top[i] = z[k], 0, 0, peak
        if peak <= 0:
            continue
        confidence[i] = peak * count / total[i] - 1
        for s in range(SAMPLES):
            at = k + s - CENTRE
            known = 0 <= at < count
            offset[s] = z[at] - z[k] if known else 0.0
            value[s] = samples[s, i] / peak if known else 0.0
        shift, bend = vertex(offset, value)
        low, high = z[max(k - 1, 0)] - z[k], z[min(k + 1, count - 1)] - z[k]
        position[i] = z[k] + min(max(shift, min(low, high)), max(low, high))
        if bend < 0:
            width[i] = HALF_VALUE / np.sqrt(-bend)


@compiled
def explained(
    top: Array, position: Array, width: Array, offsets: Array, reach: float, share: float, out: Array
) -> None:
    """Mark what may be the blur of a stronger neighbour that is in focus elsewhere; arrays (height, width).

    An edge at ``d`` from its focus is spread over about ``reach`` × d / w pixels, w being the width of its focus curve;
    what is weaker there than ``share`` of the edge in focus cannot be told from that.

    Parameters
    ----------
    offsets : array (neighbours, 2) int
        Rows and columns to look at.
    out : array bool
    """
    height, columns = top.shape
    for i in range(height):
        for j in range(columns):
            out[i, j] = False
            for n in range(offsets.shape[0]):
                a, b = i + offsets[n, 0], j + offsets[n, 1]
                if not (0 <= a < height and 0 <= b < columns) or top[a, b] <= top[i, j] or width[a, b] <= 0:
                    continue
                ratio = abs(position[a, b] - position[i, j]) / width[a, b]
                distance = np.sqrt(offsets[n, 0] ** 2 + offsets[n, 1] ** 2)
                if ratio > 1 and distance <= reach * ratio and top[i, j] <= share * top[a, b]:
                    out[i, j] = True
                    break


HALF_VALUE = 2 * np.sqrt(np.sqrt(2.0) - 1)  # full width at half value of 1/(1 + x²)²


@compiled
def widen(coarse: Array, fine: Array) -> None:
    """Bilinear enlargement by two, bin centres kept where they are."""
    height, width = coarse.shape
    near, far = np.float32(0.75), np.float32(0.25)
    for i in range(fine.shape[0]):
        a = i // 2
        b = min(max(a + (i % 2) * 2 - 1, 0), height - 1)
        for j in range(fine.shape[1]):
            c = j // 2
            d = min(max(c + (j % 2) * 2 - 1, 0), width - 1)
            fine[i, j] = near * (near * coarse[a, c] + far * coarse[a, d]) + far * (
                near * coarse[b, c] + far * coarse[b, d]
            )


@compiled
def nearest_plane(position: Array, z: Array, plane: Array) -> None:
    """Index of the plane of ``z`` (monotone) nearest to every position; flat arrays."""
    for i in range(position.size):
        low, high = 0, z.size - 1
        while high - low > 1:
            middle = (low + high) // 2
            if (z[middle] <= position[i]) == (z[0] <= z[z.size - 1]):
                low = middle
            else:
                high = middle
        plane[i] = low if abs(z[low] - position[i]) <= abs(z[high] - position[i]) else high


@compiled
def blend(
    pixels: Array, position: Array, plane: Array, bounds: Array, k: int, z: float, reach: float, sums: Array
) -> None:
    """Add plane ``k`` at ``z`` to the weighted sums where the surface is nearer than ``reach``.

    The weight is (1 - (distance / reach)²)²; where no plane is that near, the nearest one counts alone.

    Parameters
    ----------
    pixels : array (pixels, bands)
    position, plane : array (pixels,)
        Where the surface is, and the number of the plane nearest to it.
    bounds : array (2, blocks)
        Between which z a block of `BLOCK` pixels takes from planes; spares looking at the others.
    sums : array (pixels, bands + 1) float32
        Weighted sum of every band, and the sum of the weights.
    """
    bands = pixels.shape[1]
    for block in range(bounds.shape[1]):
        if z < bounds[0, block] or z > bounds[1, block]:
            continue
        for i in range(block * BLOCK, min((block + 1) * BLOCK, position.size)):
            distance = abs(position[i] - z)
            if distance >= reach and plane[i] != k:
                continue
            ratio = distance / reach if distance < reach else 0.0
            w = np.float32((1 - ratio * ratio) * (1 - ratio * ratio))
            for b in range(bands):
                sums[i, b] += w * np.float32(pixels[i, b])
            sums[i, bands] += w


@compiled
def mean_of(sums: Array, out: Array) -> None:
    """Divide the weighted sums by their weights and round to the type of ``out``, (pixels, bands)."""
    bands = out.shape[1]
    for i in range(out.shape[0]):
        scale = np.float32(1) / sums[i, bands]
        for b in range(bands):
            out[i, b] = int(sums[i, b] * scale + np.float32(0.5))
