"""Rays, matrices and the two eyes against geometry done by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DisplayError
from display.resolve import axes, camera
from display.scene import Band, Layer, Scene, View, Volume
from display.stereo import Stereo, eye_matrix

SIZE = (200, 100)
AHEAD, PAIR = View(), Stereo()
EYES = st.sampled_from(["left", None, "right"])
ANGLES = st.floats(-180, 180)


def scene(view=AHEAD, stereo=PAIR, shape=(20, 50, 100), spacing=(1.0, 1.0, 1.0)) -> Scene:
    return Scene((Layer(Volume((Band(np.zeros(shape, np.uint8), (0, 255)),), spacing), "mip"),), view, stereo)


def test_looking_along_the_planes_shows_them_as_they_are():
    seen = camera(scene(), SIZE)
    right, left = seen.project(np.array([[10.0, 0, 0], [-10, 0, 0]]))
    below = seen.project(np.array([[0.0, 10, 0]]))[0]
    assert right[0] > left[0]
    assert below[1] > right[1]
    assert seen.project(np.array([[0.0, 0, 5]]))[0] == pytest.approx([99.5, 49.5, 5])


@pytest.mark.parametrize(
    ("view", "towards_viewer"),
    [(View(azimuth_deg=90), (1, 0, 0)), (View(elevation_deg=90), (0, -1, 0)), (View(azimuth_deg=180), (0, 0, 1))],
)
def test_the_viewer_moves_to_the_right_and_up(view, towards_viewer):
    assert -axes(view)[2] == pytest.approx(towards_viewer, abs=1e-12)


def test_roll_turns_the_picture_clockwise():
    seen = camera(scene(View(roll_deg=90)), SIZE)
    to_the_right = seen.project(np.array([[10.0, 0, 0]]))[0] - seen.project(np.zeros((1, 3)))[0]
    assert to_the_right[:2] == pytest.approx([0, 10 / seen.pixel_um])


@settings(deadline=None, max_examples=30)
@given(ANGLES, ANGLES, ANGLES, st.sampled_from([0.0, 30.0]), EYES, st.integers(0, 999))
def test_matrix_and_rays_agree(azimuth, elevation, roll, perspective, eye, seed):
    seen = camera(scene(View(azimuth, elevation, roll, perspective_deg=perspective)), SIZE, eye)
    points = np.random.default_rng(seed).uniform(-20, 20, (5, 3))
    pixels = seen.project(points)
    clip = np.column_stack([points, np.ones(5)]) @ seen.matrix().T
    flat = clip[:, :3] / clip[:, 3:]
    assert (flat[:, :2] + 1) * SIZE / 2 - 0.5 == pytest.approx(pixels[:, :2], abs=1e-6)
    assert np.abs(flat[:, 2]).max() <= 1
    assert (np.argsort(flat[:, 2]) == np.argsort(pixels[:, 2])).all()


@settings(deadline=None, max_examples=30)
@given(ANGLES, ANGLES, st.sampled_from([0.0, 30.0]), st.sampled_from([(800, 100), (100, 800), (300, 300)]))
def test_the_whole_fits_and_touches_the_border(azimuth, elevation, perspective, size):
    seen = camera(scene(View(azimuth, elevation, perspective_deg=perspective), spacing=(3.0, 1.0, 1.0)), size)
    corners = np.array([[x, y, z] for x in (-50, 50) for y in (-25, 25) for z in (-30, 30)], float)
    share = np.abs(seen.project(corners)[:, :2] + 0.5 - np.array(size) / 2) / (np.array(size) / 2)
    assert share.max() <= 1
    assert perspective or share.max() > 0.95


def test_shift_pair_of_a_parallel_view_has_the_parallax_of_the_shear():
    pair = scene(stereo=Stereo(vergence_deg=8, depth=1.5))
    left, right = (camera(pair, SIZE, eye) for eye in ("left", "right"))
    behind = np.array([[3.0, 4, 7]])
    parallax = left.project(behind)[0] - right.project(behind)[0]
    assert parallax[0] * left.pixel_um == pytest.approx(-2 * 7 * 1.5 * math.tan(math.radians(4)))
    assert parallax[1] == pytest.approx(0, abs=1e-9)


def test_off_axis_pair_in_perspective_follows_e_times_one_minus_d_over_z():
    pair = scene(View(perspective_deg=30), Stereo(vergence_deg=6))
    left, right = (camera(pair, SIZE, eye) for eye in ("left", "right"))
    distance = 50 * right.pixel_um / math.tan(math.radians(15))
    eyes_apart = 2 * distance * math.tan(math.radians(3))
    for depth in (-8.0, 0.0, 9.0):
        point = np.array([[2.0, 1, depth]])
        parallax = (right.project(point)[0] - left.project(point)[0])[0] * right.pixel_um
        assert parallax == pytest.approx(eyes_apart * (1 - distance / (distance + depth)))


@pytest.mark.parametrize("views", ["shift", "rotate"])
@pytest.mark.parametrize("eye", ["left", "right"])
def test_eyes_are_those_of_the_stereo_module(views, eye):
    stereo = Stereo(vergence_deg=7, views=views, depth=1.0)
    points = np.random.default_rng(2).uniform(-20, 20, (6, 3))
    seen = camera(scene(stereo=stereo), SIZE, eye)
    moved = np.column_stack([points * (1, -1, -1), np.ones(6)]) @ eye_matrix(stereo, eye, 0.0).T
    expected = moved[:, :2] * (1, -1) / seen.pixel_um + (np.array(SIZE) - 1) / 2
    assert seen.project(points)[:, :2] == pytest.approx(expected)


def test_rotated_pair_is_the_viewer_turned():
    pair = scene(stereo=Stereo(vergence_deg=6, views="rotate"))
    right = camera(pair, SIZE, "right")
    assert right.axis == pytest.approx(axes(View(azimuth_deg=3))[2])


@pytest.mark.parametrize(
    "view",
    [View(zoom=0), View(azimuth_deg=math.nan), View(perspective_deg=170), View(pixel_um=-1), View(zoom=math.inf)],
)
def test_views_of_nothing_are_refused(view):
    with pytest.raises(DisplayError, match="nothing can be seen") as caught:
        camera(scene(view), SIZE)
    assert caught.value.code == "view"


def test_a_window_of_no_size_is_refused():
    with pytest.raises(DisplayError) as caught:
        camera(scene(), (0, 100))
    assert caught.value.code == "picture-size"


def test_zoom_and_pixel_size():
    whole = camera(scene(), SIZE).pixel_um
    assert camera(scene(View(zoom=2)), SIZE).pixel_um == pytest.approx(whole / 2)
    assert camera(scene(replace(View(), pixel_um=0.25)), SIZE).pixel_um == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("length", "unit", "words"),
    [(2e4, "µm", "2 cm"), (50.0, "m", "50 m"), (1e4, "m", "10 km"), (3e4, "voxels", "30000 voxels")],
)
def test_lengths_have_a_unit_that_suits_them(length, unit, words):
    from display.annotate import length_words

    assert length_words(length, unit) == words


def test_long_words_are_broken_so_that_a_narrow_picture_holds_them():
    import numpy as np

    from display.annotate import overlay
    from display.modes import Legend
    from display.resolve import camera
    from display.scene import Band, Layer, Scene, View, Volume, VolumeLook

    volume = Volume((Band(np.zeros((2, 3, 4), np.uint8), (0, 1)),))
    seen = camera(Scene((Layer(volume, "mip", VolumeLook()),), View(pixel_um=1.0)), (120, 160))
    words = ("planes lie 1 to 3 µm apart: each is shown as thick as it stands for",)
    sheet = overlay(Legend((), words), seen)[..., 3]
    written = np.flatnonzero(sheet[:80].any(axis=1))
    assert written[-1] - written[0] > 3 * 9  # several lines of letters 9 px high
    assert not sheet[:80, -4:].any()
