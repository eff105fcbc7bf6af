"""Watershed against scikit-image's, and on balls whose places are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from skimage.segmentation import watershed

from devices.errors import InputError
from processing.distance import distance
from processing.watershed import flood_downhill, split, summits_of

RNG = np.random.default_rng(44)
BLOBS = ndimage.gaussian_filter(RNG.normal(size=(24, 30, 36)), 2.0) > 0.0
HEIGHTS = np.rint(16 * distance(BLOBS)).astype(np.uint16)
REACH = {6: 1, 18: 2, 26: 3}


def structure(rule: int) -> np.ndarray:
    return ndimage.generate_binary_structure(3, REACH[rule])


@pytest.mark.parametrize("rule", REACH)
def test_floods_as_scikit_image_does(rule: int) -> None:
    markers = summits_of(HEIGHTS, rule, 16)
    expected = watershed(-HEIGHTS.astype(np.int32), markers, connectivity=structure(rule), mask=HEIGHTS > 0)
    assert (flood_downhill(HEIGHTS, markers, rule) == expected).mean() >= 0.9999


def summits_by_definition(heights: np.ndarray, rule: int, depth: int) -> int:
    """Islands above each level, followed as water falls: a summit dies where its island meets a higher one."""
    kept, before = 0, np.zeros(heights.shape, int)
    peaks: dict[int, int] = {}
    for level in range(int(heights.max()), 0, -1):
        islands, count = ndimage.label(heights >= level, structure(rule))
        now: dict[int, int] = {}
        for island in range(1, count + 1):
            met = sorted(peaks[i] for i in np.unique(before[islands == island]) if i)
            kept += sum(peak - level >= depth for peak in met[:-1])
            now[island] = met[-1] if met else level
        before, peaks = islands, now
    return kept + len(peaks)


@pytest.mark.parametrize("rule", REACH)
@pytest.mark.parametrize("depth", [1, 5, 20])
def test_summits_are_those_of_the_definition(rule: int, depth: int) -> None:
    heights = ndimage.gaussian_filter(RNG.random((8, 9, 10)), 0.8)
    heights = np.rint(40 * (heights - heights.min()) / np.ptp(heights)).astype(np.uint16)
    marks = summits_of(heights, rule, depth)
    assert marks.max() == np.count_nonzero(marks) == summits_by_definition(heights, rule, depth)


def two_balls(spacing_um: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Two balls of 4 and 5 µm that overlap by 1 µm along x, and where the smaller one is."""
    z, y, x = (np.arange(round(n / s)) * s for n, s in zip((12, 12, 22), spacing_um, strict=True))
    across = (z[:, None, None] - 6) ** 2 + (y[:, None] - 6) ** 2
    left, right = across + (x - 5.5) ** 2 <= 16, across + (x - 13.5) ** 2 <= 25
    return left | right, np.broadcast_to(x < 9.3, left.shape) & left


@pytest.mark.parametrize("spacing_um", [(0.5, 0.5, 0.5), (1.0, 0.4, 0.4), (2.0, 0.5, 0.5)])
@pytest.mark.parametrize("rule", REACH)
def test_two_touching_balls_are_parted_at_their_neck(spacing_um: tuple[float, float, float], rule: int) -> None:
    mask, left = two_balls(spacing_um)
    labels, count = split(mask, spacing_um, rule=rule)
    assert count == 2
    np.testing.assert_array_equal(labels > 0, mask)
    assert (labels == labels[left][0])[mask].mean() == pytest.approx(left[mask].mean(), abs=0.02)
    assert split(mask, spacing_um, rule=rule, depth_px=30)[1] == 1


def test_empty_full_and_one_voxel_masks() -> None:
    empty = np.zeros((4, 5, 6), bool)
    assert split(empty)[1] == 0
    speck = empty.copy()
    speck[0, 0, 0] = True
    np.testing.assert_array_equal(split(speck)[0], speck)
    with pytest.raises(InputError, match="fills the whole volume"):
        split(~empty)
