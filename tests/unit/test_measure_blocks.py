"""Measuring slab by slab gives what measuring in memory gives, bit for bit, and refuses what cannot go so."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile
from scipy import ndimage
from skimage.measure import label

from devices.cli import run
from processing import features, measure_blocks, planes
from processing.parts import Parts
from processing.picked import Picked
from processing.planes import Lazy
from processing.whole import whole

if TYPE_CHECKING:
    from pathlib import Path

RNG = np.random.default_rng(84)
SHAPE = (21, 22, 25)
GREY = np.clip(110 + 500 * ndimage.gaussian_filter(RNG.normal(size=SHAPE), 1.3), 0, 255).astype(np.uint8)
SIZES = ["--step-um", "2", "--pixel-um", "0.5"]
FILES = ("features.csv", "numbers.csv", "cuts.png", "sizes.svg", "size_and_shape.svg", "grey_values.svg")


def lazy(values, side: int = 4) -> Lazy:
    return Lazy(values.shape, values.dtype, lambda z: values[z], side)


def measure(data: Path, out: Path, *words: str) -> int:
    return run(["measure", str(data), "-o", str(out), "-q", *words])


@pytest.mark.parametrize("rule", [6, 18, 26])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_parts_and_cavities_go_on_from_slab_to_slab(rule: int, share: float) -> None:
    mask = RNG.random((13, 9, 10)) < share
    parts = Parts(rule)
    for start in range(0, 13, 4):
        parts.add(mask[start : start + 4])
    numbers = label(mask, connectivity={6: 1, 18: 2, 26: 3}[rule])
    inner = np.zeros(mask.shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    assert parts.total() == (numbers.max(), numbers.max() - len(set(np.unique(numbers[~inner])) - {0}))


def test_the_whole_is_the_same_from_slabs() -> None:
    one, other = whole(GREY > 120), whole(lazy(GREY > 120))
    for name in one.__dataclass_fields__:
        np.testing.assert_equal(getattr(other, name), getattr(one, name))


def test_a_profile_is_the_same_from_slabs() -> None:
    line = Picked("line", np.array([(0.0, 2, 3), (20.4, 20, 11), (7.5, 3, 24)]))
    whole_at, values = line.profile(GREY, (2.0, 0.5, 0.5))
    at, same = line.profile(lazy(GREY), (2.0, 0.5, 0.5))
    places = [np.interp(at, [0, *np.cumsum(np.linalg.norm(np.diff(line.points * (2, 0.5, 0.5), axis=0), axis=1))], p)
              for p in line.points.T]  # fmt: skip
    np.testing.assert_array_equal(at, whole_at)
    np.testing.assert_allclose(same, values, rtol=1e-12)
    np.testing.assert_allclose(values, ndimage.map_coordinates(GREY.astype(float), places, order=1, mode="nearest"))


QUESTIONS = [
    (GREY, ["--first", "filter.median:rule=6", "--neighbours", "6", "--smallest", "4", "--dark", *SIZES]),
    (GREY + np.float32(0.25), ["--threshold", "170", "--balls"]),
]


@pytest.mark.parametrize(("grey", "words"), QUESTIONS)
def test_the_command_leaves_the_same_files_block_by_block(
    grey: np.ndarray, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure_blocks, "SIDE", 4)
    monkeypatch.setattr(planes, "SIDE", 4)
    monkeypatch.setattr(features, "AT_ONCE", 7)
    data = tmp_path / "grey.npy"
    np.save(data, grey)
    assert measure(data, tmp_path / "whole", *words) == 0
    assert measure(data, tmp_path / "blocks", *words, "--memory", "100GB") == 0
    one, other = (json.loads((tmp_path / name / "report.json").read_text()) for name in ("whole", "blocks"))
    assert other["blocks"] == {"planes": 4, "memory": "100GB"}
    assert {k: one[k] for k in ("numbers", "notes", "question", "files", "features")} == {
        k: other[k] for k in ("numbers", "notes", "question", "files", "features")
    }
    assert len(one["numbers"]) == 16
    for name in FILES:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "blocks" / name).read_bytes(), name
    labels = [tifffile.imread(tmp_path / name / "labels.ome.tif") for name in ("whole", "blocks")]
    np.testing.assert_array_equal(*labels)
    assert not list((tmp_path / "blocks").glob(".*"))


def test_labels_go_block_by_block(tmp_path: Path) -> None:
    labels = np.where(GREY > 130, GREY // 40, 0).astype(np.uint16)
    np.save(tmp_path / "labels.npy", labels)
    for name, more in (("whole", []), ("blocks", ["--memory", "100GB"])):
        assert measure(tmp_path / "labels.npy", tmp_path / name, "--labels", *SIZES, *more) == 0
    for name in ("features.csv", "numbers.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "blocks" / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--memory", "100GB", "--fill"], "blockwise"),
        (["--memory", "100GB", "--first", "distance.map"], "blockwise"),
        (["--memory", "1MB"], "memory"),
        (["--memory", "much"], "memory"),
        (["--memory", "100GB", "--threshold", "255"], "mask-empty"),
    ],
)
def test_what_cannot_be_measured_block_by_block_is_told(words: list[str], code: str, tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "grey.npy", GREY)
    assert measure(tmp_path / "grey.npy", tmp_path / "out", *words) == 2
    assert capsys.readouterr().err.count(f"error[{code}]") == 1
    assert not (tmp_path / "out").exists()


def test_a_table_that_takes_too_much_memory_is_refused(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(measure_blocks, "BYTES_PER_FEATURE", 1e11)
    np.save(tmp_path / "grey.npy", GREY)
    assert measure(tmp_path / "grey.npy", tmp_path / "out", "--memory", "100GB") == 2
    assert "--smallest" in capsys.readouterr().err
