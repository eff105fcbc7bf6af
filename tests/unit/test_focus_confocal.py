"""Optical sections: brightest value, its plane, and how sure that is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from processing.focus import FocusSweep, focus_stack

SMALL_STACK = hnp.arrays(
    st.sampled_from([np.uint8, np.uint16]), st.tuples(st.integers(1, 9), st.integers(1, 7), st.integers(1, 7))
)


def glowing_surface(dtype: type, peak: float) -> tuple[np.ndarray, np.ndarray]:
    truth = np.add.outer(np.linspace(5, 12, 40), np.linspace(0, 3, 50))
    z = np.arange(24)[:, None, None]
    light = peak * np.exp(-0.5 * ((z - truth) / 2.0) ** 2)
    return np.rint(light).astype(dtype), truth


@given(SMALL_STACK)
@settings(max_examples=60, deadline=None)
def test_extended_focus_is_the_maximum_and_plane_the_first_that_has_it(stack):
    result = focus_stack(list(stack), method="confocal")
    np.testing.assert_array_equal(result.extended_focus, stack.max(axis=0))
    np.testing.assert_array_equal(result.plane, stack.argmax(axis=0))


@pytest.mark.parametrize(("dtype", "peak"), [(np.uint8, 240), (np.uint16, 50000)])
def test_brightest_position_between_planes(dtype, peak):
    stack, truth = glowing_surface(dtype, peak)
    found = focus_stack(list(stack), method="confocal").range
    assert np.abs(found - truth).max() < 0.12


def test_colour_is_taken_from_the_brightest_plane():
    stack, _ = glowing_surface(np.uint8, 200)
    dark = np.zeros_like(stack)
    colour = np.stack([dark, dark, stack], axis=-1)
    result = focus_stack(list(colour), method="confocal")
    np.testing.assert_array_equal(result.extended_focus, colour.max(axis=0))


def test_darkness_is_not_trusted():
    stack, _ = glowing_surface(np.uint16, 4000)
    noise = np.random.default_rng(3).normal(30, 8, stack.shape)
    stack[:, :, 25:] = 0
    seen = np.clip(stack + noise, 0, None).astype(np.uint16)
    result = focus_stack(list(seen), method="confocal")
    assert np.percentile(result.confidence[:, 26:], 99) < 0.8
    assert np.percentile(result.confidence[:, :24], 1) > 0.8


def test_state_is_small_at_sixteen_bit():
    sweep = FocusSweep((64, 64), method="confocal")
    sweep.add(np.zeros((64, 64), np.uint16))
    assert sweep.state_bytes_per_pixel <= 20
