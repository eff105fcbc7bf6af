"""Morphology against SciPy, and by what defines it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from processing import morphology
from processing.neighbours import ball, neighbours

RNG = np.random.default_rng(43)
CUT = (7, 9, 11)
KINDS = [(6, 0.0), (18, 0.0), (26, 0.0), (26, 2.3)]


def noise(dtype: str) -> np.ndarray:
    return (RNG.random(CUT) * {"uint8": 256, "float32": 1}[dtype]).astype(dtype)


def footprint(near) -> np.ndarray:
    reach = np.abs(near.offsets).max(axis=0)
    mask = np.zeros(2 * reach + 1, bool)
    mask[tuple((near.offsets + reach).T)] = True
    return mask


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
@pytest.mark.parametrize(("rule", "radius"), KINDS)
def test_each_equals_scipys(dtype: str, rule: int, radius: float) -> None:
    grey, mask = noise(dtype), footprint(ball(radius) if radius else neighbours(rule))
    how = {"footprint": mask, "mode": "nearest"}
    smallest, largest = ndimage.grey_erosion(grey, **how), ndimage.grey_dilation(grey, **how)
    opened, closed = ndimage.grey_dilation(smallest, **how), ndimage.grey_erosion(largest, **how)
    expected = {
        morphology.erode: smallest,
        morphology.dilate: largest,
        morphology.open_: opened,
        morphology.close: closed,
        morphology.gradient: largest - smallest,
        morphology.top_hat: grey - opened,
    }
    for function, truth in expected.items():
        np.testing.assert_array_equal(function(grey, rule=rule, radius=radius), truth)
    np.testing.assert_array_equal(morphology.top_hat(grey, rule=rule, radius=radius, dark=True), closed - grey)


@pytest.mark.parametrize("rule", [6, 18, 26])
def test_of_masks_it_is_binary_morphology(rule: int) -> None:
    mask = np.pad(RNG.random(CUT) > 0.3, 2)
    structure = ndimage.generate_binary_structure(3, {6: 1, 18: 2, 26: 3}[rule])
    for given in (mask, np.uint8(255) * mask):
        np.testing.assert_array_equal(
            morphology.erode(given, rule=rule) > 0, ndimage.binary_erosion(mask, structure, border_value=1)
        )
        np.testing.assert_array_equal(morphology.open_(given, rule=rule) > 0, ndimage.binary_opening(mask, structure))
        np.testing.assert_array_equal(morphology.dilate(given, rule=rule) > 0, ndimage.binary_dilation(mask, structure))


def test_a_ball_counts_distant_planes_less_and_rules_not_at_all() -> None:
    speck = np.zeros((9, 9, 9), np.uint8)
    speck[4, 4, 4] = 255
    grown = morphology.dilate(speck, (2.0, 1.0, 1.0), radius=3.0) > 0
    z, y, x = np.mgrid[-4:5, -4:5, -4:5]
    np.testing.assert_array_equal(grown, (2 * z) ** 2 + y**2 + x**2 <= 9)
    np.testing.assert_array_equal(np.flatnonzero((morphology.dilate(speck, (4.0, 1.0, 1.0)) > 0).any((1, 2))), [4])
