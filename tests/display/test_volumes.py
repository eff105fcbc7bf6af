"""Volumes on both executors against closed forms and against the slow reference."""

from dataclasses import replace

import numpy as np
import pytest
from reference import Reference

from display.light import encoded_share, linear_of
from display.modes import find_mode
from display.modes.projections import local_deviation
from display.resolve import camera, light_vector
from display.scene import (
    Band,
    Layer,
    Light,
    Scene,
    Transfer,
    View,
    Volume,
    VolumeLook,
    band_colours,
    transfer_table,
)

SIZE = (40, 32)
ASKEW = View(33, 21, 10)
NEAR = View(-50, 35, 0, perspective_deg=35)
FRONT = Light(azimuth_deg=0, elevation_deg=0, diffuse=0.85, specular=0)
RAMP = tuple((255.0 * k, float(k), float(k), float(k)) for k in (0, 1))


def volume_of(values, spacing=(1.5, 1.0, 1.0), limits=(0.0, 255.0)) -> Volume:
    return Volume((Band(np.ascontiguousarray(values), limits),), spacing)


def noise(shape=(9, 18, 22), seed=1):
    return np.random.default_rng(seed).integers(0, 255, shape, np.uint8, endpoint=True)


def grey(volume, mode, view=ASKEW, size=SIZE, **look):
    """What the renderer is asked for, and with what."""
    return Scene((Layer(volume, mode, VolumeLook(**look)),), view)


def levels(renderer, scene, size=SIZE):
    return renderer.draw(scene, size)[..., 0]


def ball(radius, side=33, rim=1.0):
    """A ball of 255 that falls to 0 over a rim of some voxels, half way at the radius."""
    z, y, x = np.mgrid[:side, :side, :side] - (side - 1) / 2
    inside = np.clip((radius - np.sqrt(x * x + y * y + z * z)) / rim + 0.5, 0, 1)
    return np.rint(255 * inside).astype(np.uint8)


# -- closed forms


@pytest.mark.parametrize("view", [View(), ASKEW, View(77, -12), NEAR, View(45, 35.26)])
def test_a_uniform_box_at_any_angle_absorbs_by_its_length(renderer, view):
    values = np.zeros((20, 24, 28), np.uint8)
    values[5:15, 6:18, 7:21] = 255
    volume = volume_of(values)
    scene = grey(volume, "absorption", view, contrast=0.06)
    half, seen = np.array([7.0, 6.0, 7.5]), Reference(volume, camera(scene, SIZE), 1.0)
    with np.errstate(divide="ignore"):
        one, two = (-half - seen.start) / seen.way, (half - seen.start) / seen.way
    length = np.maximum(np.maximum(one, two).min(axis=-1) - np.minimum(one, two).max(axis=-1), 0)
    through = np.exp(-0.06 * length)
    shown = levels(renderer, scene)
    expected = linear_of(through)
    clear = np.abs(through - 0.5) < 0.49
    assert clear.sum() > 50
    assert np.abs(shown - expected).max() < 0.01
    assert np.abs(shown[clear] / expected[clear] - 1).max() < 0.025  # of light; 1 % of I/I0


def test_a_sphere_absorbs_by_its_chords(renderer):
    volume = volume_of(ball(13), (1.0, 1.0, 1.0))
    scene = grey(volume, "absorption", View(30, 40, pixel_um=1.0), contrast=0.08)
    seen = Reference(volume, camera(scene, (33, 33)), 1.0)
    offset = np.linalg.norm(np.cross(seen.start, seen.way), axis=-1)
    expected = np.exp(-2 * 0.08 * np.sqrt(np.maximum(13**2 - offset**2, 0)))
    error = (levels(renderer, scene, (33, 33)) - linear_of(expected))[offset < 11.5]  # the rim is a voxel wide
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert abs(error.mean()) < 0.005


@pytest.mark.parametrize("step", [2.0, 0.5, 0.17])
def test_opacity_of_a_slab_does_not_depend_on_steps(renderer, step):
    volume = volume_of(np.full((8, 16, 16), 255, np.uint8), (1.0, 1.0, 1.0))
    transfer = Transfer(((0, 0.2), (255, 0.2)), 1.0)
    scene = grey(volume, "translucent", View(pixel_um=1.0), step=step, transfer=transfer)
    assert levels(renderer, scene, (8, 8)) == pytest.approx(1 - 0.8**8, abs=2e-3)


def test_emission_of_a_slab_is_its_depth_and_fades_by_the_share(renderer):
    volume = volume_of(np.full((10, 16, 16), 128, np.uint8), (1.0, 1.0, 1.0), (0, 255))
    bands = replace(volume.bands[0], colour=RAMP)
    plain = grey(replace(volume, bands=(bands,)), "emission", View(pixel_um=1.0), contrast=0.8)
    assert levels(renderer, plain, (8, 8)) == pytest.approx(float(linear_of(np.array(0.8))), abs=3e-3)
    faded = grey(replace(volume, bands=(bands,)), "emission", View(pixel_um=1.0), contrast=0.8, fade=0.6, step=0.1)
    mean = 0.8 * 0.6 / -np.log(0.4)
    assert levels(renderer, faded, (8, 8)) == pytest.approx(float(linear_of(np.array(mean))), abs=4e-3)


@pytest.mark.parametrize("view", [View(), View(25, -15), NEAR])
def test_the_surface_of_a_ball_is_lit_by_its_normals(renderer, view):
    volume = volume_of(ball(12, rim=8.0), (1.0, 1.0, 1.0))
    light = Light(azimuth_deg=-30, elevation_deg=45, specular=0.0)
    scene = grey(volume, "first", replace(view, pixel_um=0.8), light=light)
    seen = Reference(volume, camera(scene, SIZE), 1.0)
    along = np.sum(seen.start * seen.way, axis=-1)
    inside = 12.0**2 - np.sum(seen.start**2, axis=-1) + along**2
    clear = inside > 30
    normal = seen.points(-along - np.sqrt(np.maximum(inside, 0))) / 12
    expected = light.ambient + light.diffuse * np.maximum(normal @ light_vector(seen.camera, light), 0)
    assert np.abs(levels(renderer, scene) - expected)[clear].max() < 0.05


def test_first_and_last_surface_of_a_tilted_plane_have_its_normal(renderer):
    z, _, x = np.mgrid[:20, :20, :20].astype(float)
    values = np.clip(127.5 + 14 * (z - 9.5 + 0.5 * (x - 9.5)), 0, 255).astype(np.uint8)
    light = Light(azimuth_deg=20, elevation_deg=10, specular=0.0, ambient=0.0, diffuse=1.0)
    scene = grey(volume_of(values, (1.0, 1.0, 1.0)), "first", View(pixel_um=1.0), light=light)
    normal = -np.array([0.5, 0, 1]) / np.sqrt(1.25)
    expected = normal @ light_vector(camera(scene, (20, 20)), light)
    assert levels(renderer, scene, (20, 20))[8:12, 8:12] == pytest.approx(expected, abs=0.02)


def test_depth_of_the_maximum_is_where_it_was_put(renderer):
    values = np.zeros((21, 16, 16), np.uint8)
    values[5, :, :8] = 200
    values[17, :, 8:] = 200
    scene = grey(volume_of(values, (2.0, 1.0, 1.0)), "depth", View(pixel_um=1.0))
    shown = renderer.draw(scene, (16, 16))
    table = linear_of(band_colours(replace(scene.layers[0].data.bands[0], colour="turbo")))
    for column, depth in ((3, 5.5 / 21), (12, 17.5 / 21)):
        assert np.abs(table - shown[8, column]).sum(axis=1).argmin() == pytest.approx(depth * 255, abs=8)


def test_the_steepest_change_is_found_on_the_wall_of_a_box(renderer):
    values = np.zeros((20, 20, 20), np.uint8)
    values[8:, 4:16, 4:16] = 220
    light = Light(azimuth_deg=0, elevation_deg=0, specular=0.0, ambient=0.1, diffuse=0.9)
    scene = grey(volume_of(values, (1.0, 1.0, 1.0)), "edge", View(pixel_um=1.0), light=light)
    shown = levels(renderer, scene, (20, 20))
    assert shown[7:13, 7:13] == pytest.approx(1.0, abs=0.02)
    assert shown[:2].max() == 0


# -- the slow reference


@pytest.mark.parametrize("view", [ASKEW, NEAR])
@pytest.mark.parametrize("mode", ["mip", "minip"])
def test_extremes_agree_with_the_reference(renderer, view, mode):
    scene = grey(volume_of(noise()), mode, view)
    seen = Reference(scene.layers[0].data, camera(scene, SIZE), 1.0)
    expected = seen.maximum() if mode == "mip" else seen.minimum()
    assert_within(renderer, encoded_share(levels(renderer, scene)), expected)


@pytest.mark.parametrize("view", [ASKEW, NEAR])
def test_emission_and_absorption_agree_with_the_reference(renderer, view):
    volume = volume_of(noise(), limits=(30.0, 220.0))
    transfer = Transfer(((100, 0), (220, 0.4)), 1.0)
    scene = grey(
        replace(volume, bands=(replace(volume.bands[0], colour="viridis"),)), "translucent", view, transfer=transfer
    )
    table = transfer_table(scene.layers[0].data.bands[0], transfer, 1.0)
    light, _ = Reference(scene.layers[0].data, camera(scene, SIZE), 1.0).translucent(table.astype(float))
    assert_within(renderer, renderer.draw(scene, SIZE), light)


def test_leaping_over_empty_bricks_changes_nothing(renderers):
    values = np.zeros((70, 70, 70), np.uint8)
    values[20:30, 50:, 3:20] = noise((10, 20, 17))
    volume = volume_of(values, (1.0, 1.0, 1.0))
    for mode in ("mip", "translucent", "first", "emission"):
        scene = grey(volume, mode, View(40, 30))
        leaping = renderers["cpu"].draw(scene, SIZE)
        plain = renderers["gl"].draw(scene, SIZE)
        assert leaping.max() > 0
        assert np.percentile(np.abs(leaping - plain), 99) < 0.02


# -- surfaces within, shadows, bands


def test_a_surface_within_a_translucent_volume(renderer):
    values = np.maximum(ball(8), np.uint8(60))
    transfer = Transfer(((0, 0.0), (60, 0.01), (255, 0.01)), 1.0)
    volume = volume_of(values, (1.0, 1.0, 1.0))
    with_surface, half, without = (
        levels(renderer, grey(volume, "translucent", ASKEW, transfer=transfer, surface=s, threshold=160, light=FRONT))
        for s in (1.0, 0.5, 0.0)
    )
    middle = (slice(12, 20), slice(16, 24))
    assert (with_surface[middle] > half[middle]).all()
    assert (half[middle] > without[middle] + 0.1).all()
    assert np.abs(with_surface - without)[:2].max() < 1e-3


def test_the_plane_behind_is_darker_where_the_data_take_the_light(renderer):
    values = np.zeros((24, 24, 24), np.uint8)
    values[10:14, 10:14, 10:14] = 255
    transfer = Transfer(((0, 0), (255, 0.5)), 1.0)
    light = Light(azimuth_deg=-40, elevation_deg=0, ambient=0.2)
    scene = grey(
        volume_of(values, (1.0, 1.0, 1.0)),
        "translucent",
        View(pixel_um=1.0),
        transfer=transfer,
        light=light,
        shadow="rear",
    )
    shown = levels(renderer, scene, (60, 24))
    way = (12 + 0.02 * np.sqrt(3) * 24) * np.tan(np.radians(40))  # to the right: the light comes from the left
    column = round(29.5 + way)
    assert shown[12, column] == pytest.approx(0.2 + 0.8 * 0.5 ** (4 / np.cos(np.radians(40))), abs=0.12)
    assert shown[12, 4] == pytest.approx(1.0, abs=1e-3)
    assert shown[2].min() == pytest.approx(1.0, abs=1e-3)


def test_features_shadow_each_other(renderer):
    values = np.zeros((24, 24, 24), np.uint8)
    values[10:14, 8:16, 3:6] = 255
    values[10:14, 8:16, 16:19] = 255
    transfer = Transfer(((0, 0), (255, 0.6)), 1.0)
    light = Light(azimuth_deg=-80, elevation_deg=0)
    volume = volume_of(values, (1.0, 1.0, 1.0))
    plain, shadowed = (
        levels(
            renderer,
            grey(volume, "translucent", View(pixel_um=1.0), transfer=transfer, light=light, shadow=shadow),
            (24, 24),
        )
        for shadow in ("none", "self")
    )
    assert shadowed[12, 17] < 0.3 * plain[12, 17]
    assert shadowed[12, 3] == pytest.approx(0.4**0.5 * plain[12, 3], rel=0.1)


def test_bands_add_their_colours(renderer):
    one, two = np.full((4, 8, 8), 255, np.uint8), np.full((4, 8, 8), 128, np.uint8)
    bands = (Band(one, (0, 255), colour="#ff0000"), Band(two, (0, 255), colour="#0000ff"))
    scene = grey(Volume(bands), "mip", View(pixel_um=1.0))
    assert renderer.draw(scene, (8, 8))[4, 4] == pytest.approx(
        [1.0, 0.0, float(linear_of(np.array(128 / 255)))], abs=0.004
    )


def test_a_cut_shows_a_part(renderer):
    volume = volume_of(np.full((8, 20, 20), 255, np.uint8), (1.0, 1.0, 1.0))
    scene = grey(volume, "mip", View(pixel_um=1.0), cut=((0.25, 0.75), (0, 1), (0, 1)))
    shown = levels(renderer, scene, (20, 20))
    assert shown[:, 6:14].min() == 1
    assert shown[:, :4].max() == shown[:, 16:].max() == 0


# -- bad input


@pytest.mark.parametrize(
    "mode", ["mip", "minip", "emission", "absorption", "translucent", "first", "last", "edge", "depth"]
)
@pytest.mark.parametrize(
    "values",
    [
        np.zeros((3, 5, 7), np.uint8),
        np.full((3, 5, 7), 9, np.uint16),
        noise((1, 9, 9)),
        noise((1, 1, 1)),
        noise((40, 3, 3)),
    ],
)
def test_empty_constant_and_thin_volumes_are_drawn(renderer, mode, values):
    scene = grey(volume_of(values, (10.0, 1.0, 1.0)), mode)
    shown = renderer.draw(scene, (24, 18))
    assert np.isfinite(shown).all()
    assert find_mode(mode).legend is not None


def test_local_deviation_is_that_of_27_voxels():
    values = noise((5, 6, 7))
    assert local_deviation(values)[2, 3, 3] == pytest.approx(values[1:4, 2:5, 2:5].std(), rel=1e-4)


def assert_within(renderer, shown, expected):
    """The processor within half a grey level; weights of 8 bits: 99.9 % within 2, all within 4, 0.35 on average."""
    error = np.abs(np.clip(shown, 0, 1) - np.clip(expected, 0, 1)) * 255
    exact = renderer.canvas.executor == "cpu"
    assert np.percentile(error, 99.9) <= (0.5 if exact else 2)
    assert error.max() <= (0.5 if exact else 4)
    assert error.mean() <= (0.1 if exact else 0.35)
