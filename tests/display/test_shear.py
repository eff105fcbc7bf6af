"""Pictures of moving volumes beside those of the ray caster: nearly the same, from any side."""

import numpy as np
import pytest
from scipy import ndimage

import display.cast_mode
from display.light import encoded_share
from display.load import as_volume
from display.scene import Band, Layer, Scene, Transfer, View, Volume, VolumeLook

SIZE = (64, 48)


def clouds():
    noise = ndimage.gaussian_filter(np.random.default_rng(8).standard_normal((30, 36, 42)).astype(np.float32), 4)
    values = np.clip(128 + 45 * noise / noise.std(), 0, 255)
    values[:, :, 30:] = 0  # empty bricks
    inside = np.zeros_like(values)
    inside[4:-4, 4:-4, 4:-4] = 1
    return ndimage.gaussian_filter(values * inside, 1).astype(np.uint8)


@pytest.mark.parametrize("view", [View(33, 21, 10), View(70, 10), View(150, -60), View(0, 80)])
@pytest.mark.parametrize(
    ("mode", "look"), [("mip", {}), ("minip", {}), ("emission", {"fade": 0.5}), ("translucent", {})]
)
def test_a_moving_picture_is_nearly_the_still_one(renderers, view, mode, look):
    values = 255 - clouds() if mode == "minip" else clouds()
    options = VolumeLook(transfer=Transfer(((0, 0), (255, 0.1)), 1.0), **look)
    volume = Volume((Band(values, (0.0, 255.0)),), (1.3, 1.0, 1.0))
    scene, renderer = Scene((Layer(volume, mode, options),), view), renderers["cpu"]
    still = renderer.draw(scene, SIZE)[..., 0]
    renderer.canvas.moving = True
    try:
        moving = renderer.draw(scene, SIZE)[..., 0]
    finally:
        renderer.canvas.moving = False
    assert not np.array_equal(still, moving)
    both = ndimage.minimum_filter((still > 0) & (moving > 0), 5)  # planes end half a voxel before the outermost voxels
    if mode == "minip":
        still, moving = still * both, moving * both
    if mode in {"mip", "minip"}:  # a value, which the table makes light of
        still, moving = encoded_share(still), encoded_share(moving)
    assert np.abs(still - moving).mean() <= 1.0 / 255
    assert np.corrcoef(still.ravel(), moving.ravel())[0, 1] > 0.999


def test_of_many_voxels_a_moving_picture_shows_every_second_and_says_so(renderers, monkeypatch):
    z, y, x = np.indices((50, 61, 72), np.float32)
    ball = np.clip(230 - 8 * np.sqrt((z - 25) ** 2 + (y - 28) ** 2 + (x - 40) ** 2), 0, 255).astype(np.uint8)
    renderer = renderers["cpu"]
    scene = Scene((Layer(as_volume(ball), "mip", VolumeLook()),), View(35, 25, pixel_um=1.0))
    renderer.canvas.moving = True
    try:
        whole = renderer.draw(scene, (90, 80))
        assert not renderer.canvas.notes
        monkeypatch.setattr(display.cast_mode, "MANY_VOXELS", 1000)
        other = Scene((Layer(as_volume(ball.copy()), "mip", VolumeLook()),), View(35, 25, pixel_um=1.0))
        thin = renderer.draw(other, (90, 80))
    finally:
        renderer.canvas.moving = False
    assert renderer.canvas.notes == ("while moving: each 2nd voxel",)
    middle = [float((light[..., 0] * np.arange(90)).sum() / light[..., 0].sum()) for light in (whole, thin)]
    assert middle[0] == pytest.approx(middle[1], abs=0.1)  # every second voxel lies where it lay
    assert np.abs(whole - thin).mean() < 0.01
