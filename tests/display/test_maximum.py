"""Maximum projection against what a loop over voxels finds."""

import numpy as np
import pytest

from display.light import linear_of
from display.load import as_volume
from display.scene import Band, Layer, Scene, View, Volume, VolumeLook

SHAPE = (11, 24, 30)
AHEAD = View()


def shown(values: np.ndarray, view: View = AHEAD, limits=(0, 255)) -> Scene:
    return Scene((Layer(Volume((Band(values, limits),)), "mip", VolumeLook()),), view)


def noise(seed: int = 3, dtype=np.uint8) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, SHAPE, dtype, endpoint=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_seen_along_the_planes_it_is_the_maximum_of_every_column(renderer, dtype):
    values = noise(dtype=dtype)
    full = float(np.iinfo(dtype).max)
    light = renderer.draw(shown(values, View(pixel_um=1.0), (0, full)), (30, 24))
    assert np.abs(light[..., 0] - linear_of(values.max(axis=0) / full)).max() < 0.004
    assert (light[..., :1] == light).all()


@pytest.mark.parametrize(("azimuth", "axis", "flip"), [(90, 2, 1), (180, 0, -1), (-90, 2, -1)])
def test_right_angles_permute_axes(renderer, azimuth, axis, flip):
    values = noise(5)
    expected = values.max(axis=axis)
    expected = (expected.T if axis == 2 else expected)[:, ::flip]
    light = renderer.draw(shown(values, View(azimuth, pixel_um=1.0)), expected.shape[::-1])
    assert np.abs(light[..., 0] - linear_of(expected / 255)).max() < 0.004


def test_executors_agree_at_any_angle(renderers):
    values = noise(7)
    for view in (View(33, 21, 10), View(-70, 50, 0, perspective_deg=40)):
        levels = [renderers[name].draw(shown(values, view), (96, 64)) for name in ("gl", "cpu")]
        assert np.abs(levels[0] - levels[1]).max() < 4 / 255
        assert levels[0].max() > 0.5


def test_beside_the_volume_there_is_background(renderer):
    light = renderer.draw(shown(noise(), View(pixel_um=2.0)), (60, 60))
    assert light[0].max() == light[-1].max() == 0
    assert light[30, 30, 0] > 0.5


def test_limits_stretch_contrast(renderer):
    values = np.full(SHAPE, 100, np.uint8)
    light = renderer.draw(shown(values, View(pixel_um=1.0), (50, 150)), (30, 24))
    assert np.abs(light[12, 15] - linear_of(np.array(0.5))).max() < 0.004


def test_a_volume_larger_than_a_texture_is_drawn_from_means_and_says_so(renderers, monkeypatch):
    canvas, size = renderers["gl"].canvas, (40, 30)
    ramp = np.add.outer(np.arange(0, 80, 2), np.add.outer(np.arange(24), np.arange(60))).astype(np.uint8)
    scene = shown(ramp, View(20, 30, pixel_um=2.0), (0, 200))
    whole = renderers["gl"].draw(scene, size)
    assert not canvas.notes
    monkeypatch.setattr(canvas, "largest", 20)
    again = shown(ramp.copy(), View(20, 30, pixel_um=2.0), (0, 200))  # other data: the texture is made anew
    fewer = renderers["gl"].draw(again, size)
    assert canvas.notes == ("60×24×40 voxels drawn as 20×20×20: a texture holds no more",)
    assert canvas.notes[0] in renderers["gl"].legend(again, size).words
    inside = whole[..., 0] > 0.02
    assert inside.mean() > 0.2
    assert np.abs(whole - fewer)[inside].mean() < 0.02
    assert np.corrcoef(whole[..., 0].ravel(), fewer[..., 0].ravel())[0, 1] > 0.99


def test_a_layer_without_a_look_has_its_modes_own(renderers):
    layer = Layer(as_volume(np.full((3, 20, 30), 9, np.uint8)), "slice")
    assert renderers["gl"].draw(Scene((layer,), View(pixel_um=1.0)), (30, 24)).shape == (24, 30, 3)
