"""Thresholds, labels, holes and distances against SciPy, scikit-image and what can be said in advance."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tifffile
from scipy import ndimage
from skimage import filters

from devices.cli import run
from devices.errors import InputError
from processing import thresholds
from processing.distance import distance
from processing.labels import components
from processing.masks import as_mask, fill_holes, threshold

RNG = np.random.default_rng(12)
CUT = (9, 14, 17)
BLOBS = ndimage.gaussian_filter(RNG.normal(size=CUT), 1.0)
TWO_PEAKS = np.clip(np.where(BLOBS > 0.1, 150, 60) + RNG.normal(0, 12, CUT), 0, 255).astype(np.uint8)


def ball(radius: float, side: int) -> np.ndarray:
    middle = (side - 1) / 2
    return sum((axis - middle) ** 2 for axis in np.mgrid[:side, :side, :side]) <= radius**2


@pytest.mark.parametrize("method", sorted(thresholds.METHODS))
@pytest.mark.parametrize("grey", [TWO_PEAKS, TWO_PEAKS.astype(np.uint16) + 1000], ids=["uint8", "uint16"])
def test_thresholds_equal_scikit_images(method: str, grey: np.ndarray) -> None:
    mask, level = threshold(grey, method=method)
    expected = getattr(filters, f"threshold_{method}")(grey)
    np.testing.assert_array_equal(mask > 0, grey > expected)
    assert level == pytest.approx(expected, abs=0.51)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_threshold_of_real_numbers_parts_two_peaks(dtype: type) -> None:
    grey = np.where(BLOBS > 0.1, 3.0, -1.0).astype(dtype) + RNG.normal(0, 0.2, CUT).astype(dtype)
    for method in ("otsu", "li", "isodata", "mean"):
        assert -0.5 < threshold(grey, method=method)[1] < 2.5


def test_a_given_threshold_a_band_and_its_reverse() -> None:
    grey = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    np.testing.assert_array_equal(threshold(grey, above=5)[0] > 0, grey > 5)
    band = threshold(grey, above=5, up_to=9)[0]
    np.testing.assert_array_equal(grey[band > 0], [6, 7, 8, 9])
    np.testing.assert_array_equal(threshold(grey, above=5, up_to=9, dark=True)[0], 255 - band)


@pytest.mark.parametrize("rule", [6, 18, 26])
@pytest.mark.parametrize("make", [lambda b: b, lambda b: np.uint8(255) * b, lambda b: b.astype(np.float32)])
def test_labels_equal_scipys_number_by_number(rule: int, make) -> None:
    mask = BLOBS > 0.15
    expected, count = ndimage.label(mask, ndimage.generate_binary_structure(3, {6: 1, 18: 2, 26: 3}[rule]))
    labels, found = components(make(mask), rule=rule)
    np.testing.assert_array_equal(labels, expected)
    assert (found, labels.dtype) == (count, np.uint32)
    large, kept = components(make(mask), rule=rule, least=5)
    sizes = np.bincount(expected.ravel())[1:]
    assert kept == (sizes >= 5).sum() == large.max()
    np.testing.assert_array_equal(np.bincount(large.ravel())[1:], sizes[sizes >= 5])


def test_labels_by_value_part_what_touches() -> None:
    values = np.zeros((1, 1, 7), np.uint16)
    values[0, 0] = [3, 3, 9, 9, 0, 3, 40000]
    np.testing.assert_array_equal(components(values, by_value=True)[0][0, 0], [1, 1, 2, 2, 0, 3, 4])


def test_more_parts_than_sixteen_bits_hold_stay_apart() -> None:
    mask = np.zeros((64, 128, 128), bool)
    mask[::2, ::2, ::2] = True
    labels, count = components(mask)
    assert count == 32 * 64 * 64 == labels.max()
    assert np.unique(labels[mask]).size == count


@pytest.mark.parametrize("spacing_um", [(1.0, 1.0, 1.0), (2.5, 0.3, 0.7), (1.0, 100.0, 0.01)])
def test_distances_equal_scipys_at_any_spacing(spacing_um: tuple[float, float, float]) -> None:
    mask = BLOBS > -0.3
    expected = ndimage.distance_transform_edt(mask, sampling=spacing_um)
    np.testing.assert_allclose(distance(mask, spacing_um), expected, rtol=2e-7)
    signed = distance(mask, spacing_um, signed=True)
    np.testing.assert_array_equal(signed > 0, mask)
    np.testing.assert_array_equal(-np.minimum(signed, 0), distance(mask, spacing_um, outside=True))


def test_distances_of_thick_and_of_endless_masks_equal_scipys() -> None:
    thick = np.ones((3, 70, 300), bool)  # rows without an end, and more voxels than are lowered together
    thick[1, 40, 20] = thick[2, 3, 290] = False
    thin = thick.copy()
    thin[:, :, ::17] = False
    for mask in (thick, thin):
        expected = ndimage.distance_transform_edt(mask, sampling=(2.0, 1.0, 0.5))
        np.testing.assert_allclose(distance(mask, (2.0, 1.0, 0.5)), expected, rtol=2e-7)


def test_holes_are_filled_and_bays_stay_open() -> None:
    shell = ball(6, 15) & ~ball(3, 15)
    np.testing.assert_array_equal(fill_holes(shell) > 0, ball(6, 15))
    pipe = np.ones((5, 5, 5), bool)
    pipe[:, 2, 2] = False
    np.testing.assert_array_equal(fill_holes(pipe) > 0, pipe)
    assert fill_holes(pipe, by_plane=True).all()
    np.testing.assert_array_equal(fill_holes(BLOBS > 0) > 0, ndimage.binary_fill_holes(BLOBS > 0))


def test_empty_full_and_one_voxel_masks() -> None:
    empty, full = np.zeros(CUT, bool), np.ones(CUT, bool)
    assert components(empty)[1] == 0
    assert components(full)[1] == 1
    assert not fill_holes(empty).any()
    assert not distance(empty).any()
    speck = empty.copy()
    speck[0, 0, 0] = True
    assert components(speck)[1] == 1
    assert distance(speck)[0, 0, 0] == 1


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (lambda: components(TWO_PEAKS), "mask-needed"),
        (lambda: components(TWO_PEAKS.astype(np.uint16) + 300), "mask-needed"),
        (lambda: fill_holes(np.array([[[0, 7, 255]]], np.uint8)), "mask-needed"),
        (lambda: distance(np.full(CUT, np.nan)), "volume-nan"),
        (lambda: distance(np.ones(CUT, bool)), "mask-full"),
        (lambda: distance(np.zeros(CUT, bool), outside=True), "mask-full"),
        (lambda: distance(BLOBS > 0, (1.0, 0.0, 1.0)), "spacing"),
        (lambda: components(BLOBS > 0, rule=8), "neighbours"),
        (lambda: components(BLOBS, by_value=True), "labels-needed"),
        (lambda: components(np.array([[[-1, 2]]]), by_value=True), "labels-needed"),
        (lambda: components(np.array([[[1, 1 << 40]]]), by_value=True), "labels-needed"),
        (lambda: components(np.ones((2, 2), bool)), "volume-shape"),
        (lambda: threshold(np.full(CUT, 7, np.uint8)), "threshold"),
        (lambda: threshold(np.where(BLOBS > 0, 9, 8).astype(np.uint8), method="minimum"), "threshold"),
        (lambda: threshold(TWO_PEAKS, method="ostu"), "operator-params"),
    ],
)
def test_what_is_no_mask_or_no_grey_volume_is_refused_in_words(wrong, code: str) -> None:
    with pytest.raises(InputError) as refused:
        wrong()
    assert refused.value.code == code


@pytest.mark.parametrize("value", [1, 7, 255, 65535])
def test_any_single_value_inside_makes_a_mask(value: int) -> None:
    inside = BLOBS > 0
    np.testing.assert_array_equal(as_mask(inside * np.uint16(value)), inside)
    assert as_mask(np.full(CUT, value, np.uint16)).all()


def test_the_command_goes_from_grey_to_labels(tmp_path, capsys) -> None:
    np.save(tmp_path / "grey.npy", TWO_PEAKS)
    words = ["mask.threshold:method=otsu", str(tmp_path / "grey.npy"), "-o", str(tmp_path / "out"), "--json"]
    assert run(["process", "volume", *words, "--then", "label.components:rule=6"]) == 0
    report = json.loads(capsys.readouterr().out)
    expected, count = components(threshold(TWO_PEAKS)[0], rule=6)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / "volume.ome.tif"), expected)
    assert report["values"]["count"] == count
    assert report["values"]["threshold"] == threshold(TWO_PEAKS)[1]
