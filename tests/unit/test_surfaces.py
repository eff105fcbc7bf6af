"""Surfaces of features: light through several of them by the formula, order, dimming, lines, and files."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
import trimesh

from devices.cli import run
from devices.errors import DisplayError, InputError
from display.gl.renderer import Renderer
from display.light import linear_of
from display.load import as_volume
from display.load_surfaces import load_surfaces, of_labels
from display.scene import Layer, Light, Scene, View
from display.stereo import Stereo
from display.surfaces import Mesh, SurfaceLook, Surfaces, palette, shaded_by_direction
from processing.facets import point_normals

BARE = Light(ambient=1.0, diffuse=0.0, specular=0.0)  # a surface shows its colour
PX = 64


@pytest.fixture(scope="module")
def renderer():
    with Renderer() as made:
        yield made


def sphere(radius: float, colour=(1.0, 0.0, 0.0), opacity=1.0, name="", at=(0, 0, 0)) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Mesh(ball.vertices + np.array(at), ball.faces, colour, opacity, name)


def square(z: float, colour, opacity: float, name: str = "") -> Mesh:
    corners = np.array([[-10, -10, z], [10, -10, z], [-10, 10, z], [10, 10, z]], float)
    return Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]]), colour, opacity, name)


def seen(renderer, meshes, look=None, *, view=None, mode="surface", eye=None, stereo=None):
    scene = Scene(
        (Layer(Surfaces(tuple(meshes)), mode, look or SurfaceLook(light=BARE)),), view or View(), stereo or Stereo()
    )
    return renderer.draw(scene, (PX, PX), eye)


def under(*layers):
    """Light of layers from the nearest on, over black: each lets 1 - opacity of what is behind it through."""
    light, through = np.zeros(3), 1.0
    for colour, opacity in layers:
        light, through = light + through * opacity * linear_of(np.array(colour)), through * (1 - opacity)
    return light


RED, GREEN, BLUE = (1.0, 0.2, 0.1), (0.1, 0.9, 0.2), (0.2, 0.3, 1.0)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
@pytest.mark.parametrize("behind", [False, True])
def test_light_through_three_sheets_is_in_the_right_order_whatever_their_order_in_the_list(renderer, order, behind):
    sheets = [(-5.0, RED, 0.3), (0.0, GREEN, 0.5), (5.0, BLUE, 0.7)]
    view = View(azimuth_deg=180.0) if behind else View()
    drawn = seen(renderer, [square(*sheets[k]) for k in order], view=view)
    nearest_first = sheets[::-1] if behind else sheets
    assert drawn[32, 32] == pytest.approx(under(*((c, o) for _, c, o in nearest_first)), abs=2e-3)


def test_light_through_nested_spheres_passes_four_walls(renderer):
    drawn = seen(renderer, [sphere(10, RED, 0.4), sphere(5, BLUE, 0.6)])
    walls = ((RED, 0.4), (BLUE, 0.6), (BLUE, 0.6), (RED, 0.4))
    assert drawn[33, 31] == pytest.approx(under(*walls), abs=3e-3)
    assert drawn[32, 8] == pytest.approx(under((RED, 0.4), (RED, 0.4)), abs=3e-3)


def test_what_is_opaque_hides_and_is_seen_through_what_is_not(renderer):
    drawn = seen(renderer, [square(5.0, BLUE, 1.0), square(-5.0, RED, 0.5), square(8.0, GREEN, 0.9)])
    assert drawn[32, 32] == pytest.approx(under((RED, 0.5), (BLUE, 1.0)), abs=2e-3)


def test_perspective_sorts_by_distance(renderer):
    drawn = seen(renderer, [square(5.0, BLUE, 0.5), square(-5.0, RED, 0.5)], view=View(perspective_deg=40.0))
    assert drawn[32, 32] == pytest.approx(under((RED, 0.5), (BLUE, 0.5)), abs=2e-3)


def test_others_are_dimmed(renderer):
    look = SurfaceLook(bright=("a",), dimmed=0.25, light=BARE)
    drawn = seen(renderer, [square(-5.0, RED, 1.0, "b"), square(5.0, BLUE, 1.0, "a")], look)
    grey = 0.25 * linear_of(np.array(RED)) + 0.75 * 0.35
    assert drawn[32, 32] == pytest.approx(0.25 * grey + 0.75 * linear_of(np.array(BLUE)), abs=2e-3)


def test_a_lit_sphere_is_as_bright_as_the_model_says(renderer):
    light = Light(0.0, 0.0, 0.1, 0.7, 0.0)
    drawn = seen(renderer, [sphere(10, (1.0, 1.0, 1.0))], SurfaceLook(light=light))[..., 0]
    y, x = (np.mgrid[:PX, :PX] - 31.5) * 2 * 10 * 1.04 / PX
    inside = x**2 + y**2 < 80
    expected = 0.1 + 0.7 * np.sqrt(np.maximum(100 - x**2 - y**2, 0)) / 10
    assert np.abs(drawn - expected)[inside].max() < 0.02


@pytest.mark.parametrize("mode", ["surface", "outlines"])
def test_the_eyes_change_places_when_depth_changes_its_sign(renderer, mode):
    ball = sphere(4, RED, 0.5, at=(0, 0, -8))
    meshes = [Mesh(ball.points, ball.triangles, ball.colour, 0.5, lines=ball.triangles[:, :2]), square(8.0, BLUE, 1.0)]
    plain, inside_out = (Stereo("parallel", vergence_deg=10.0, depth=d) for d in (1.0, -1.0))
    left, right = (seen(renderer, meshes, mode=mode, eye=eye, stereo=plain) for eye in ("left", "right"))
    assert np.abs(left - right).max() > 0.05
    assert np.abs(left - seen(renderer, meshes, mode=mode, eye="right", stereo=inside_out)).max() < 1e-4


def test_hundreds_of_colours_differ():
    colours = np.array(palette(300))
    assert colours.min() >= 0
    assert colours.max() <= 1
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + np.eye(300) * 9
    assert apart.min() > 0.005
    assert np.linalg.norm(np.diff(colours, axis=0), axis=1).min() > 0.25, "neighbours in the list differ much"


def test_a_fibre_along_the_planes_is_darker_than_one_across_them():
    along = np.column_stack([np.arange(9), np.zeros(9), np.zeros(9)])
    assert shaded_by_direction((1, 1, 1), along)[0] == pytest.approx(0.45)
    assert shaded_by_direction((1, 1, 1), along[:, ::-1])[0] == pytest.approx(1.0)


def test_normals_of_a_sphere_point_outwards():
    ball = sphere(3)
    found = point_normals(ball.points, ball.triangles)
    assert np.einsum("ij,ij->i", found, ball.points / 3).min() > 0.995


def test_labels_become_surfaces_and_outlines_in_um():
    z, y, x = np.mgrid[:10, :20, :20]
    values = np.zeros((10, 20, 20), np.uint8)
    values[(2 * (z - 5)) ** 2 + (y - 10) ** 2 + (x - 8) ** 2 < 36] = 3
    values[0:2, 0:3, 16:20] = 9
    found = of_labels(as_volume(values, spacing_um=(2.0, 1.0, 1.0)))
    assert [mesh.name for mesh in found.meshes] == ["3", "9"]
    ball = found.meshes[0]
    solid = trimesh.Trimesh(ball.points[: ball.triangles.max() + 1], ball.triangles)
    assert solid.is_watertight
    assert solid.volume == pytest.approx((values == 3).sum() * 2.0, rel=0.1)
    assert solid.center_mass == pytest.approx([8, 10, 10], abs=0.2)
    outline = ball.points[np.unique(ball.lines)]
    assert set(np.unique(outline[:, 2])) <= {2.0 * k for k in range(10)}, "sections lie in planes"
    radius = np.hypot(outline[:, 0] - 8, outline[:, 1] - 10).max()
    assert radius == pytest.approx(6, abs=0.6)


@pytest.mark.parametrize("kind", ["stl", "ply", "glb"])
def test_meshes_come_from_files(tmp_path, kind):
    trimesh.creation.icosphere(radius=7.0).export(tmp_path / f"ball.{kind}")
    found = load_surfaces(tmp_path / f"ball.{kind}")
    assert found.size_um == pytest.approx([14, 14, 14], rel=0.01)


def test_what_is_no_surface_is_refused(tmp_path):
    (tmp_path / "x.stl").write_bytes(b"solid nothing\nendsolid\n")
    with pytest.raises(InputError):
        load_surfaces(tmp_path / "x.stl")
    with pytest.raises(InputError, match="0 values above 0"):
        of_labels(as_volume(np.zeros((3, 3, 3), np.uint8)))
    with pytest.raises(DisplayError, match="corners that are no points"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))
    with pytest.raises(DisplayError, match=r"opacity of 1\.5"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), opacity=1.5)
    with pytest.raises(DisplayError, match="no surface to draw"):
        Surfaces(())


def test_the_command_draws_labels_and_names_what_is_not_there(tmp_path, capsys):
    values = np.zeros((6, 24, 24), np.uint8)
    values[1:5, 3:10, 3:10], values[1:5, 12:20, 12:20] = 1, 2
    tifffile.imwrite(tmp_path / "labels.tif", values, photometric="minisblack")
    out = tmp_path / "x.png"
    arguments = ["surface", str(tmp_path / "labels.tif"), "-o", str(out), "--size", "120x90", "--step-um", "1"]
    assert run([*arguments, "--bright", "1", "--stereo", "anaglyph-grey", "--lines"]) == 0
    assert out.exists()
    assert run([*arguments, "--overwrite", "--bright", "7"]) == 10
    assert "no surface is called 7" in capsys.readouterr().err
