"""A second kind of data: relief seen through a pillbox defocus, with camera noise, faint patches, colour, 16 bit."""

from functools import cache

import cv2
import numpy as np
import pytest

from processing.focus import focus_stack, plane_noise

SIDE = 160
PLANES = 26
PSF_PX = 0.7
CONE_PX = 0.75  # blur radius gained per plane away from focus
NOISE = 2.2


def pillbox(radius: float) -> np.ndarray:
    reach = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1)
    return disc / disc.sum()


def albedo(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    grain = sum(a * cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), a) for a in (0.8, 2.0, 6.0))
    contrast = np.ones((SIDE, SIDE))
    contrast[40:70, 100:130] = 0.06
    return 115 + 26 * grain * cv2.GaussianBlur(contrast, (0, 0), 1)


def relief() -> np.ndarray:
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    hills = 12 + 5 * np.sin(5 * x) * np.cos(4 * y) + 4 * x
    return np.where((x < 0.35) & (y > 0.6), hills - 4, hills)


@cache
def clean_stack(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planes (float64), truth of the range, and the picture in focus everywhere."""
    z, surface = relief(), albedo(seed)
    layers = np.rint(z * 4) / 4
    planes = []
    for k in range(PLANES):
        light, cover = np.zeros_like(surface), np.zeros_like(surface)
        for distance in np.unique(np.abs(layers - k)):
            layer = np.abs(layers - k) == distance
            kernel = pillbox(CONE_PX * distance)
            light += cv2.filter2D(surface * layer, -1, kernel, borderType=cv2.BORDER_REFLECT)
            cover += cv2.filter2D(layer.astype(float), -1, kernel, borderType=cv2.BORDER_REFLECT)
        planes.append(cv2.GaussianBlur(light / np.maximum(cover, 1e-9), (0, 0), PSF_PX))
    return np.array(planes), z, cv2.GaussianBlur(surface, (0, 0), PSF_PX)


def seen(planes: np.ndarray, *, noise: float = NOISE, scale: float = 1.0, dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(7)
    light = scale * (planes + rng.normal(0, noise, planes.shape))
    return np.clip(np.rint(light), 0, np.iinfo(dtype).max).astype(dtype)


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize(("scale", "dtype"), [(1.0, np.uint8), (200.0, np.uint16)])
def test_one_per_cent_noise(scale, dtype):
    planes, z, sharp = clean_stack()
    result = focus_stack(seen(planes, scale=scale, dtype=dtype))
    psnr = 20 * np.log10(255 / rms(result.extended_focus / scale - sharp))
    assert psnr > 41
    assert rms(result.range - z) < 0.7
    assert np.median(np.abs(result.range - z)) < 0.12
    assert result.noise == pytest.approx(NOISE * scale, rel=0.15)


def test_flickering_lamp_does_not_move_the_range():
    planes, z, _ = clean_stack()
    flicker = 1 + 0.05 * np.random.default_rng(2).normal(size=(PLANES, 1, 1))
    steady, flickering = (focus_stack(seen(p, scale=100.0, dtype=np.uint16)) for p in (planes, planes * flicker))
    assert rms(flickering.range - z) < 1.1 * rms(steady.range - z)
    assert np.median(np.abs(flickering.range - z)) < 0.12


def test_averaging_beats_the_best_single_plane():
    planes, _, sharp = clean_stack()
    stack = seen(planes)
    result = focus_stack(stack)
    nearest = np.take_along_axis(stack, np.rint(relief()).astype(int)[None], 0)[0]
    assert rms(result.extended_focus - sharp) < 0.75 * rms(nearest - sharp)


def test_three_per_cent_noise():
    planes, z, _ = clean_stack()
    assert rms(focus_stack(seen(planes, noise=7.0)).range - z) < 1.1


def test_low_contrast():
    planes, z, _ = clean_stack()
    faint = 115 + 0.25 * (planes - 115)
    assert rms(focus_stack(seen(faint)).range - z) < 1.1


def test_colour_measures_like_grey():
    planes, z, _ = clean_stack()
    red_only = seen(planes)
    stack = np.stack([red_only, np.full_like(red_only, 40), np.full_like(red_only, 40)], axis=-1)
    result = focus_stack(stack)
    assert result.extended_focus.shape == (SIDE, SIDE, 3)
    assert rms(result.range - z) < 0.7


def test_coarse_planes_are_not_averaged():
    planes, _, _ = clean_stack()
    assert focus_stack(seen(planes[::6])).parameters["gather_reach"] == 0
    assert focus_stack(seen(planes)).parameters["gather_reach"] > 1


def test_featureless_stack_claims_nothing():
    flat = seen(np.full((12, 64, 64), 120.0))
    result = focus_stack(flat)
    assert result.share_confident < 0.02
    assert np.isfinite(result.range).all()
    assert not focus_stack(np.full((5, 64, 64), 9, np.uint8)).confidence.any()


@pytest.mark.parametrize("method", ["brightfield", "confocal"])
@pytest.mark.parametrize("mean", [0.0, 100.0])
def test_noise_alone_is_sure_nowhere(method, mean):
    light = np.random.default_rng(11).normal(mean, 3, (120, 96, 96))
    result = focus_stack(list(np.clip(np.rint(light), 0, 255).astype(np.uint8)), method=method)
    assert result.share_confident < 0.02


def test_light_of_few_photons_is_not_sure_and_a_bright_sheet_within_it_is():
    light = 20 * np.random.default_rng(12).poisson(0.02, (40, 96, 96))
    light[12, 30:60, 30:60] += 150
    result = focus_stack(list(np.clip(light, 0, 255).astype(np.uint8)), method="confocal")
    sure = result.confidence >= 0.8
    assert sure[31:59, 31:59].all()
    assert np.delete(sure, np.s_[28:62], axis=0).mean() < 0.01


def test_a_lost_plane_is_named_and_changes_little():
    planes, z, _ = clean_stack()
    shown = list(seen(planes))
    shown[20] = np.zeros_like(shown[20])
    result = focus_stack(shown)
    assert result.parameters["blank_planes"] == [20]
    assert result.noise > 2
    assert rms(result.range - z) < 0.6


def test_a_window_that_reaches_a_grain_says_nothing_of_the_dark_beside_it():
    planes = np.full((15, 128, 160), 10, np.uint8)
    planes[7, 60:68, 60:68] = 200
    sure = focus_stack(list(planes)).confidence >= 0.8
    assert sure[60:68, 60:68].all()
    assert not sure[:, 108:].any()


def test_faint_patch_is_filled_from_around():
    planes, z, _ = clean_stack()
    result = focus_stack(seen(planes))
    patch = np.s_[44:66, 104:126]
    assert rms((result.range - z)[patch]) < 1.5


@pytest.mark.parametrize("sigma", [0.8, 3.0, 12.0])
def test_noise_is_measured(sigma):
    plane = np.random.default_rng(1).normal(120, sigma, (512, 512)).round().astype(np.uint8)
    assert plane_noise(plane) == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.06)
