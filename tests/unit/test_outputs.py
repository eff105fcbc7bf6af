"""What lands in the folder: depth, units, pictures, report; all of it or nothing."""

from __future__ import annotations

import errno
import json
import resource
import subprocess
import sys
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.errors import InputError, StoreError
from processing.focus import FocusResult
from processing.outputs import FILES, check_folder, disk_error, write_focus_result
from processing.pictures import MapWords, captioned, draw_map, preview, range_map, shown_limits

if TYPE_CHECKING:
    from pathlib import Path

RANGE = np.linspace(-3.0, 9.0, 40 * 60, dtype=np.float32).reshape(40, 60)


def made(dtype: str = "uint16", *, colour: bool = False, unit: str = "um") -> FocusResult:
    rng = np.random.default_rng(1)
    image = rng.integers(0, np.iinfo(dtype).max, (40, 60, 3) if colour else (40, 60)).astype(dtype)
    confidence = np.where(np.arange(60) < 45, 2.0, 0.1).astype(np.float32)[np.newaxis].repeat(40, 0)
    return FocusResult(
        extended_focus=image,
        range=RANGE,
        confidence=confidence,
        plane=np.rint(RANGE + 3).astype(np.uint16),
        width=np.full(RANGE.shape, 2, np.float32),
        unit=unit,  # type: ignore[arg-type]
        noise=1.5,
        share_confident=0.75,
        parameters={"method": "brightfield", "confident": 0.8, "width": np.float32(1.5), "limits": (1, np.int64(2))},
    )


def png(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("colour", [False, True])
def test_images_keep_depth_colour_and_pixel_size(tmp_path: Path, dtype: str, colour: bool) -> None:
    result = made(dtype, colour=colour)
    write_focus_result(result, tmp_path / "out", pixel_um=0.25)
    image = tifffile.imread(tmp_path / "out" / "extended_focus.tif")
    assert image.dtype == dtype
    assert np.array_equal(image, result.extended_focus)
    assert np.array_equal(tifffile.imread(tmp_path / "out" / "range.tif"), RANGE)
    assert tifffile.imread(tmp_path / "out" / "confidence.tif").dtype == np.float32
    assert tifffile.imread(tmp_path / "out" / "plane.tif").dtype == np.uint16
    with tifffile.TiffFile(tmp_path / "out" / "range.tif") as file:
        tags = file.pages.first.tags  # type: ignore[union-attr]
        assert tags["XResolution"].value == (40000, 1)
        assert tags["ResolutionUnit"].value == tifffile.RESUNIT.CENTIMETER
        assert tags["ImageDescription"].value == "range in um"


def test_the_report_says_everything_in_plain_json(tmp_path: Path) -> None:
    returned = write_focus_result(made(), tmp_path, pixel_um=0.5, facts={"seconds": 1.5, "notes": ["as it is"]})
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["unit"] == "um"
    assert report["method"] == "brightfield"
    assert report["noise_grey_levels"] == 1.5
    assert report["share_confident"] == 0.75
    assert report["parameters"]["width"] == 1.5
    assert report["notes"] == ["as it is"]
    assert report["seconds"] == 1.5
    assert "numpy" in report["versions"]
    assert report["range"]["min"] == returned["range"]["min"] == pytest.approx(-3.0)
    assert sorted(report["files"]) == sorted(path.name for path in tmp_path.iterdir())


def test_results_that_are_there_are_not_touched_unless_told(tmp_path: Path) -> None:
    write_focus_result(made(), tmp_path)
    before = (tmp_path / "report.json").stat().st_mtime_ns
    with pytest.raises(InputError, match="holds results already") as error:
        check_folder(tmp_path)
    assert (error.value.code, error.value.exit_code) == ("output-exists", 2)
    with pytest.raises(InputError):
        write_focus_result(made(), tmp_path)
    assert (tmp_path / "report.json").stat().st_mtime_ns == before
    write_focus_result(made("uint8"), tmp_path, overwrite=True)
    assert tifffile.imread(tmp_path / "extended_focus.tif").dtype == np.uint8


def test_a_folder_that_holds_other_things_is_welcome(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    write_focus_result(made(), tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(InputError, match="is a file"):
        check_folder(tmp_path / "out")
    with pytest.raises(StoreError, match="cannot write to") as error:
        write_focus_result(made(), tmp_path / "out" / "deeper")
    assert error.value.exit_code == 6


REFUSED = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_outputs import made
from devices.errors import StoreError
from processing.outputs import write_focus_result
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
try:
    write_focus_result(made(), Path(sys.argv[1]))
except StoreError as error:
    print(error.code, error.exit_code)
"""


def test_a_full_disk_keeps_nothing(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    """A limit of file size stands for the full disk: it refuses the same writes and needs no mount."""
    tests = str(pytestconfig.rootpath / "tests" / "unit")
    done = subprocess.run([sys.executable, "-c", REFUSED, str(tmp_path), tests], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("disk-full 6\n", "")
    assert list(tmp_path.iterdir()) == []
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 6000


def test_a_disk_that_refuses_is_told_from_a_full_one(tmp_path: Path) -> None:
    assert disk_error(tmp_path / "not" / "yet", OSError(errno.ENOSPC, "")).code == "disk-full"
    assert disk_error(tmp_path, OSError(errno.EACCES, "")).code == "store"


def test_previews_are_pictures_of_the_right_size(tmp_path: Path) -> None:
    write_focus_result(made("uint16", colour=True), tmp_path, pixel_um=0.5)
    assert png(tmp_path / "extended_focus.png").shape == (40, 60, 3)
    assert png(tmp_path / "extended_focus.png").dtype == np.uint8
    for name in ("range.png", "confidence.png"):
        assert min(png(tmp_path / name).shape[:2]) > 300


def test_preview_stretches_16_bit_and_leaves_8_bit() -> None:
    ramp = np.linspace(1000, 5000, 2048).astype(np.uint16).reshape(32, 64)
    assert preview(ramp).min() == 0
    assert preview(ramp).max() == 255
    assert np.array_equal(preview(np.full((3, 3), 9, np.uint8)), np.full((3, 3), 9))
    assert preview(np.full((3, 3), 900, np.uint16)).dtype == np.uint8


def test_limits_come_from_what_is_sure() -> None:
    values = np.linspace(0, 10, 1000)
    assert shown_limits(values, values < 5)[1] < 5.01
    assert shown_limits(values, values < 0)[1] > 9.9
    assert shown_limits(np.full(9, 4.0)) == (3.5, 4.5)


def test_the_map_shows_the_values_as_colours() -> None:
    """Left half low, right half high: the ends of the colour map, in picture and bar."""
    values = np.zeros((50, 80), np.float32)
    values[:, 40:] = 1.0
    picture = draw_map(values, (0.0, 1.0), MapWords("", ""), "viridis", None).reshape(-1, 3).astype(int)
    for end in ([68, 1, 84], [253, 231, 36]):
        near = np.abs(picture - end).max(axis=1) <= 3
        assert near.sum() > 100_000


def test_what_is_not_sure_is_paler() -> None:
    values = np.zeros((50, 80), np.float32)
    sure = range_map(values, np.full_like(values, 2.0), 0.8, "um", 0.5)
    unsure = range_map(values, np.zeros_like(values), 0.8, "um", 0.5)
    assert unsure.mean() > sure.mean() + 20


@pytest.mark.parametrize("width", [40, 300, 2000])
def test_a_caption_keeps_the_picture_as_it_is(width: int) -> None:
    image = np.random.default_rng(2).integers(0, 256, (30, width, 3), np.uint8)
    with_words = captioned(image, "parallax -3.0 … +3.0 px, 1 µm")
    assert with_words.shape[1:] == (width, 3)
    assert np.array_equal(with_words[:30], image)
    assert with_words[30:].max() > 60


def test_nothing_but_the_results_is_left(tmp_path: Path) -> None:
    write_focus_result(made(), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
