"""Registration against movements made on purpose."""

import cv2
import numpy as np
import pytest

from processing.focus import focus_stack
from processing.registration import Placement, RegisteredPlanes, grey_pyramid, match, placements, typical_step


def specimen(side: int = 256) -> np.ndarray:
    rng = np.random.default_rng(5)
    grain = sum(a * cv2.GaussianBlur(rng.normal(size=(side, side)), (0, 0), a) for a in (1.5, 4.0, 12.0))
    return np.clip(120 + 25 * grain, 0, 255).astype(np.uint8)


def moved(image: np.ndarray, placement: Placement) -> np.ndarray:
    size = image.shape[1::-1]
    return cv2.warpAffine(
        image, placement.matrix(image.shape), size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def breathing_stack(planes: int = 7, scale: float = 0.99) -> list[np.ndarray]:
    """Focus sweeps from left to right while every plane shows a wider field than the one before."""
    sharp = specimen()
    columns = np.arange(sharp.shape[1])[None, :] / sharp.shape[1] * (planes - 1)
    stack = []
    for k in range(planes):
        weight = np.clip(np.abs(columns - k) - 0.5, 0, 1)
        seen = sharp * (1 - weight) + cv2.GaussianBlur(sharp, (0, 0), 2.5) * weight
        stack.append(moved(seen.astype(np.uint8), Placement(scale=scale**k)))
    return stack


@pytest.mark.parametrize("truth", [Placement(0.99, 0.01, -0.006), Placement(1.02, 0, 0), Placement(1.0, 0.02, 0.01)])
@pytest.mark.parametrize("blur", [0, 2.0])
def test_match_finds_scale_and_shift(truth, blur):
    first = specimen()
    second = moved(first, truth)
    if blur:
        second = cv2.GaussianBlur(second, (0, 0), blur)
    found = match(grey_pyramid(first), grey_pyramid(second))
    error = Placement(found.scale - truth.scale + 1, found.dx - truth.dx, found.dy - truth.dy)
    assert error.corner_shift() * 256 < 0.1


def test_placements_compose_and_invert():
    a, b = Placement(1.1, 0.2, -0.1), Placement(0.9, -0.05, 0.3)
    point = np.array([30.0, 70.0, 1.0])
    shape = (100, 100)
    step = np.append(a.matrix(shape) @ point, 1.0)
    np.testing.assert_allclose(a.then(b).matrix(shape) @ point, b.matrix(shape) @ step)
    np.testing.assert_allclose(a.then(a.inverse()).matrix(shape) @ point, point[:2], atol=1e-9)


def test_planes_come_to_rest_on_the_most_magnified():
    stack = breathing_stack()
    reference, places = placements(stack)
    assert reference == 0
    assert places[6].scale == pytest.approx(0.99**6, abs=5e-4)
    rest = RegisteredPlanes(stack, places)
    assert typical_step([rest[k] for k in range(len(rest))]) < 0.2


def test_breathing_is_noticed_and_said():
    result = focus_stack(breathing_stack())
    said = result.parameters["registration"]
    assert said["applied"]
    assert said["step_px"] > 1
    sharp = specimen().astype(float)
    error = (result.extended_focus - sharp)[8:-8, 8:-8]
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 30


def test_still_stack_is_left_alone():
    stack = breathing_stack(scale=1.0)
    left_alone, untouched = focus_stack(stack), focus_stack(stack, register=False)
    assert not left_alone.parameters["registration"]["applied"]
    np.testing.assert_array_equal(left_alone.range, untouched.range)


def test_planes_without_likeness_are_never_moved():
    noise = np.random.default_rng(2).integers(0, 255, (6, 64, 64)).astype(np.uint8)
    assert typical_step(noise) == 0
    assert typical_step(np.full((4, 64, 64), 9, np.uint8)) == 0
