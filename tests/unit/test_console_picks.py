"""Points picked in pictures of the review: each where the renderer drew it, lengths and angles those of geometry."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from display.console.drawn import Drawn, Wish
from display.console.picks import Picks
from display.controls import Shown
from display.gl.renderer import Renderer
from display.relief import Relief
from display.render import picture
from display.scene import Band, Layer, Scene, SliceLook, View, Volume
from processing.heights import Heights

SIZE = (360, 240)
EMPTY = np.zeros((*SIZE[::-1], 3), np.uint8)


def slice_of(voxel, view, level=255, mode="slice"):
    """Return the scene of a volume that is dark but for one voxel (z, y, x), and of a plane through that."""
    values = np.zeros((5, 20, 30), np.uint8)
    values[voxel] = level
    volume = Volume((Band(values, (0, 255)),), (2.0, 0.5, 0.8), "µm")
    shares = tuple((k + 0.5) / n for k, n in zip(voxel[::-1], values.shape[::-1], strict=True))
    return Scene((Layer(volume, mode, SliceLook(at=shares, turn_deg=20, tilt_deg=-15)),), view)


def drawn_of(mode, scene, heights=None):
    return Drawn(Wish("run", Shown((mode,), 1, mode=mode), SIZE), EMPTY, scene, heights)


@pytest.mark.parametrize("mode", ["slice", "oblique"])
@pytest.mark.parametrize(
    "view",
    [View(), View(azimuth_deg=25, elevation_deg=-20, roll_deg=10, zoom=1.4), View(azimuth_deg=-30, perspective_deg=40)],
)
def test_a_place_in_a_plane_is_where_the_renderer_drew_it(view, mode):
    voxel = (3, 5, 21)
    scene = slice_of(voxel, view, mode=mode)
    with Renderer() as renderer:
        lit, dark = (picture(renderer, each, SIZE).astype(int) for each in (scene, slice_of(voxel, view, 0, mode)))
    more = (lit - dark).sum(axis=2)
    (rows, columns), weights = np.nonzero(more), more[more > 0]
    middle = np.average(columns, weights=weights), np.average(rows, weights=weights)
    assert drawn_of(mode, scene).place_um(middle) == pytest.approx((21.5 * 0.8, 5.5 * 0.5, 3.5 * 2.0), abs=0.15)


@given(st.floats(-40, 40), st.floats(-40, 40), st.sampled_from([0.0, 30.0]), st.floats(100, 260), st.floats(60, 180))
def test_a_place_is_seen_at_the_pixel_it_was_picked_at(azimuth, elevation, perspective, x, y):
    view = View(azimuth_deg=azimuth, elevation_deg=elevation, perspective_deg=perspective)
    drawn = drawn_of("slice", slice_of((2, 9, 14), view))
    place = drawn.place_um((x, y))
    assert place is None or drawn.pixel_of(place) == pytest.approx((x, y), abs=1e-6)
    assert drawn.place_um((180, 120)) is not None


def test_over_a_range_image_the_third_is_the_height_and_where_none_was_found_there_is_no_place():
    values = np.tile(np.arange(40, dtype=np.float32), (30, 1))
    values[10:12, 10:12] = np.nan
    heights = Heights(values, (0.5, 0.5))
    drawn = drawn_of("range", Scene((Layer(Relief(heights), "isometric"),)), heights)
    wide_um = 39 * 0.5
    for column in (0, 7, 39):
        pixel = drawn.pixel_of((wide_um * (column + 0.5) / 40, 5.0, 0.0))
        _, y_um, height_um = drawn.place_um(pixel)
        assert (height_um, y_um) == (column, pytest.approx(5.0))
    assert drawn.place_um(drawn.pixel_of((10.6 / 40 * wide_um, 10.6 / 30 * 14.5, 0.0))) is None
    assert drawn.place_um((-1, 5)) is None
    assert not drawn_of("range", drawn.scene).third
    pair = replace(drawn.scene, stereo=replace(drawn.scene.stereo, mode="parallel"))
    assert not drawn_of("range", pair, heights).third


def test_pictures_without_places_have_none():
    scene = slice_of((1, 0, 0), View())
    assert drawn_of("mip", scene).place_um((180, 120)) is None
    pair = replace(scene, stereo=replace(scene.stereo, mode="anaglyph-grey"))
    assert drawn_of("slice", pair).place_um((180, 120)) is None


def test_lengths_and_angles_are_those_of_the_points_and_are_saved_with_them(tmp_path):
    picks = Picks()
    for place in ((0.0, 0.0, 0.0), (3.0, 4.0, 0.0), (3.0, 4.0, 12.0), (3.0, 9.0, 12.0)):
        picks.add(place, "height", "µm")
    assert picks.length == pytest.approx(5 + 12 + 5)
    assert picks.angles_deg == pytest.approx([90, 90])
    assert "22.00 µm long, 90.0°, 90.0°" in picks.words
    picks.save(tmp_path / "p.csv")
    rows = list(csv.DictReader((tmp_path / "p.csv").read_text().splitlines()))
    assert rows[2] == {"x_um": "3", "y_um": "4", "height_um": "12", "along_um": "17", "angle_deg": "90"}
    picks.add((1.0, 1.0, 1.0), "depth", "µm")
    assert (picks.points, picks.length, picks.angles_deg) == ([(1.0, 1.0, 1.0)], 0, [])
    picks.save(tmp_path / "one.csv")
    picks.forget()
    assert not picks.words
