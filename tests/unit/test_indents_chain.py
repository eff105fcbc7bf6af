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
from processing.indents_chain import chain, tracked

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
