"""Range and extended focus against surfaces whose truth is known by construction."""

import cv2
import numpy as np
import pytest

from devices.errors import InputError
from processing.focus import FocusSweep, focus_stack
from processing.focus_kernels import gradient_energy

SHAPE = (96, 128)
PLANES = 24


def texture(seed: int = 1, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    return np.clip(110 + 60 * cv2.GaussianBlur(grain, (0, 0), 0.8) / 0.35, 0, 255)


def tilted_stack(z: np.ndarray, *, scale: float = 1.0, dtype: type = np.uint8) -> tuple[list[np.ndarray], np.ndarray]:
    """Planes of a slope from 8 to 16 along x: columns blurred by their distance from focus."""
    sharp = texture()
    truth = np.broadcast_to(np.linspace(8, 16, SHAPE[1], dtype=np.float32), SHAPE)
    radii = np.arange(0.3, 12, 0.1)
    blurred = np.stack([cv2.GaussianBlur(sharp, (0, 0), r) for r in radii])
    planes = []
    for position in z:
        radius = np.sqrt(0.4**2 + (0.45 * (truth - position)) ** 2)
        index = np.rint((radius - radii[0]) / 0.1).astype(int)
        planes.append(np.rint(scale * np.take_along_axis(blurred, index[None], 0)[0]).astype(dtype))
    return planes, truth


def range_error(z: np.ndarray, **options: object) -> float:
    planes, truth = tilted_stack(z, **options)  # type: ignore[arg-type]
    found = focus_stack(planes, z_um=z).range
    return float(np.sqrt(np.mean((found - truth)[8:-8, 8:-8] ** 2)))


def test_slope_is_measured_between_planes():
    planes, truth = tilted_stack(np.arange(PLANES))
    result = focus_stack(planes)
    assert result.unit == "plane"
    error = (result.range - truth)[8:-8, 8:-8]
    assert np.sqrt(np.mean(error**2)) < 0.12
    assert abs(error.mean()) < 0.03


def test_sixteen_bit_measures_like_eight():
    assert range_error(np.arange(PLANES), scale=200, dtype=np.uint16) < 0.12


def test_falling_positions():
    assert range_error(np.arange(PLANES, dtype=float)[::-1]) < 0.12


def test_uneven_positions_are_honoured():
    z = np.cumsum(np.tile([0.6, 1.4, 1.0], 8)) - 0.6
    assert range_error(z) < 0.2


def test_streamed_and_batch_agree_bit_for_bit():
    planes, _ = tilted_stack(np.arange(PLANES))
    sweep = FocusSweep(SHAPE)
    for plane in planes:
        sweep.add(plane)
        sweep.preview()
    result = focus_stack(planes)
    image = sweep.finish()
    np.testing.assert_array_equal(image.range_, result.range)
    np.testing.assert_array_equal(image.confidence, result.confidence)
    np.testing.assert_array_equal(image.plane, result.plane)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_planes_say_that_nothing_is_known(count):
    planes, _ = tilted_stack(np.arange(10, 10 + count))
    result = focus_stack(planes, z_um=np.array([5.0, 7.0])[:count])
    assert not result.confidence.any()
    assert set(np.unique(result.range)) <= {5.0, 7.0}
    if count == 1:
        np.testing.assert_array_equal(result.extended_focus, planes[0])


def test_state_is_small():
    sweep = FocusSweep((512, 512))
    sweep.add(np.zeros((512, 512), np.uint8))
    assert sweep.state_bytes_per_pixel <= 20


@pytest.mark.parametrize("z", [[0, 1, np.nan], [0, 1, np.inf], [0, 1, 1], [0, 2, 1], [0, 1]])
def test_senseless_positions_are_refused(z):
    with pytest.raises(InputError):
        focus_stack([np.zeros((8, 8), np.uint8)] * 3, z_um=np.array(z))


@pytest.mark.parametrize(
    "planes",
    [
        [],
        [np.zeros((8, 8), np.uint8), np.zeros((8, 9), np.uint8)],
        [np.zeros((8, 8), np.float32)],
        [np.zeros((8, 8, 2), np.uint8)],
    ],
)
def test_unusable_planes_are_refused(planes):
    with pytest.raises(InputError):
        focus_stack(planes)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 5), (31, 40, 3)])
@pytest.mark.parametrize("register", [True, "auto", False])
def test_tiny_planes_are_measured_without_registration(shape, register):
    planes = [np.full(shape, 10 * k, np.uint8) for k in range(4)]
    result = focus_stack(planes, register=register)
    assert result.extended_focus.shape == shape
    assert not result.parameters["registration"]["applied"]
    assert np.isfinite(result.range).all()


def test_surface_outside_the_stack_is_flagged():
    planes, truth = tilted_stack(np.arange(12, PLANES))
    sweep = FocusSweep(SHAPE)
    for plane in planes:
        sweep.add(plane)
    image = sweep.finish()
    assert image.edge[:, :40].mean() > 0.95  # there the surface lies below the first plane
    assert not image.edge[:, 100:].any()
    assert truth[0, 40] < 12 < truth[0, 100]


def test_planes_that_cannot_be_written_need_no_other_kernels():
    planes, _ = tilted_stack(np.arange(PLANES))
    focus_stack(planes)
    compiled = len(gradient_energy.signatures)  # type: ignore[attr-defined]
    for plane in planes:
        plane.setflags(write=False)
    focus_stack(planes)
    assert len(gradient_energy.signatures) == compiled  # type: ignore[attr-defined]
