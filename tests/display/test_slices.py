"""Planes through volumes: the raw voxels, linear ramps, what is hidden, and where planes lie."""

import numpy as np
import pytest

from devices.errors import DisplayError
from display.light import encoded
from display.scene import Band, Layer, Scene, SliceLook, View, Volume

LIMITS = (0.0, 255.0)


def noise(shape=(9, 16, 20), seed=4):
    return np.random.default_rng(seed).integers(0, 255, shape, np.uint8, endpoint=True)


def ramp(shape=(16, 16, 16), weights=(4.0, 5.0, 3.0)):
    z, y, x = np.indices(shape)
    return np.rint(weights[0] * z + weights[1] * y + weights[2] * x).astype(np.uint8)


def scene(values, mode, view, spacing=(1.0, 1.0, 1.0), **look):
    volume = Volume((Band(np.ascontiguousarray(values), LIMITS),), spacing)
    return Scene((Layer(volume, mode, SliceLook(**look)),), view)


def test_a_frontal_plane_of_nearest_voxels_is_the_plane_itself(renderer):
    values = noise()
    for k in (0, 4, 8):
        shown = scene(values, "slice", View(pixel_um=1.0), interpolation="nearest", at=(0.5, 0.5, (k + 0.5) / 9))
        assert np.array_equal(encoded(renderer.draw(shown, (20, 16)))[..., 0], values[k])


@pytest.mark.parametrize(
    ("view", "plane"),
    [
        (View(elevation_deg=-90, pixel_um=1.0), lambda v: v[:, 8, :]),
        (View(azimuth_deg=90, pixel_um=1.0), lambda v: v[:, :, 10].T),
    ],
)
def test_sections_along_y_and_x(renderer, view, plane):
    values = noise()
    expected = plane(values)
    shown = scene(values, "slice", view, interpolation="nearest", at=(10.5 / 20, 8.5 / 16, 0.5))
    assert np.array_equal(encoded(renderer.draw(shown, expected.shape[::-1]))[..., 0], expected)


def test_thick_voxels_are_extended_or_interpolated(renderer):
    values = np.zeros((2, 4, 4), np.uint8)
    values[1] = 200
    along = View(elevation_deg=-90, pixel_um=1.0)
    extended = renderer.draw(scene(values, "slice", along, (10.0, 1, 1), interpolation="nearest"), (4, 20))[:, 1, 0]
    blended = renderer.draw(scene(values, "slice", along, (10.0, 1, 1)), (4, 20))[:, 1, 0]
    assert set(encoded(extended)) == {0, 200}
    assert encoded(blended)[9] == pytest.approx(200 * 0.45, abs=2)


@pytest.mark.parametrize(("turn", "tilt"), [(0, 0), (30, 20), (-50, 10)])
def test_an_oblique_plane_of_a_linear_ramp_is_that_ramp(renderer, turn, tilt):
    shown = scene(ramp(), "oblique", View(turn, tilt, pixel_um=0.5), turn_deg=turn, tilt_deg=tilt)
    from display.resolve import axes, camera

    seen = camera(shown, (9, 9))
    j, i = np.mgrid[:9, :9]
    points = seen.corner + i[..., None] * seen.right + j[..., None] * seen.down
    expected = (points + 7.5) @ np.array([3.0, 5.0, 4.0])
    assert axes(shown.view)[2] @ seen.centre == pytest.approx(0)
    assert encoded(renderer.draw(shown, (9, 9)))[..., 0].astype(float) == pytest.approx(expected, abs=1.6)


def test_the_nearer_of_three_planes_hides_the_others_unless_transparent(renderer):
    values = np.full((16, 16, 16), 100, np.uint8)
    values[8] = 50
    view = View(pixel_um=1.0)
    whole = encoded(renderer.draw(scene(values, "orthogonal", view, at=(0.5, 0.5, 8.5 / 16)), (16, 16)))[..., 0]
    clear = encoded(
        renderer.draw(scene(values, "orthogonal", view, at=(0.5, 0.5, 8.5 / 16), transparent=80), (16, 16))
    )[..., 0]
    assert (whole[2:6, 2:6] == 50).all()
    assert (clear[2:6, 2:6] == 0).all()


def test_planes_pulled_apart_lie_where_the_gap_puts_them(renderer):
    values = np.zeros((8, 10, 10), np.uint8)
    values[2], values[6] = 90, 180
    look = {"planes": 2, "gap": 3.0, "interpolation": "nearest"}
    shown = encoded(renderer.draw(scene(values, "exploded", View(elevation_deg=-60, pixel_um=1.0), **look), (12, 60)))[
        ..., 0
    ]
    rows = [np.flatnonzero((shown == level).any(axis=1)).mean() for level in (90, 180)]
    assert rows[1] - rows[0] == pytest.approx(4 * 3 * np.sin(np.radians(60)), abs=1)


def test_tints_differ_by_orientation(renderer):
    values = np.full((16, 16, 16), 255, np.uint8)
    shown = renderer.draw(scene(values, "orthogonal", View(45, 35), tint=True), (48, 48))
    colours = np.unique(encoded(shown).reshape(-1, 3), axis=0)
    assert len(colours) >= 4


def test_cut_voxels_are_whole_cubes(renderer):
    values = np.zeros((3, 3, 3), np.uint8)
    values[1, 1, 1] = 255
    shown = renderer.draw(scene(values, "cubes", View(45, 0, pixel_um=0.1), transparent=10), (40, 40))[..., 0]
    columns = np.flatnonzero(shown.max(axis=0) > 0)
    assert np.ptp(columns) + 1 == pytest.approx(10 * np.sqrt(2), abs=1)


@pytest.mark.parametrize("look", [{"planes": 0}, {"planes": 99, "gap": 2.0}, {"gap": 40.0}])
def test_planes_that_cannot_be_shown(renderer, look):
    with pytest.raises(DisplayError) as caught:
        renderer.draw(scene(np.zeros((200, 4, 4), np.uint8), "exploded", View(), **look), (8, 8))
    assert caught.value.code == "planes"


@pytest.mark.parametrize("rule", ["nearest", "trilinear"])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (20, 0), (0, -25), (-15, 12)])
def test_shifted_planes_are_the_true_shear(renderer, rule, azimuth, elevation):
    from display.scene import VolumeLook

    values = noise((7, 12, 14))
    volume = Volume((Band(values, LIMITS),), (2.0, 1.0, 1.0))
    shown = Scene((Layer(volume, "shift", VolumeLook(interpolation=rule)),), View(azimuth, elevation, pixel_um=1.0))
    expected = np.zeros((24, 26))
    for k, plane in enumerate(values):
        slope = np.array([np.tan(np.radians(azimuth)), -np.tan(np.radians(elevation))]) * 2.0
        x, y = slope * (k - 3)
        if rule == "nearest":
            x, y = np.floor(x + 0.5), np.floor(y + 0.5)
        u, v = np.arange(26) - 6 - x, (np.arange(24) - 6 - y)[:, None]
        from scipy import ndimage

        at = np.broadcast_arrays(v, u)
        inside = (u > -0.5) & (u < 13.5) & (v > -0.5) & (v < 11.5)
        seen = ndimage.map_coordinates(plane.astype(float), at, order=1, mode="nearest")
        expected = np.maximum(expected, np.where(inside, seen, 0))
    error = np.abs(encoded(renderer.draw(shown, (26, 24)))[..., 0] - expected)
    assert error[8:16, 8:18].max() <= 2
    assert np.mean(error > 2) < 0.1  # half covered voxels along the border of planes


def test_a_shift_beyond_thirty_degrees_is_said_to_distort(renderer):
    from display.scene import VolumeLook

    volume = Volume((Band(noise(), LIMITS),))
    words = [
        " ".join(renderer.legend(Scene((Layer(volume, "shift", VolumeLook()),), View(angle)), (20, 20)).words)
        for angle in (20, 40)
    ]
    assert "distorts" not in words[0]
    assert "distorts" in words[1]
