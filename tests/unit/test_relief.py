"""Range images drawn: brightness by the formula, lines of equal height in the right place, profiles that are exact."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.cli import run
from devices.errors import InputError
from display.gl.renderer import Renderer
from display.light import linear_of
from display.relief import Relief, ReliefLook, facets, normals
from display.relief_plots import contour_lines, contour_map, levels, nice_increment, profile, stacked_picture
from display.scene import Layer, Light, Scene, View, colour_table
from display.stereo import Stereo
from processing.heights import Heights

SIDE, PIXEL = 65, 0.5
GREY = 0.8


@pytest.fixture(scope="module")
def renderer():
    with Renderer() as made:
        yield made


def on_grid(function, *, pixel=PIXEL, side=SIDE):
    y, x = np.mgrid[:side, :side] * pixel
    middle = (side - 1) / 2 * pixel
    return Heights(np.asarray(function(x - middle, y - middle), np.float32), (pixel, pixel))


def seen(renderer, relief, look, *, mode="relief", view=None, eye=None, stereo=None, px=SIDE):
    """Look straight down, a pixel of the picture for a pixel of the heights."""
    view = view or View(pixel_um=PIXEL)
    return renderer.draw(Scene((Layer(relief, mode, look),), view, stereo or Stereo()), (px, px), eye)


def model(normal, light):
    """The brightness of TECHNIQUES H7, written down once more: the viewer looks along +z."""
    a, e = math.radians(light.azimuth_deg), math.radians(light.elevation_deg)
    to_light = np.array([math.sin(a) * math.cos(e), -math.sin(e), -math.cos(a) * math.cos(e)])
    halfway = to_light + np.array([0, 0, -1])
    halfway /= np.linalg.norm(halfway)
    diffuse = np.maximum(normal @ to_light, 0)
    mirrored = np.where(diffuse > 0, np.maximum(normal @ halfway, 0) ** light.shininess, 0)
    return GREY * (light.ambient + light.diffuse * diffuse) + light.specular * mirrored


@pytest.mark.parametrize("shading", ["flat", "gouraud", "phong"])
@given(slope_x=st.floats(-1, 1), slope_y=st.floats(-1, 1), azimuth=st.floats(-60, 60), elevation=st.floats(-60, 60))
def test_a_tilted_plane_is_as_bright_as_the_model_says(renderer, shading, slope_x, slope_y, azimuth, elevation):
    light = Light(azimuth, elevation, 0.1, 0.6, 0.3, 12.0)
    relief = Relief(on_grid(lambda x, y: slope_x * x + slope_y * y, side=9))
    drawn = seen(renderer, relief, ReliefLook(shading, light=light), px=9)
    normal = np.array([-slope_x, -slope_y, -1]) / math.sqrt(1 + slope_x**2 + slope_y**2)
    assert drawn[4, 4] == pytest.approx(np.full(3, model(normal, light)), abs=2e-3)


@pytest.mark.parametrize(("shading", "mean"), [("flat", 0.02), ("gouraud", 4e-3), ("phong", 2e-3)])
def test_a_sphere_is_as_bright_as_the_model_says(renderer, shading, mean):
    radius = 30.0
    relief = Relief(on_grid(lambda x, y: np.sqrt(radius**2 - x**2 - y**2)))
    light = Light(-35, 40, 0.1, 0.6, 0.4, 15.0)
    drawn = seen(renderer, relief, ReliefLook(shading, light=light))[..., 0]
    y, x = np.mgrid[:SIDE, :SIDE] * PIXEL - (SIDE - 1) / 2 * PIXEL
    z = -np.sqrt(radius**2 - x**2 - y**2)
    expected = model(np.stack([x, y, z], -1) / radius, light)
    inner = slice(3, -3)
    assert np.abs(drawn - expected)[inner, inner].mean() < mean


def test_the_light_moves_and_steeper_is_drawn_when_exaggerated(renderer):
    plane = on_grid(lambda x, y: 0.2 * x)
    light = Light(50, 0, 0.1, 0.9, 0.0)
    plain, steep = (seen(renderer, Relief(plane, e), ReliefLook(light=light))[32, 32, 0] for e in (1.0, 4.0))
    for drawn, slope in ((plain, 0.2), (steep, 0.8)):
        normal = np.array([-slope, 0, -1]) / math.hypot(1, slope)
        assert drawn == pytest.approx(model(normal, light), abs=2e-3)
    from_left = seen(renderer, Relief(plane), ReliefLook(light=Light(-50, 0, 0.1, 0.9, 0.0)))[32, 32, 0]
    assert from_left > plain, "the plane rises to the right: its face looks to the left"


def test_heights_become_colours_of_the_table(renderer):
    relief = Relief(on_grid(lambda x, y: x))
    table = linear_of(colour_table("viridis"))
    drawn = seen(renderer, relief, ReliefLook(paint="heights"), mode="isometric")
    shares = (np.arange(SIDE) / (SIDE - 1))[2:-2]
    expected = np.array([[np.interp(share * 255, np.arange(256), table[:, c]) for c in range(3)] for share in shares])
    assert np.abs(drawn[32, 2:-2] - expected).max() < 5e-3
    fast = seen(renderer, relief, ReliefLook(paint="cycles", cycles=4.0), mode="isometric")[32]
    assert np.abs(fast[4] - fast[20]).max() < 0.03, "a quarter of the heights further the colours are the same"


def test_an_image_lies_where_it_belongs(renderer):
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[10:20, 40:50] = 255
    relief = Relief(on_grid(lambda x, y: 0 * x), image=image)
    drawn = seen(renderer, relief, ReliefLook(paint="image"), mode="isometric")[..., 0]
    assert drawn[12:18, 42:48].min() > 0.95
    assert drawn[22:, :].max() < 0.05
    assert drawn[:, :38].max() < 0.05


def test_lines_of_equal_height_lie_on_the_surface(renderer):
    relief = Relief(on_grid(lambda x, y: x))
    look = ReliefLook(contours=4.0, light=Light(ambient=1, diffuse=0, specular=0))
    drawn = seen(renderer, relief, look)[32, :, 0]
    dark = np.flatnonzero(drawn < 0.6 * drawn.max())
    x_um = dark * PIXEL - 16
    assert len(dark) >= 7
    assert np.abs(x_um - np.rint(x_um / 4) * 4).max() <= PIXEL


def test_unknown_heights_leave_holes(renderer):
    values = np.zeros((SIDE, SIDE), np.float32)
    values[20:30, 20:30] = np.nan
    drawn = seen(renderer, Relief(Heights(values, (PIXEL, PIXEL))), ReliefLook())[..., 0]
    assert not drawn[21:29, 21:29].any()
    assert drawn[40, 40] > 0.2
    only = facets(Heights(np.array([[0, 1], [np.nan, 2]], np.float32)))
    assert len(only.triangles) == 0
    assert len(only.lines) == 2


def test_a_grid_hides_what_is_behind(renderer):
    hill = on_grid(lambda x, y: 12 * np.exp(-(x**2 + y**2) / 20))
    grid = seen(renderer, Relief(hill), ReliefLook(paint="heights"), mode="grid", view=View(0, -70), px=200)
    assert 0.02 < np.mean(grid.any(axis=2)) < 0.5
    flat = seen(renderer, Relief(on_grid(lambda x, y: 0 * x)), ReliefLook(), mode="grid")
    assert flat[32].any()


@pytest.mark.parametrize("mode", ["relief", "isometric", "grid"])
def test_the_eyes_change_places_when_depth_changes_its_sign(renderer, mode):
    relief = Relief(on_grid(lambda x, y: 3 * np.cos(x / 3)))
    look = ReliefLook(paint="heights")
    near = [
        seen(renderer, relief, look, mode=mode, eye=eye, stereo=Stereo("parallel", vergence_deg=8.0))
        for eye in ("left", "right")
    ]
    far = [
        seen(renderer, relief, look, mode=mode, eye=eye, stereo=Stereo("parallel", vergence_deg=8.0, depth=-1))
        for eye in ("right", "left")
    ]
    assert np.abs(near[0] - near[1]).max() > 0.05
    assert np.abs(near[0] - far[0]).max() < 1e-5
    assert np.abs(near[1] - far[1]).max() < 1e-5


def test_a_tilted_plane_has_the_parallax_of_its_heights(renderer):
    """A bright line at the height h is seen apart by 2 h tan(V/2)."""
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[:, 46:51] = 255
    relief = Relief(on_grid(lambda x, y: x), image=image)
    stereo, fine = Stereo("parallel", vergence_deg=10.0), View(pixel_um=PIXEL / 4)
    look = ReliefLook(paint="image")
    middle = []
    for eye in ("left", "right"):
        view = seen(renderer, relief, look, mode="isometric", eye=eye, stereo=stereo, view=fine, px=4 * SIDE)
        row = view[2 * SIDE, :, 0].astype(float)
        middle.append((row * np.arange(4 * SIDE)).sum() / row.sum())
    height = (48 - 32) * PIXEL
    expected_px = 2 * height * math.tan(math.radians(5)) / (PIXEL / 4)
    assert middle[0] - middle[1] == pytest.approx(expected_px, abs=0.15)


def test_normals_of_a_plane_are_exact_with_oblong_pixels():
    y, x = np.mgrid[:5, :6]
    found = normals((0.3 * x * 0.5 - 0.7 * y * 2.0).astype(np.float32), (2.0, 0.5))
    assert found == pytest.approx(
        np.broadcast_to(np.array([-0.3, 0.7, -1]) / math.sqrt(1 + 0.09 + 0.49), (5, 6, 3)), abs=1e-6
    )


def test_large_images_are_drawn_with_fewer_points_and_still_to_the_edge():
    heights = Heights(np.zeros((2000, 10), np.float32), (0.5, 0.5))
    made = facets(heights)
    assert len(made.position) < 10 * 700
    assert made.position[:, 1].max() == pytest.approx(1999 * 0.25)
    assert Relief(heights).stride == 4


# -- on paper ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("edges", ["interpolated", "pixels"])
def test_lines_of_a_cone_are_circles_at_their_heights(edges):
    cone = on_grid(lambda x, y: 20 - np.hypot(x, y))
    middle = (SIDE - 1) / 2 * PIXEL
    for level in (6.0, 10.0, 14.0):
        lines = contour_lines(cone, level, edges)
        radii = np.concatenate([np.hypot(*(line - middle).T) for line in lines])
        off = np.abs(radii - (20 - level)).max()
        assert off < (0.01 if edges == "interpolated" else 0.75 * PIXEL)


def test_lines_of_a_plane_are_straight_and_in_place():
    plane = on_grid(lambda x, y: 2 * x + 100)
    line = np.concatenate(contour_lines(plane, 107.0))
    assert line[:, 0] == pytest.approx(np.full(len(line), 16 + 3.5), abs=1e-5)
    steps = np.concatenate(contour_lines(plane, 107.0, "pixels"))
    assert set(steps[:, 0]) == {19.25}, "between the pixel at 19.0 (106) and the one at 19.5 (107)"
    assert steps[:, 1].min() == -PIXEL / 2


def test_edges_enclose_exactly_the_pixels_above():
    values = np.zeros((5, 6), np.float32)
    values[1:3, 2:5] = 1
    pieces = contour_lines(Heights(values), 0.5, "pixels")
    assert len(pieces) == 2 * (2 + 3)
    points = np.concatenate(pieces)
    assert points.min(axis=0).tolist() == [1.5, 0.5]
    assert points.max(axis=0).tolist() == [4.5, 2.5]
    values[0, 0] = np.nan
    assert len(contour_lines(Heights(values), 0.5, "pixels")) == 10, "nothing beside what is unknown"


@given(low=st.floats(-1e4, 1e4), span=st.floats(1e-3, 1e5))
def test_increments_are_round_and_give_about_ten_levels(low, span):
    heights = Heights(np.array([[low, low + span]] * 2, np.float64))
    increment = nice_increment(heights)
    assert 5 <= len(levels(heights, increment)) <= 16
    mantissa = increment / 10 ** math.floor(math.log10(increment) + 1e-9)
    assert min(abs(mantissa - nice) for nice in (1, 2, 2.5, 5)) < 1e-6


@pytest.mark.parametrize("increment", [0.0, -1.0, math.nan, 1e-9])
def test_increments_that_make_no_map_are_refused(increment):
    with pytest.raises(InputError, match="make no map"):
        levels(on_grid(lambda x, y: x), increment)


def test_a_profile_is_exact_on_a_plane_and_across_oblong_pixels():
    y, x = np.mgrid[:40, :30]
    plane = Heights((3 * x * 0.5 - y * 0.25).astype(np.float32), (0.25, 0.5))
    found = profile(plane, ((1.0, 2.0), (13.0, 7.0)))
    share = found.distance / 13
    assert found.distance[-1] == pytest.approx(13.0)
    assert found.height == pytest.approx(3 * (1 + 12 * share) - (2 + 5 * share), abs=1e-4)
    assert len(found.height) >= 24


@pytest.mark.parametrize("ends", [((0, 0), (0, 0)), ((-1, 0), (5, 5)), ((0, 0), (5, 999)), ((math.nan, 0), (1, 1))])
def test_lines_outside_are_refused(ends):
    with pytest.raises(InputError, match="is not within the image"):
        profile(on_grid(lambda x, y: x), ends)


def test_maps_are_drawn_with_holes_and_without_labels_where_there_is_no_room():
    values = np.random.default_rng(0).normal(size=(20, 30)).astype(np.float32)
    values[3:8, 4:9] = np.nan
    for edges in ("interpolated", "pixels"):
        assert contour_map(Heights(values), 0.5, edges=edges).shape[2] == 3
    assert stacked_picture(Heights(values), 200).std() > 0


def test_the_command_draws_every_kind_in_stereo_and_tables_beside_maps(tmp_path, capsys):
    path = tmp_path / "h.npy"
    y, x = np.mgrid[:30, :40]
    np.save(path, np.hypot(x - 20, y - 15))
    for mode in ("relief", "contour", "profile"):
        out = tmp_path / f"{mode}.png"
        code = run(
            [
                "relief",
                str(path),
                "--pixel",
                "2",
                "--mode",
                mode,
                "-o",
                str(out),
                "--size",
                "90x60",
                "--stereo",
                "parallel",
            ]
        )
        assert code == 0
        assert out.with_suffix(".csv").exists() == (mode != "relief")
    assert cv2.imread(str(tmp_path / "relief.png")).shape == (60, 180, 3)
    assert run(["relief", str(path), "--mode", "contour", "-o", str(tmp_path / "x.gif")]) == 2
    assert run(["relief", str(path), "--paint", "image", "-o", str(tmp_path / "y.png")]) == 2
    assert "--paint image wants an image" in capsys.readouterr().err
