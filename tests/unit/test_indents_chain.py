"""Depth through many faces, by indents that come and go, against numbers written out here."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from devices.errors import InputError
from processing.indents import Indent
from processing.indents_chain import carried, chain, tracked
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

REMOVED = np.array([0.0, 0.6, 1.3, 1.9, 2.5])
ERROR_UM = 0.02


def indent(x: float, depth: float) -> Indent:
    return Indent("vickers", np.zeros((4, 2)), (x, 50.0), (7 * depth, 7 * depth), (0.05, 0.05), depth, ERROR_UM, ())


def faces(rng: np.random.Generator | None = None) -> list[list[Indent]]:
    """Indents at x = 50 and 100 from the first face on, at 150 pressed into the third; what is too shallow is gone."""
    pressed = [(50.0, 0, 2.0), (100.0, 0, 2.2), (150.0, 2, 2.0)]
    out = []
    for face, removed in enumerate(REMOVED):
        depths = [(x, depth - (removed - REMOVED[since])) for x, since, depth in pressed if face >= since]
        noise = rng.normal(0, ERROR_UM, len(depths)) if rng else np.zeros(len(depths))
        out.append([indent(x, d + n) for (x, d), n in zip(depths, noise, strict=True) if d > 0.4])
    return out


def test_indents_are_followed_from_face_to_face():
    assert [track for track in tracked(faces()) if len(track) > 1] == [
        [(0, 0), (1, 0), (2, 0)],
        [(0, 1), (1, 1), (2, 1)],
        [(2, 2), (3, 0), (4, 0)],
    ]


def test_re_pressed_indents_carry_the_sum_on():
    found = chain(faces())
    np.testing.assert_allclose(found.removed_um, REMOVED, atol=1e-9)
    assert found.notes == ()


def test_stated_errors_are_those_that_occur():
    rng = np.random.default_rng(3)
    runs = [chain(faces(rng)) for _ in range(150)]
    off = np.array([run_.removed_um - REMOVED for run_ in runs])
    stated = runs[0].errors_um
    np.testing.assert_allclose(off.std(axis=0)[1:], stated[1:], rtol=0.25)
    assert np.all(np.diff(stated[2:]) >= -1e-12)
    assert np.mean([run_.chi_square_per_freedom for run_ in runs]) == pytest.approx(1, abs=0.25)


def test_the_feed_bridges_faces_that_share_no_indent_and_else_it_is_an_error():
    broken = [face if k != 3 else [indent(300.0, 1.0)] for k, face in enumerate(faces())]
    broken[4] = [indent(300.0, 0.4)]
    with pytest.raises(InputError, match="faces 2 and 3 share no indent"):
        chain(broken)
    found = chain(broken, list(np.diff(REMOVED)), 0.1)
    np.testing.assert_allclose(found.removed_um, REMOVED, atol=0.02)
    assert found.errors_um[3] > found.errors_um[2]


def test_faces_in_the_wrong_order_are_noticed():
    assert any("swapped" in note for note in chain(faces()[:3][::-1]).notes)


def drawn(half_px: float) -> np.ndarray:
    picture = np.full((1200, 1200), 128, np.uint8)
    corners = np.array([(-1, 0), (0, -1), (1, 0), (0, 1)]) * half_px * 4 + 600
    for k, tone in enumerate((150, 60, 110, 200)):
        facet = np.array([(600, 600), corners[k], corners[(k + 1) % 4]])
        cv2.fillPoly(picture, [np.rint(facet * 16).astype(np.int32)], tone, cv2.LINE_8, 4)
    small = cv2.resize(picture, (300, 300), interpolation=cv2.INTER_AREA)
    return (small + np.random.default_rng(int(half_px)).normal(0, 5, small.shape)).clip(0, 255).astype(np.uint8)


def test_the_command_sums_three_faces(tmp_path: Path, capsys):
    for k, half in enumerate((70, 60, 50)):
        tifffile.imwrite(tmp_path / f"face{k}.tif", drawn(half))
    pictures = [str(tmp_path / f"face{k}.tif") for k in range(3)]
    assert run(["process", "indents", *pictures, "-o", str(tmp_path / "out"), "--pixel-um", "0.1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(report["files"])
    with (tmp_path / "out" / "chain.csv").open() as file:
        lines = list(csv.DictReader(file))
    for line, expected in zip(lines, (0.0, 2 / 7.0006, 4 / 7.0006), strict=True):
        assert float(line["removed_um"]) == pytest.approx(expected, abs=max(3 * float(line["error_um"]), 1e-9))


def faced(removed: float, x_px: float, y_px: float, turn_deg: float, indents: tuple[tuple[float, float, float], ...]):
    """Photograph a grainy face that lies shifted and turned; ``indents``: x, y, and half diagonal before polishing."""
    fine, size = 3, 300
    grain = cv2.GaussianBlur(np.random.default_rng(8).normal(size=(fine * size, fine * size)), (0, 0), 12)
    face = (128 + 150 * grain).astype(np.float32)
    for x, y, half in indents:
        left = half - 3.5003 * removed / PIXEL_UM
        corners = np.array([(-1, 0), (0, -1), (1, 0), (0, 1)]) * left * fine + (fine * x + 1, fine * y + 1)
        for k, tone in enumerate((190, 20, 70, 240) if left > 12 else ()):
            facet = np.array([(fine * x + 1, fine * y + 1), corners[k], corners[(k + 1) % 4]])
            cv2.fillPoly(face, [np.rint(facet * 16).astype(np.int32)], tone, cv2.LINE_8, 4)
    middle = (fine * size - 1) / 2
    place = cv2.getRotationMatrix2D((middle, middle), turn_deg, 1.0)
    place[:, 2] += (fine * x_px, fine * y_px)
    small = cv2.resize(
        cv2.warpAffine(face, place, face.shape, borderValue=128), (size, size), interpolation=cv2.INTER_AREA
    )
    return (small + np.random.default_rng(9).normal(0, 3, small.shape)).clip(0, 255).astype(np.uint8)


PIXEL_UM = 0.1
POLISHED = ((0.0, 0, 0, 0), (0.4, 6, -4, 0.4), (0.7, -3, 5, -0.5))
PRESSED = ((75.0, 75.0, 50.0), (220.0, 85.0, 48.0), (140.0, 220.0, 52.0))


def test_polished_faces_become_a_volume_by_their_indents_alone(tmp_path: Path):
    folder, marked = tmp_path / "faces", tmp_path / "indents"
    folder.mkdir()
    for k, (removed, *place) in enumerate(POLISHED):
        tifffile.imwrite(folder / f"face{k}.tif", faced(removed, *place, PRESSED))
    pictures = [str(folder / f"face{k}.tif") for k in range(len(POLISHED))]
    assert run(["process", "indents", *pictures, "-o", str(marked), "--pixel-um", str(PIXEL_UM), "-q"]) == 0
    tables = ["--fiducials", str(marked / "marks.csv"), "--depths", str(marked / "chain.csv")]
    out = ["-o", str(tmp_path / "out"), "--model", "rigid", "-q"]
    assert run(["process", "align", str(folder), *tables, *out]) == 0
    said = json.loads((tmp_path / "out" / "transforms.json").read_text())["sections"]
    middle = np.array([149.5, 149.5, 1.0])
    for section, (_, x, y, turn) in zip(said, POLISHED, strict=True):
        np.testing.assert_allclose((np.array(section["matrix"]) @ middle - middle)[:2], (x, y), atol=0.4)
        assert section["rotation_deg"] == pytest.approx(-turn, abs=0.1)
    z_um = open_stack(tmp_path / "out" / "aligned.ome.zarr").z_um
    np.testing.assert_allclose(z_um, [-removed for removed, *_ in POLISHED], atol=0.06)


def test_marks_pressed_later_are_carried_into_the_first_face():
    places = np.array([(10.0, 20.0), (110.0, 25.0), (60.0, 90.0)])
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    later = places @ turn.T + (3, -4)
    first = places.copy()
    first[2] = np.nan
    np.testing.assert_allclose(carried(np.array([first, later])), places, atol=1e-9)


@pytest.mark.parametrize("table", ["face\n0\n", "removed_um\n0\n", "removed_um\n1\n0\n", "removed_um\n0\nx\n"])
def test_depths_that_make_no_sense_are_refused(tmp_path: Path, table: str, capsys):
    (tmp_path / "depths.csv").write_text(table)
    np.save(tmp_path / "two.npy", np.random.default_rng(0).integers(0, 255, (2, 64, 64)).astype(np.uint8))
    asked = ["--depths", str(tmp_path / "depths.csv"), "-o", str(tmp_path / "out"), "-q"]
    assert run(["process", "align", str(tmp_path / "two.npy"), *asked]) == 2
    assert "align-depths" in capsys.readouterr().err


def test_a_stack_is_no_face(tmp_path: Path, capsys):
    np.save(tmp_path / "two.npy", np.zeros((2, 64, 64), np.uint8))
    assert run(["process", "indents", str(tmp_path / "two.npy"), "-o", str(tmp_path / "out"), "--pixel-um", "1"]) == 2
    assert "a face is one picture" in capsys.readouterr().err
