"""Surfaces of a threshold, outlines of sections, and surfaces stretched between outlines, on solids of known size."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import trimesh

from devices.cli import run
from devices.errors import InputError
from processing.facets import smoothed, threshold_surface
from processing.mesh_files import mesh_bytes
from processing.outlines import outlines
from processing.tiling import tile
from sim.scenes import shapes

CUBES, DEEP = (1.0, 1.0, 1.0), (2.0, 1.0, 1.0)


def fork(points):
    """Two leaning rods that run into each other."""
    return np.minimum(
        *(np.hypot(points[..., 0] - s * (8 + 0.5 * points[..., 2]), points[..., 1]) / 1.118 - 9 for s in (1, -1))
    )


FORK = shapes.Shape(lambda p: np.maximum(fork(p), np.abs(p[..., 2]) - 20), 64, {})
UPRIGHT_RING = shapes.Shape(lambda p: shapes.torus(20, 7).distance(p[..., [1, 2, 0]]), 54, shapes.torus(20, 7).truth)
SOLIDS = {"ball": shapes.ball(14), "shell": shapes.shell(16, 6), "ring": UPRIGHT_RING}


@pytest.mark.parametrize("spacing", [CUBES, DEEP])
def test_a_ball_is_closed_of_right_size_with_normals_along_its_radii(spacing) -> None:
    made = threshold_surface(shapes.drawn(shapes.ball(16), spacing), 127, spacing)
    assert made.is_closed
    assert made.volume_um3 == pytest.approx(4 / 3 * np.pi * 16**3, rel=0.006)
    radii = made.points - made.points.mean(axis=0)
    along = (made.normals * radii).sum(axis=1) / np.linalg.norm(radii, axis=1)
    assert np.degrees(np.arccos(along.min())) < 4


def test_a_surface_is_closed_where_the_border_cuts_it() -> None:
    made = threshold_surface(shapes.drawn(shapes.ball(10), size_um=14), 127)
    assert made.is_closed
    with pytest.raises(InputError, match="every voxel"):
        threshold_surface(np.full((4, 4, 4), 9, np.uint8), 3)


def test_smoothing_says_what_it_changes_and_does_not_shrink() -> None:
    grey = shapes.drawn(shapes.ball(12), noise=20)
    rough = threshold_surface(np.where(grey > 127, 200, 10).astype(np.uint8), 127)
    done = smoothed(rough, 20)
    assert done.facets.is_closed
    assert done.volume_change == pytest.approx(done.facets.volume_um3 / rough.volume_um3 - 1)
    assert abs(done.volume_change) < 0.02
    assert -0.2 < done.area_change < -0.03  # the steps of voxels go


def test_outlines_of_a_hollow_ball_have_area_centroid_and_length() -> None:
    grey = shapes.drawn(shapes.shell(16, 6), (1.0, 0.5, 0.5))
    middle = len(grey) // 2
    outer, inner = sorted(
        (o for o in outlines(grey, 127, (1.0, 0.5, 0.5)) if o.section == middle), key=lambda o: -o.area_um2
    )
    away = middle - (len(grey) - 1) / 2 - 0.31
    for outline, radius, sign in ((outer, 16, 1), (inner, 10, -1)):
        cut = np.sqrt(radius**2 - away**2)
        assert outline.area_um2 == pytest.approx(sign * np.pi * cut**2, rel=0.003)
        assert outline.length_um == pytest.approx(2 * np.pi * cut, rel=0.003)
        corner = [((n - 1) / 2 + o) * 0.5 for n, o in zip(grey.shape[:0:-1], (-0.23, 0.12), strict=True)]
        assert outline.centroid_um == pytest.approx(corner, abs=0.02)


@pytest.mark.parametrize("splits", ["divided", "whole"])
@pytest.mark.parametrize("name", SOLIDS)
def test_surfaces_between_outlines_are_closed_and_hold_the_right_volume(name: str, splits) -> None:
    solid = SOLIDS[name]
    made = tile(outlines(shapes.drawn(solid, DEEP), 127, DEEP), splits)
    assert made.facets.is_closed
    assert made.splits == (2 if name == "ring" else 0)
    bound = 0.03 if splits == "whole" and made.splits else 0.02  # pieces run into each other
    assert made.facets.volume_um3 == pytest.approx(solid.truth["volume_um3"], rel=bound)


def test_a_fork_is_divided_where_its_branches_meet() -> None:
    grey = shapes.drawn(FORK, DEEP)
    divided, whole = (tile(outlines(grey, 127, DEEP), splits) for splits in ("divided", "whole"))
    assert divided.splits == whole.splits == 1
    assert divided.facets.is_closed
    assert whole.facets.is_closed
    truth = (shapes.drawn(FORK, CUBES, size_um=72) > 127).sum()
    assert divided.facets.volume_um3 == pytest.approx(truth, rel=0.02)
    assert whole.facets.volume_um3 > divided.facets.volume_um3


def test_a_missing_section_ends_the_surface_on_both_sides() -> None:
    rings = [o for o in outlines(shapes.drawn(shapes.ball(10)), 127) if o.section != 13]
    made = tile(rings)
    assert made.facets.is_closed
    assert len(trimesh.Trimesh(made.facets.points, made.facets.triangles).split()) == 2


@pytest.mark.parametrize("kind", [".stl", ".ply", ".glb"])
def test_files_of_meshes_hold_the_surface_and_name_its_unit(kind: str, tmp_path) -> None:
    made = threshold_surface(shapes.drawn(shapes.ball(6)), 127)
    (tmp_path / f"ball{kind}").write_bytes(mesh_bytes(made, kind))
    assert b"um" in mesh_bytes(made, kind)[:200] or b"unit_of_points" in mesh_bytes(made, kind)
    scene = trimesh.load(tmp_path / f"ball{kind}", force="scene")
    (mesh,) = scene.geometry.values()
    assert mesh.volume == pytest.approx(made.volume_um3, rel=1e-4)
    if kind == ".glb":
        assert scene.to_mesh().volume == pytest.approx(made.volume_um3 * 1e-18, rel=1e-4)


def test_the_command_draws_saves_and_tells(tmp_path, capsys) -> None:
    np.save(tmp_path / "fork.npy", shapes.drawn(FORK, DEEP))
    files = {name: str(tmp_path / name) for name in ("fork.npy", "fork.png", "fork.ply", "fork.csv")}
    scale = ["--pixel-um", "1", "--step-um", "2", "--size", "200x150"]
    more = ["--threshold", "127", "--between", "divided", "--smooth", "3"]
    saved = ["--save", files["fork.ply"], "--table", files["fork.csv"]]
    assert run(["surface", files["fork.npy"], "-o", files["fork.png"], "--lines", *scale, *more, *saved]) == 0
    told = capsys.readouterr().err
    assert "smoothing changed volume by" in told
    assert "surface closed" in told
    rows = list(csv.DictReader((tmp_path / "fork.csv").read_text().splitlines()))
    assert {"section", "z_um", "area_um2", "x_um", "y_um", "length_um"} == set(rows[0])
    assert trimesh.load(files["fork.ply"]).is_watertight


@pytest.mark.parametrize(
    ("options", "code"),
    [(["--threshold", "300"], "mask-empty"), (["--threshold", "127", "--save", "x.obj"], "usage")],
)
def test_bad_wishes_are_one_clear_line(options, code: str, tmp_path, capsys) -> None:
    np.save(tmp_path / "ball.npy", shapes.drawn(shapes.ball(4)))
    assert run(["surface", str(tmp_path / "ball.npy"), "-o", str(tmp_path / "x.png"), *options]) == 2
    assert f"error[{code}]" in capsys.readouterr().err
