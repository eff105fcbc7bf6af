"""Transparent specimens, first over a threshold, one band, any viewing direction, haloes: against known truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from devices.errors import InputError
from processing.focus import FocusSweep, focus_stack
from processing.focus_pyramid import NOISE_SHARE, SoftPyramid, laplacian_pyramid
from processing.focus_view import View, ViewedPlanes
from processing.focus_windows import Fit, guarded


def blurred(image: np.ndarray, distance: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), np.hypot(0.5, 0.8 * distance)) if distance else image


def hairs_over_leg(planes: int = 11) -> tuple[list[np.ndarray], np.ndarray]:
    """A dark smooth leg in plane 2 and bright hairs in plane 8 in front of it, both seen through each other."""
    y, x = np.mgrid[0:128, 0:160].astype(np.float32)
    leg = np.where(np.hypot((x - 70) / 50, (y - 64) / 28) < 1, 0.4, 1).astype(np.float32)
    hairs = np.where(np.abs((x + y) % 40 - 20) < 1.5, 0.5, 1).astype(np.float32)
    shot = np.random.default_rng(4)
    stack = [
        np.clip(np.rint(200 * blurred(leg, k - 2) * blurred(hairs, k - 8) + shot.normal(size=leg.shape)), 0, 255)
        for k in range(planes)
    ]
    return [p.astype(np.uint8) for p in stack], 200 * leg * hairs


def psnr(found: np.ndarray, truth: np.ndarray) -> float:
    return float(20 * np.log10(255 / np.sqrt(np.mean((found.astype(float) - truth)[8:-8, 8:-8] ** 2))))


def test_transparent_specimens_keep_what_is_sharp_in_front_and_behind():
    planes, truth = hairs_over_leg()
    soft = psnr(focus_stack(planes, method="transparent").extended_focus, truth)
    opaque = psnr(focus_stack(planes, method="brightfield").extended_focus, truth)
    best = max(psnr(p, truth) for p in planes)
    assert soft > 24
    assert soft > best + 2
    assert soft > opaque


@pytest.mark.parametrize(("dtype", "bands"), [(np.uint8, ()), (np.uint16, ()), (np.uint8, (3,)), (np.uint16, (3,))])
def test_soft_pyramid_in_every_type_streams_like_it_batches(dtype: type, bands: tuple[int, ...]):
    grey, _ = hairs_over_leg()
    scale = 1 if dtype is np.uint8 else 257
    planes = [(p.astype(dtype) * dtype(scale)) for p in grey]
    planes = [np.stack([p] * 3, -1) if bands else p for p in planes]
    sweep = FocusSweep((128, 160), method="transparent")
    for plane in planes:
        sweep.add(plane)
        sweep.preview()
    streamed = sweep.compose([], sweep.finish(), unit="plane")
    batch = focus_stack(planes, method="transparent", register=False)
    assert batch.extended_focus.dtype == dtype
    np.testing.assert_array_equal(streamed.extended_focus, batch.extended_focus)
    np.testing.assert_array_equal(streamed.range, batch.range)
    reference = focus_stack(grey, method="transparent", register=False).extended_focus
    grey_found = batch.extended_focus[..., 0] if bands else batch.extended_focus
    assert np.abs(grey_found / scale - reference).mean() < 0.6


def test_a_pyramid_of_equal_planes_is_the_plane():
    plane = np.random.default_rng(0).integers(0, 256, (61, 83), dtype=np.uint8)
    pyramid = SoftPyramid(plane.shape)
    for _ in range(3):
        pyramid.add(plane, 1.0)
    assert np.abs(pyramid.picture().astype(int) - plane).max() <= 1


def test_levels_hold_the_share_of_noise_that_is_counted_on():
    noise = np.random.default_rng(1).normal(size=(768, 768)).astype(np.float32)
    found = [float(level.var()) for level in laplacian_pyramid(noise)[: len(NOISE_SHARE)]]
    np.testing.assert_allclose(found[:4], NOISE_SHARE[:4], rtol=0.1)
    np.testing.assert_allclose(found[4:], NOISE_SHARE[4:], rtol=0.5)


def slow_first_above(stack: np.ndarray, threshold: float, z: np.ndarray) -> np.ndarray:
    found = np.full(stack.shape[1:], np.nan)
    for row, column in np.ndindex(found.shape):
        curve = stack[:, row, column].astype(float)
        over = np.flatnonzero(curve >= threshold)
        if over.size:
            k = over[0]
            share = 0 if k == 0 else (curve[k] - threshold) / (curve[k] - curve[k - 1])
            found[row, column] = z[k] - share * (z[k] - z[k - 1] if k else 0)
    return found


@pytest.mark.parametrize("z", [np.arange(9.0), np.arange(9.0)[::-1], np.cumsum([1, 2, 1, 3, 1, 1, 2, 1, 1.0])])
def test_first_above_threshold_equals_the_definition(z: np.ndarray):
    stack = np.random.default_rng(2).integers(0, 200, (9, 20, 30)).astype(np.uint8)
    result = focus_stack(list(stack), z_um=z, method="threshold", threshold=150)
    np.testing.assert_allclose(result.range, slow_first_above(stack, 150, z), rtol=1e-5)
    unknown = np.isnan(result.range)
    assert unknown.any()
    assert not result.confidence[unknown].any()


def test_a_threshold_belongs_to_its_method():
    planes = [np.zeros((8, 8), np.uint8)] * 3
    with pytest.raises(InputError, match="needs a threshold"):
        focus_stack(planes, method="threshold")
    with pytest.raises(InputError, match="knows no threshold"):
        focus_stack(planes, threshold=3)


def test_one_band_decides():
    stack = np.zeros((5, 16, 16, 3), np.uint8)
    stack[1, ..., 0], stack[3, ..., 2] = 200, 100
    assert (focus_stack(list(stack), method="confocal", band=0).plane == 1).all()
    assert (focus_stack(list(stack), method="confocal", band=2).plane == 3).all()


def ball(radius: float = 14.0, step: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A ball that is brightest in its middle, in voxels twice as deep as wide."""
    z = np.arange(-20, 20.1, step)
    y, x = np.mgrid[-24:25, -24:25]
    r = np.sqrt(x**2 + y**2 + z[:, np.newaxis, np.newaxis] ** 2)
    return np.clip(200 - 100 * r / radius, 0, 255).astype(np.uint8), z


@pytest.mark.parametrize(("azimuth", "tilt"), [(0, 0), (0, 35), (90, 60), (200, 120), (30, 180)])
def test_a_ball_looks_the_same_from_everywhere(azimuth: float, tilt: float):
    volume, z = ball()
    planes = ViewedPlanes(list(volume), z, 1.0, View(azimuth, tilt))
    brightest = focus_stack(planes, z_um=planes.depth, method="confocal")
    first = focus_stack(planes, z_um=planes.depth, method="threshold", threshold=100)
    height, width = planes.shape
    y, x = np.mgrid[0:height, 0:width]
    off = np.hypot(y - (height - 1) / 2, x - (width - 1) / 2)
    assert np.abs(brightest.range[off < 6]).max() < 1.0
    surface = -np.sqrt(np.maximum(14.0**2 - off**2, 0))
    assert np.abs((first.range - surface)[off < 11]).max() < 0.8
    assert np.isnan(first.range[off > 16]).all()


def test_axes_are_a_rotation_towards_the_azimuth():
    axes = View(30, 40).axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(
        axes[2], [np.sin(0.698132) * 0.866025, np.sin(0.698132) * 0.5, np.cos(0.698132)], atol=1e-5
    )
    np.testing.assert_allclose(View(123, 0).axes(), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("angle", [np.nan, np.inf])
def test_senseless_views_are_refused(angle: float):
    with pytest.raises(InputError):
        View(angle, 0)
    with pytest.raises(InputError, match="no sides"):
        ViewedPlanes([np.zeros((4, 4), np.uint8)], None, None, View(0, 10))


def test_weak_peaks_elsewhere_beside_a_strong_edge_are_not_believed():
    shape = (48, 64)
    fit = Fit(*(np.full(shape, v, np.float32) for v in (10.0, 2.0, 1.5, 50.0)))
    fit.position[:, 30:34], fit.top[:, 30:34] = 3.0, 400.0  # the edge, in focus seven planes away
    fit.position[:, 50:] = 3.0  # weak, but in the edge's own plane
    told = guarded(fit).confidence
    assert (told[4:-4, 31:33] == 2).all()
    assert not told[4:-4, 22:28].any()
    assert not told[4:-4, 36:42].any()
    assert (told[4:-4, :4] == 2).all()  # too far for its blur
    assert (told[4:-4, 52:] == 2).all()
