"""Single ways of aligning, the Ex-OR curve, and compression from the looks of sections, against drawn truth."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.align_isotropy import elongation, tensors
from processing.align_methods import METHODS, matcher
from processing.align_mismatch import chance, least_mismatch, meeting
from processing.align_models import distance_px, fitted
from processing.align_pair import view

if TYPE_CHECKING:
    from pathlib import Path

SIDE = 200
SHAPE = (SIDE, SIDE)


def face(seed: int = 3, *, round_features: bool = False) -> np.ndarray:
    """Draw bright ellipses on a dark ground, larger than what a section shows."""
    rng = np.random.default_rng(seed)
    side = 2 * SIDE
    picture = np.full((side, side), 60, np.float32)
    for x, y, a, b, turn in rng.random((90, 5)):
        axes = (9, 9) if round_features else (6 + 12 * a, 6 + 12 * b)
        cv2.ellipse(picture, ((x * side, y * side), axes, turn * 180), 200, -1)
    return cv2.GaussianBlur(picture, (0, 0), 0.8)


def taken(picture: np.ndarray, matrix: np.ndarray, seed: int = 1) -> np.ndarray:
    """Photograph the face through a map from the middle part of the face to the section."""
    whole = matrix @ np.array([[1, 0, -SIDE / 2], [0, 1, -SIDE / 2], [0, 0, 1.0]])
    seen = cv2.warpAffine(picture, whole[:2], (SIDE, SIDE), flags=cv2.INTER_CUBIC)
    return (seen + np.random.default_rng(seed).normal(0, 8, seen.shape)).clip(0, 255).astype(np.uint8)


def placed(turn_deg: float, x: float, y: float, compression: float = 0.0) -> np.ndarray:
    matrix = np.eye(3)
    middle = (SIDE - 1) / 2
    matrix[:2] = cv2.getRotationMatrix2D((middle, middle), -turn_deg, 1.0)
    matrix[:2, :2] = matrix[:2, :2] @ np.diag([1 - compression, 1.0])
    matrix[:2, 2] = middle - matrix[:2, :2] @ (middle, middle) + (x, y)
    return matrix


PLACES = {
    "auto": (40.0, 5.3, -7.6),
    "centroids": (6.0, 5.3, -7.6),
    "mismatch": (70.0, 5.3, -7.6),
    "phase": (0.0, 5.3, -7.6),
    "fourier-mellin": (70.0, 5.3, -7.6),
    "features": (70.0, 5.3, -7.6),
}
WITHIN_PX = {"auto": 0.05, "centroids": 0.15, "mismatch": 0.15, "phase": 0.3, "fourier-mellin": 0.5, "features": 1.0}


@pytest.mark.parametrize("method", METHODS)
def test_every_way_finds_the_map_and_is_believed(method):
    picture, matrix = face(), placed(*PLACES[method])
    found = matcher(method)(view(taken(picture, np.eye(3))), view(taken(picture, matrix, 2)), "rigid", None)
    assert distance_px(found.matrix, matrix, SHAPE) < WITHIN_PX[method]
    assert found.believed


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("other", ["foreign", "blank"])
def test_no_way_believes_pictures_of_different_things(method, other):
    second = taken(face(8), np.eye(3)) if other == "foreign" else np.full(SHAPE, 90, np.uint8)
    assert not matcher(method)(view(taken(face(), np.eye(3))), view(second), "rigid", None).believed


def test_ex_or_area_of_squares_is_what_was_drawn_and_lies_on_both_sides_of_the_least():
    first, second = np.zeros((90, 120), bool), np.zeros((90, 120), bool)
    first[30:60, 40:70], second[33:63, 46:76] = True, True
    found = least_mismatch(first, second, turn=False)
    assert found is not None
    np.testing.assert_allclose(found.matrix[:2, 2], (6, 3), atol=0.06)
    assert found.least < 0.002
    offset, value = found.curves["x"].T
    shared = (90 - 3) * (120 - np.abs(6 + offset))
    np.testing.assert_allclose(value, 2 * 30 * np.abs(offset) / shared, atol=0.001)
    assert chance(first, second) == pytest.approx(2 * (900 / 10800) * (1 - 900 / 10800))


def test_sides_of_a_curve_meet_between_its_steps():
    offsets = np.arange(-8.0, 9.0)
    assert meeting(offsets, 0.1 + np.abs(offsets - 0.37)) == pytest.approx(0.37)


@pytest.mark.parametrize("mask", [np.zeros((40, 40), bool), np.ones((40, 40), bool)])
def test_empty_and_full_masks_have_no_place(mask):
    square = np.zeros((40, 40), bool)
    square[10:20, 10:20] = True
    assert least_mismatch(square, mask) is None
    assert least_mismatch(mask, square) is None


@pytest.mark.parametrize("kind", ["texture", "features"])
def test_compression_shows_in_round_features_and_in_texture(kind):
    turn, compression = 25.0, 0.2
    rng = np.random.default_rng(4)
    groups = []
    for k in range(6):
        if kind == "features":
            picture = face(20 + k, round_features=True)
        else:
            grain = rng.normal(size=(2 * SIDE, 2 * SIDE)).astype(np.float32)
            picture = 128 + 400 * cv2.GaussianBlur(grain, (0, 0), 4)
        groups.append(tensors(taken(picture, placed(turn, 0, 0, compression), k), kind))
    found = elongation(groups, kind)
    assert found is not None
    assert abs(found.direction_deg - turn) < 3 * found.direction_error_deg < 12
    short = 0.04 if kind == "texture" else 0.0  # smoothing makes fine texture rounder
    assert abs(found.compression + short - compression) < 3 * found.compression_error
    assert found.compression_error < 0.03


def test_what_shows_no_features_gives_no_compression():
    assert elongation([tensors(np.full(SHAPE, 7, np.uint8), "features")] * 5, "features") is None
    assert elongation([tensors(np.full(SHAPE, 7, np.uint8), "texture")] * 5, "texture") is None


def test_mismatch_through_the_command_leaves_its_curve_as_table_and_picture(tmp_path: Path):
    picture = face()
    stack = np.stack([taken(picture, placed(2 * k, k, -k), k) for k in range(3)])
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    out = tmp_path / "out"
    arguments = [
        "process",
        "align",
        tmp_path / "stack.tif",
        "-o",
        out,
        "--model",
        "rigid",
        "--method",
        "mismatch",
        "-q",
    ]
    assert run([str(a) for a in arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    assert {path.name for path in out.iterdir()} == set(report["files"])
    with (out / "mismatch.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert {(line["first"], line["second"]) for line in lines} == {("0", "1"), ("0", "2"), ("1", "2")}
    first = [line for line in lines if line["second"] == "1" and line["axis"] == "x"]
    lowest = min(first, key=lambda line: float(line["mismatch"]))
    assert abs(float(lowest["offset"])) <= 0.5
    found = [np.array(s["matrix"]) for s in json.loads((out / "transforms.json").read_text())["sections"]]
    for k, matrix in enumerate(found):
        assert distance_px(matrix, placed(2 * k, k, -k), SHAPE) < 0.2


def test_isotropy_takes_out_what_neighbours_cannot_tell(tmp_path: Path, capsys):
    picture = face(5, round_features=True)
    stack = np.stack([taken(picture, placed(k, 0, 0, 0.15), k) for k in range(3)])
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    arguments = [tmp_path / "stack.tif", "-o", tmp_path / "out", "--model", "affine", "--isotropic", "features"]
    assert run(["process", "align", *map(str, arguments)]) == 0
    assert "is compressed by" in capsys.readouterr().err
    said = json.loads((tmp_path / "out" / "transforms.json").read_text())["sections"]
    for section in said:
        assert abs(section["compression"]["ratio"] - 0.15) < 0.05
    points = np.random.default_rng(0).random((9, 2)) * SIDE
    again = fitted("affine", points, points)
    np.testing.assert_allclose(again, np.eye(3), atol=1e-9)
