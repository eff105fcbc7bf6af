"""Stacks of made sections: what is wrong is flagged and bridged, what cannot be known is said, marks hold shapes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run
from devices.errors import InputError
from processing.align_mark_search import find_marks
from processing.align_models import applied, deformation, distance_px
from processing.align_stack import SectionAligner

if TYPE_CHECKING:
    from pathlib import Path

SIDE = 160
SHAPE = (SIDE, SIDE)
MARKS = np.array([(30.0, 28.0), (128.0, 35.0), (34.0, 126.0), (125.0, 130.0)])


def grain(rng: np.random.Generator) -> np.ndarray:
    found = cv2.GaussianBlur(rng.normal(size=(2 * SIDE, 2 * SIDE)).astype(np.float32), (0, 0), 2.5)
    return found / found.std()


def placed(turn_deg: float, x: float, y: float, compression: float = 0.0, along_deg: float = 0.0) -> np.ndarray:
    angles, middle = np.radians([turn_deg, along_deg]), np.full(2, (SIDE - 1) / 2)
    turn, axis = (np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles)
    matrix = np.eye(3)
    matrix[:2, :2] = turn @ axis @ np.diag([1 - compression, 1.0]) @ axis.T
    matrix[:2, 2] = middle - matrix[:2, :2] @ middle + (x, y)
    return matrix


def scattered(count: int, seed: int, compression: float = 0.0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    places = [
        placed(*rng.uniform(-5, 5, 3), compression * rng.uniform(0.5, 1), rng.uniform(0, 180)) for _ in range(count)
    ]
    return [np.eye(3), *places[1:]]


def made(
    matrices: list[np.ndarray], seed: int = 3, lean_px: float = 0.0, *, marks: bool = False, contrast: float = 25.0
) -> list[np.ndarray]:
    """Photograph faces that change slowly; ``lean_px`` a section is the specimen's own."""
    rng = np.random.default_rng(seed)
    ends, out = (grain(rng), grain(rng)), []
    to_face = np.array([[1, 0, -SIDE / 2], [0, 1, -SIDE / 2], [0, 0, 1.0]])
    for k, matrix in enumerate(matrices):
        share = 0.3 * k / max(len(matrices) - 1, 1)
        lean = np.array([[1, 0, lean_px * k], [0, 1, 0], [0, 0, 1.0]])
        face = 128 + contrast * ((1 - share) * ends[0] + share * ends[1])
        section = cv2.warpAffine(face, (matrix @ lean @ to_face)[:2], SHAPE, flags=cv2.INTER_CUBIC)
        section += rng.normal(0, 3, SHAPE)
        for x, y in applied(matrix, MARKS) if marks else ():
            yy, xx = np.mgrid[:SIDE, :SIDE]
            cover = np.clip(4.5 - np.hypot(xx - x, yy - y), 0, 1)
            section += cover * (10 - section)
        out.append(section.clip(0, 255).astype(np.uint8))
    return out


def aligned(sections, model="rigid", **finish):
    aligner = SectionAligner(model)
    for section in sections:
        aligner.add(section)
    return aligner.finish(**finish)


@pytest.mark.parametrize("spoil", ["blank", "saturated", "foreign", "folded", "blurred"])
def test_a_spoilt_section_is_flagged_and_its_neighbours_keep_their_places(spoil):
    matrices = scattered(6, 1)
    sections = made(matrices)
    whole = sections[3].astype(np.float32)
    sections[3] = {
        "blank": lambda: np.full(SHAPE, 90, np.uint8),
        "saturated": lambda: np.full(SHAPE, 255, np.uint8),
        "foreign": lambda: made([np.eye(3)], seed=99)[0],
        "folded": lambda: np.hstack([sections[3][:, :50], sections[3][:, 110:50:-1], sections[3][:, 110:]]),
        "blurred": lambda: cv2.GaussianBlur(whole, (0, 0), 7).astype(np.uint8),
    }[spoil]()
    found = aligned(sections)
    flags = [section.flags for section in found.sections]
    assert flags[3]
    assert not any(flags[:3] + flags[4:])
    for k in (1, 2, 4, 5):
        assert distance_px(found.sections[k].matrix, matrices[k], SHAPE) < 0.3


def test_a_duplicate_and_a_gap_are_told():
    sections = made(scattered(5, 2))
    sections[2] = sections[1]
    flags = [section.flags for section in aligned(sections, gaps=[4]).sections]
    assert flags == [(), (), ("duplicate",), (), ("gap",)]


def test_sections_of_two_specimens_are_not_laid_on_each_other():
    sections = made(scattered(3, 1)) + made(scattered(3, 2), seed=50)
    found = aligned(sections)
    assert [bool(section.flags) for section in found.sections] == [False] * 3 + [True] * 3
    assert {flag for section in found.sections[3:] for flag in section.flags} >= {"unconnected"}


@pytest.mark.parametrize(
    "sections",
    [
        [made([np.eye(3)], seed=s)[0] for s in (1, 2, 3)],
        [np.full(SHAPE, 9, np.uint8)] * 3,
        [np.random.default_rng(s).integers(0, 255, SHAPE, np.uint8) for s in (1, 2, 3)],
    ],
    ids=["no overlap", "featureless", "noise"],
)
def test_what_has_nothing_in_common_is_an_error_not_a_map(sections):
    with pytest.raises(InputError, match="not one pair"):
        aligned(sections)


@pytest.mark.parametrize("turn", [35.0, 90.0, 179.0, -120.0])
def test_any_turn_is_found(turn):
    matrices = [np.eye(3), placed(turn, 4, -6)]
    assert distance_px(aligned(made(matrices)).sections[1].matrix, matrices[1], SHAPE) < 0.1


@pytest.mark.parametrize("along", [0.0, 35.0, 90.0, 140.0])
def test_a_fifth_of_compression_along_any_direction_comes_out_with_its_direction(along):
    matrices = [np.eye(3), placed(3, 2, -3, 0.2, along)]
    found = aligned(made(matrices), "affine").sections[1]
    assert distance_px(found.matrix, matrices[1], SHAPE) < 0.15
    assert found.deformation.compression == pytest.approx(0.2, abs=0.003)
    assert abs((found.deformation.direction_deg - (along + 3) + 90) % 180 - 90) < 1


def test_sections_are_placed_on_arrival_as_at_the_end():
    matrices = scattered(6, 4, compression=0.1)
    aligner = SectionAligner("affine")
    arrived = [aligner.add(section) for section in made(matrices)]
    for early, late, true in zip(arrived, aligner.finish().matrices, matrices, strict=True):
        assert distance_px(early, late, SHAPE) < 0.2
        assert distance_px(late, true, SHAPE) < 0.3


def test_marks_are_found_to_a_tenth_and_hold_a_leaning_specimen():
    matrices = scattered(8, 6)
    sections = made(matrices, lean_px=1.0, marks=True, contrast=10.0)
    free = aligned(sections)
    marks = find_marks(sections, free.matrices, 0)
    for k, matrix in enumerate(matrices):
        off = np.linalg.norm(applied(matrix, MARKS)[:, None] - marks.places[k], axis=2).min(axis=1)
        assert np.nanmedian(off) < 0.1
    held = aligned(sections, anchors=marks.rows("rigid", 0))
    errors = [[distance_px(m, t, SHAPE) for m, t in zip(a.matrices, matrices, strict=True)][-1] for a in (free, held)]
    assert errors[0] > 4
    assert errors[1] < 0.2


@pytest.mark.parametrize("trend", ["remove", "keep", "model"])
def test_without_marks_the_command_warns_and_leaves_the_trend_to_whom_it_is_told(tmp_path: Path, capsys, trend):
    count, lean = 8, 1.5
    tifffile.imwrite(tmp_path / "s.tif", np.stack(made([np.eye(3)] * count, lean_px=lean)), photometric="minisblack")
    out = tmp_path / "out"
    arguments = ["process", "align", str(tmp_path / "s.tif"), "-o", str(out), "--model", "rigid", "--trend", trend]
    assert run(arguments) == 0
    said = capsys.readouterr().err
    assert "not unique" in said
    assert "stands out" in said
    last = np.array(json.loads((out / "transforms.json").read_text())["sections"][-1]["matrix"])
    expected = lean * (count - 1) if trend == "remove" else 0.0
    assert last[0, 2] == pytest.approx(expected, abs=0.4)
    assert deformation(last).rotation_deg == pytest.approx(0, abs=0.1)


def test_a_spoilt_section_is_interpolated_only_when_asked_for_and_marked(tmp_path: Path):
    sections = made([np.eye(3)] * 4)
    sections[1] = np.full(SHAPE, 90, np.uint8)
    tifffile.imwrite(tmp_path / "s.tif", np.stack(sections), photometric="minisblack")
    seen = {}
    for extra in ((), ("--interpolate",)):
        out = tmp_path / f"out{len(extra)}"
        assert run(["process", "align", str(tmp_path / "s.tif"), "-o", str(out), "--model", "rigid", "-q", *extra]) == 0
        told = json.loads((out / "report.json").read_text())
        seen[extra] = tifffile.imread(out / "aligned.ome.tif")[:, 20:-20, 20:-20], told["flags"], told["interpolated"]
    assert seen[()][1:] == ({"1": ["blank"]}, {})
    assert np.ptp(seen[()][0][1]) == 0
    volume, flags, made_of = seen["--interpolate",]
    assert flags == {"1": ["blank", "interpolated"]}
    assert made_of == {"1": {"before": 0, "after": 2}}
    expected = (volume[0].astype(float) + volume[2]) / 2
    assert np.abs(volume[1] - expected).max() <= 1


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        (("--reference", "9"), "align-reference"),
        (("--fiducials", "auto"), "align-marks"),
        (("--fiducials", "table.csv"), "align-marks"),
        (("--fiducials", "missing.csv"), "input-missing"),
    ],
)
def test_bad_choices_are_one_clear_error(tmp_path: Path, capsys, monkeypatch, extra, code):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("section,mark\n0,1\n")
    tifffile.imwrite(tmp_path / "s.tif", np.stack(made(scattered(3, 1))), photometric="minisblack")
    assert run(["process", "align", "s.tif", "-o", "out", "--model", "rigid", *extra, "-q"]) == 2
    assert f"error[{code}]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_blank_first_section_is_not_what_the_others_are_laid_upon(tmp_path: Path):
    images = made(scattered(5, 21))
    images[0] = np.zeros_like(images[0])
    tifffile.imwrite(tmp_path / "stack.tif", np.stack(images), photometric="minisblack")
    out = tmp_path / "out"
    assert run(["process", "align", str(tmp_path / "stack.tif"), "-o", str(out), "--model", "rigid", "-q"]) == 0
    said = json.loads((out / "transforms.json").read_text())
    assert said["reference"] == 1
    assert [s["flags"] for s in said["sections"]] == [["blank"], [], [], [], []]


def test_sections_compressed_across_each_other_are_each_uniaxial_against_the_reference():
    matrices = scattered(5, 31, compression=0.15)
    found = aligned(made(matrices, 31), "uniaxial")
    assert max(distance_px(s.matrix, m, SHAPE) for s, m in zip(found.sections, matrices, strict=True)) < 0.15
