"""Arithmetic, ratios, components and boundaries of bands, against numpy and what can be said in advance."""

from __future__ import annotations

import numpy as np
import pytest

from devices.errors import InputError
from processing import volume_filters as filters
from processing.bands import boundaries, calculate, largest_eigenvalue, principal, ratio

RNG = np.random.default_rng(46)
BANDS = RNG.integers(0, 200, (3, 4, 6, 7)).astype(np.uint16)
B0, B1, B2 = BANDS.astype(np.float64)


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("b0 + 2*b1 - b2/4", B0 + 2 * B1 - B2 / 4),
        ("-(b0 - b1)**2 / 3", -((B0 - B1) ** 2) / 3),
        ("max(b0, min(b1, 50)) + sqrt(abs(b2 - 100))", np.maximum(B0, np.minimum(B1, 50)) + np.sqrt(abs(B2 - 100))),
        ("7", np.full(B0.shape, 7.0)),
    ],
)
def test_a_formula_is_what_it_says(formula: str, expected: np.ndarray) -> None:
    np.testing.assert_allclose(calculate(BANDS, formula=formula), expected, rtol=1e-5)


def test_where_a_formula_has_no_value_the_filling_stands() -> None:
    found = calculate(BANDS, formula="log(b0 - 100)", fill=-1)
    np.testing.assert_array_equal(found[B0 <= 100], -1)
    np.testing.assert_allclose(found[B0 > 100], np.log(B0[B0 > 100] - 100), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("formula", ["b3", "b0 +", "__import__('os')", "b0.real", "b0 if b1 else b2", "max(b0)", "'a'"])
def test_what_is_no_formula_is_refused(formula: str) -> None:
    with pytest.raises(InputError) as refused:
        calculate(BANDS, formula=formula)
    assert refused.value.code == "operator-params"


def test_a_ratio_leaves_out_what_is_too_weak() -> None:
    found = ratio(BANDS, over=2, under=0, background=(10.0, 20.0), least=30)
    strong = B0 - 20 >= 30
    np.testing.assert_allclose(found, np.where(strong, (B2 - 10) / np.where(strong, B0 - 20, 1), 0), rtol=1e-6)


def test_principal_components_equal_numpys() -> None:
    mixed = np.array([B0, 0.5 * B0 + 3, B1 / 4]).astype(np.float32)
    flat = mixed.reshape(3, -1).astype(np.float64)
    shares = np.linalg.svd(flat - flat.mean(1, keepdims=True), compute_uv=False) ** 2
    for k in (0, 1):
        volume, share = principal(mixed, component=k)
        assert share == pytest.approx(shares[k] / shares.sum())
        assert volume.var(dtype=np.float64) == pytest.approx(shares[k] / flat.shape[1], rel=1e-4)
    assert principal(mixed)[0].ravel() @ (B0 - B0.mean()).ravel() > 0


def test_boundaries_of_one_band_are_its_gradient() -> None:
    spacing = (1.0, 0.5, 0.5)
    np.testing.assert_allclose(boundaries(BANDS[:1], spacing), filters.sobel(BANDS[0], spacing), rtol=1e-4, atol=1e-3)


def test_steps_that_cancel_in_the_sum_are_boundaries_all_the_same() -> None:
    step = np.where(np.arange(10) < 5, 50, 150) * np.ones((4, 6, 1), int)
    bands = np.array([step, 200 - step]).astype(np.uint8)
    assert not filters.sobel(bands.sum(0)).any()
    single = filters.sobel(bands[0])
    np.testing.assert_allclose(boundaries(bands), 2**0.5 * single, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(boundaries(bands, weights=(3.0, 4.0)), 5 * single, rtol=1e-4, atol=1e-4)


def test_eigenvalues_equal_numpys() -> None:
    half = RNG.normal(size=(3, 3, 200))
    full = np.einsum("ikn,jkn->nij", half, half)
    tensor = np.array([full[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], np.float32)
    np.testing.assert_allclose(largest_eigenvalue(tensor), np.linalg.eigvalsh(full)[:, 2], rtol=1e-4)
    assert not largest_eigenvalue(np.zeros((6, 2), np.float32)).any()


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (lambda: principal(BANDS[:1]), "bands"),
        (lambda: principal(BANDS, component=3), "bands"),
        (lambda: calculate(BANDS[0], formula="b0"), "bands"),
        (lambda: ratio(BANDS, under=3), "bands"),
        (lambda: ratio(BANDS, background=(1.0,)), "operator-params"),
        (lambda: ratio(BANDS, least=0), "operator-params"),
        (lambda: boundaries(BANDS, weights=(1.0,)), "operator-params"),
        (lambda: calculate(np.full((1, 2, 2, 2), np.nan), formula="b0"), "volume-nan"),
    ],
)
def test_wrong_bands_are_told(wrong, code: str) -> None:
    with pytest.raises(InputError) as refused:
        wrong()
    assert refused.value.code == code
