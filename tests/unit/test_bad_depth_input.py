"""What makes no sense to the commands that find depth: one clear error, or a result that says what it is worth."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from devices.cli import run

SIDE = 96


def grain(seed: int, side: int = SIDE) -> np.ndarray:
    made = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(side, side)), (0, 0), 2)
    return np.clip(128 + 40 * made / made.std(), 0, 255).astype(np.uint8)


def noisy(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(9)
    return [np.clip(grain(1) + rng.normal(0, 3, (SIDE, SIDE)), 0, 255).astype(np.uint8) for _ in range(count)]


COLOUR = np.stack([grain(1)] * 3, axis=-1)
HOLES = np.where(grain(1) > 200, np.nan, grain(1)).astype(np.float32)
STACKS = {
    "featureless": [np.full((SIDE, SIDE), 9, np.uint8)] * 3,
    "saturated": [np.full((SIDE, SIDE), 255, np.uint8)] * 3,
    "single": [grain(1)],
    "no overlap": [grain(1), grain(2), grain(3)],
    "no overlap, small": [grain(k, 48) for k in (1, 2, 3)],
    "huge outlier": [*noisy(2), grain(4, 900)],
    "colour with grey": [grain(1), COLOUR, grain(1)],
    "not numbers": [HOLES] * 3,
    "one blank": [*noisy(2), np.full((SIDE, SIDE), 90, np.uint8), *noisy(2)],
    "one foreign": [*noisy(2), grain(7), *noisy(2)],
    "duplicates": [grain(1)] * 3,
}
ALIGN = {
    "featureless": "align-no-match",
    "saturated": "align-no-match",
    "single": "align-one",
    "no overlap, small": "align-no-match",
    "huge outlier": "stack-shape",
    "colour with grey": "stack-shape",
    "not numbers": "stack-nan",
}
FLAGGED = {"one blank": {"2": ["blank"]}, "duplicates": {"1": ["duplicate"], "2": ["duplicate"]}}
VIEWS = {
    "saturated": (STACKS["saturated"][0], grain(1), "stereo-featureless"),
    "one picture twice": (grain(1), grain(1), "stereo-same"),
    "two fields": (grain(1), grain(2), "stereo-no-match"),
    "sizes": (grain(1), grain(1, 64), "stereo-size"),
    "not numbers": (HOLES, HOLES, "stack-nan"),
}


def folder(path: Path, pictures: list[np.ndarray]) -> str:
    path.mkdir()
    for k, picture in enumerate(pictures):
        kind = "rgb" if picture.ndim == 3 else "minisblack"
        tifffile.imwrite(path / f"{k:03}.tif", picture, photometric=kind)
    return str(path)


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Runs a command that must end with one clear error and leave nothing."""

    def check(arguments: list[str], code: str) -> None:
        assert run(["process", *arguments, "-o", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert f"error[{code}]" in said
        assert "fix:" in said
        assert "Traceback" not in said
        assert not (tmp_path / "out").exists()

    return check


@pytest.mark.parametrize(("kind", "code"), ALIGN.items())
def test_sections_that_cannot_be_aligned_are_an_error(kind, code, tmp_path, refused):
    refused(["align", folder(tmp_path / "in", STACKS[kind]), "--model", "rigid", "-q"], code)


@pytest.mark.parametrize("method", ["mismatch", "phase"])
def test_no_single_method_lays_other_specimens_on_each_other(method, tmp_path, refused):
    stack = folder(tmp_path / "in", STACKS["no overlap"])
    refused(["align", stack, "--model", "rigid", "--method", method, "-q"], "align-no-match")


@pytest.mark.parametrize("kind", ["one blank", "one foreign", "duplicates"])
def test_sections_that_can_be_doubted_are_flagged(kind, tmp_path):
    stack, out = folder(tmp_path / "in", STACKS[kind]), tmp_path / "out"
    assert run(["process", "align", stack, "-o", str(out), "--model", "rigid", "-q"]) == 0
    flags = json.loads((out / "report.json").read_text())["flags"]
    assert flags == FLAGGED.get(kind, flags)
    assert kind != "one foreign" or "unmatched" in flags["2"]


@pytest.mark.parametrize("kind", ["saturated", "duplicates", "no overlap"])
def test_a_range_that_is_sure_nowhere_says_so(kind, tmp_path):
    stack, out = folder(tmp_path / "in", STACKS[kind]), tmp_path / "out"
    assert run(["process", "focus", stack, "-o", str(out), "-q"]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["share_confident"] < 0.02
    assert any("sure in" in note for note in report["notes"])


@pytest.mark.parametrize("kind", VIEWS)
def test_views_without_depth_are_an_error(kind, tmp_path, refused):
    left, right, code = VIEWS[kind]
    paths = [str(tmp_path / name) for name in ("l.tif", "r.tif")]
    for path, view in zip(paths, (left, right), strict=True):
        tifffile.imwrite(path, view, photometric="minisblack")
    refused(["elevation", *paths, "--tilt-deg", "8", "--pixel-um", "1", "-q"], code)


@pytest.mark.parametrize("kind", ["featureless", "saturated", "no overlap"])
def test_pictures_without_indents_are_an_error(kind, tmp_path, refused):
    folder(tmp_path / "in", STACKS[kind])
    pictures = [str(tmp_path / "in" / f"{k:03}.tif") for k in (0, 1)]
    refused(["indents", *pictures, "--pixel-um", "0.1"], "indents-none")


@pytest.mark.parametrize("command", ["align", "focus", "resample", "deblur"])
@pytest.mark.parametrize("step", ["0", "-1", "nan"])
def test_a_spacing_that_cannot_be_is_an_error(command, step, tmp_path, refused):
    more = {"resample": ["--pixel-um", "1"], "deblur": ["--na", "0.8", "--wavelength-um", "0.5", "--pixel-um", "0.1"]}
    stack = folder(tmp_path / "in", STACKS["no overlap, small"])
    refused([command, stack, "--step-um", step, *more.get(command, []), "-q"], "stack-spacing")
