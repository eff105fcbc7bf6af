"""Indents drawn with known corners, facets of known tone, noise and burrs; removal against planes written out here."""

from __future__ import annotations

import csv
import json
import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.indents import Indent, blend, depth_um, measured_indents, removal

if TYPE_CHECKING:
    from pathlib import Path

TONES = (150, 60, 110, 200)
PIXEL_UM = 0.1


def drawn(indents: list[tuple[float, float, float, float, float]], shape=(420, 520), noise: float = 6.0) -> np.ndarray:
    """Draw indents (x, y, half long, half short, turn in degrees), eight times finer, then average."""
    fine = 4
    picture = np.full((shape[0] * fine, shape[1] * fine), 128, np.float32)
    for x, y, long, short, turn in indents:
        t = math.radians(turn)
        ends = [(long * math.cos(t), long * math.sin(t)), (-short * math.sin(t), short * math.cos(t))]
        middle = np.array([x, y])
        corners = [middle - ends[0], middle - ends[1], middle + ends[0], middle + ends[1]]
        for k, tone in enumerate(TONES):
            facet = np.array([middle, corners[k], corners[(k + 1) % 4]])
            cv2.fillPoly(picture, [np.rint(((facet + 0.5) * fine - 0.5) * 16).astype(np.int32)], tone, cv2.LINE_8, 4)
    small = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_AREA)
    return (small + np.random.default_rng(4).normal(0, noise, shape)).clip(0, 255).astype(np.uint8)


def test_depth_ratios_are_those_of_the_standard() -> None:
    assert depth_um(7.0006) == pytest.approx(1, abs=1e-4)
    assert depth_um(30.51, "knoop") == pytest.approx(1, abs=1e-3)
    half = 5.0  # a face rises by cot 68° of the way from the middle to a side, and a side lies half/√2 from the middle
    assert depth_um(2 * half) == pytest.approx(half / math.sqrt(2) / math.tan(math.radians(68)))


@pytest.mark.parametrize("turn", [0.0, 17.0, 45.0])
def test_diagonals_of_a_drawn_indent_are_right_within_their_error(turn: float) -> None:
    (found,) = measured_indents(drawn([(250.3, 200.6, 90, 90, turn)]), PIXEL_UM)
    assert found.shape == "vickers"
    np.testing.assert_allclose(found.diagonals_um, 18.0, atol=0.12)
    assert np.all(np.abs(np.array(found.diagonals_um) - 18.0) < 2 * np.array(found.diagonal_errors_um))
    np.testing.assert_allclose(found.centre_um, (25.03, 20.06), atol=0.1)
    assert found.depth_um == pytest.approx(18 / 7.0006, abs=0.02)


def test_knoop_is_told_from_vickers() -> None:
    (found,) = measured_indents(drawn([(260, 210, 160, 22.5, 10)]), PIXEL_UM)
    assert found.shape == "knoop"
    assert found.depth_um == pytest.approx(32 / 30.51, rel=0.02)


def test_pits_scratches_and_plain_faces_are_no_indents() -> None:
    face = np.random.default_rng(1).normal(128, 6, (420, 520)).clip(0, 255).astype(np.uint8)
    assert measured_indents(face, PIXEL_UM) == []
    cv2.circle(face, (120, 100), 22, 20, -1)
    cv2.line(face, (300, 30), (480, 400), 220, 6)
    cv2.ellipse(face, (250, 300), (60, 35), 20, 0, 360, 40, -1)
    assert measured_indents(face, PIXEL_UM) == []
    assert measured_indents(np.full((200, 200), 9, np.uint8), PIXEL_UM) == []


def indent(x: float, y: float, depth: float, error: float = 0.01) -> Indent:
    return Indent("vickers", np.zeros((4, 2)), (x, y), (7 * depth, 7 * depth), (0.05, 0.05), depth, error, ())


PLACES = [(10.0, 10.0), (90.0, 15.0), (50.0, 80.0), (15.0, 85.0)]


def test_the_removed_layer_is_a_plane_through_the_indents() -> None:
    before = [indent(x, y, 3.0) for x, y in PLACES]
    after = [indent(x + 4, y - 2, 3.0 - (0.5 + 0.002 * x - 0.001 * y)) for x, y in PLACES]
    found = removal(before, after)
    assert found is not None
    assert found.pairs == ((0, 0), (1, 1), (2, 2), (3, 3))
    middle = np.mean(PLACES, axis=0)
    assert found.mean_um == pytest.approx(0.5 + 0.002 * middle[0] - 0.001 * middle[1])
    assert found.slopes == pytest.approx((0.002, -0.001))
    assert found.tilt_deg == pytest.approx(math.degrees(math.atan(math.hypot(0.002, 0.001))))
    assert found.residual_um == pytest.approx(0, abs=1e-12)
    assert found.mean_error_um == pytest.approx(0.01 * math.sqrt(2) / 2)


def test_two_indents_give_no_plane_and_a_vanished_one_is_named() -> None:
    found = removal([indent(*p, 2.0) for p in PLACES[:3]], [indent(*p, 1.5) for p in PLACES[:2]])
    assert found is not None
    assert (found.slopes, found.residual_um, found.tilt_deg) == (None, None, None)
    assert found.vanished == (2,)
    assert "indent 2 is not seen any more" in found.notes[0]
    assert removal([indent(*PLACES[0], 2.0)], []) is None


def test_the_feed_is_blended_by_inverse_variance_and_a_quarrel_is_said() -> None:
    assert blend((1.0, 0.1), (2.0, 0.2)) == pytest.approx((1.2, 0.1 * 2 / math.sqrt(5)))
    pair = [indent(*PLACES[0], 2.0, 0.1)], [indent(*PLACES[0], 1.0, 0.1)]
    agreed = removal(*pair, feed_um=1.1, feed_error_um=0.1)
    assert agreed is not None
    assert agreed.notes == ()
    weight = 1 / 0.02 + 1 / 0.01
    assert agreed.blended_um == pytest.approx((1.0 / 0.02 + 1.1 / 0.01) / weight)
    assert agreed.blended_error_um == pytest.approx(weight**-0.5)
    quarrel = removal(*pair, feed_um=3.0)
    assert quarrel is not None
    assert "the feed 3 ±" in quarrel.notes[0]


def test_pictures_in_the_wrong_order_are_noticed() -> None:
    found = removal([indent(*PLACES[0], 1.0)], [indent(*PLACES[0], 2.0)])
    assert found is not None
    assert "swapped" in found.notes[0]


def test_the_command_measures_what_was_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = [(120, 110), (380, 120), (250, 310)]
    for name, half in (("before", 60), ("after", 50)):
        tifffile.imwrite(tmp_path / f"{name}.tif", drawn([(x, y, half, half, 20) for x, y in places]))
    arguments = ["process", "indents", tmp_path / "before.tif", tmp_path / "after.tif", "-o", tmp_path / "out"]
    assert run([*map(str, arguments), "--pixel-um", "0.1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    lost = report["removal"]
    assert lost["mean_um"] == pytest.approx(2 / 7.0006, abs=3 * lost["mean_error_um"])
    assert lost["mean_error_um"] < 0.02
    assert lost["tilt_deg"] < 0.1
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(report["files"])
    with (tmp_path / "out" / "indents.csv").open() as file:
        assert [row["picture"] for row in csv.DictReader(file)] == ["before"] * 3 + ["after"] * 3


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        ([], "stereo-pixel"),
        (["--pixel-um", "-1"], "stereo-pixel"),
        (["--pixel-um", "nan"], "stereo-pixel"),
        (["--pixel-um", "0.1"], "indents-none"),
        (["--pixel-um", "0.1", "--feed-um", "nan"], "indents-feed"),
        (["--pixel-um", "0.1", "--feed-um", "1", "--feed-error-um", "0"], "indents-feed"),
    ],
)
def test_what_makes_no_sense_is_one_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], code: str
) -> None:
    tifffile.imwrite(tmp_path / "plain.tif", np.full((100, 120), 7, np.uint8))
    assert run(["process", "indents", str(tmp_path / "plain.tif"), "-o", str(tmp_path / "out"), *extra]) == 2
    assert f"error[{code}]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
