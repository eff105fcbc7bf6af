"""Folders of images as stacks: order, series, colour, and every way in which the files may disagree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile

from devices.errors import InputError
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path


def grey(value: int, shape: tuple[int, ...] = (12, 16), dtype: str = "uint8") -> np.ndarray:
    return np.full(shape, value, dtype)


def write(folder: Path, names: dict[str, np.ndarray]) -> Path:
    for name, pixels in names.items():
        if name.endswith(".tif"):
            tifffile.imwrite(folder / name, pixels)
        else:
            cv2.imwrite(str(folder / name), pixels)
    return folder


def test_frame_2_comes_before_frame_10(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {f"frame_{k}.png": grey(k) for k in (10, 9, 2, 1, 8, 3, 4, 5, 6, 7)}))
    assert [int(plane[0, 0]) for plane in stack] == list(range(1, 11))


def test_16_bit_png_keeps_every_bit(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 65536, (2, 20, 30), np.uint16)
    stack = open_stack(write(tmp_path, {"a1.png": pixels[0], "a2.png": pixels[1]}))
    assert stack.dtype == np.uint16
    assert np.array_equal(np.stack(list(stack)), pixels)


@pytest.mark.parametrize("bands", [3, 4])
def test_colour_is_red_green_blue_without_alpha(tmp_path: Path, bands: int) -> None:
    bgra = np.zeros((5, 6, bands), np.uint8)
    bgra[..., 2] = 200
    stack = open_stack(write(tmp_path, {"a1.png": bgra, "a2.png": bgra}))
    assert stack.colour
    assert stack[0].shape == (5, 6, 3)
    assert stack[0][0, 0].tolist() == [200, 0, 0]


def test_tiff_and_png_of_the_same_pixels_agree(tmp_path: Path) -> None:
    pixels = np.random.default_rng(2).integers(0, 65536, (9, 7), np.uint16)
    (tmp_path / "t").mkdir()
    (tmp_path / "p").mkdir()
    tiff = open_stack(write(tmp_path / "t", {"z1.tif": pixels, "z2.tif": pixels}))
    png = open_stack(write(tmp_path / "p", {"z1.png": pixels, "z2.png": pixels}))
    assert np.array_equal(tiff[1], png[1])


def test_two_series_ask_for_a_choice_and_take_it(tmp_path: Path) -> None:
    write(tmp_path, {f"E07_w{w}_z{z:02d}.png": grey(10 * w + z) for w in (1, 2) for z in (1, 2, 3)})
    with pytest.raises(InputError, match=r"2 channels: 0 E07_w1_z#.png \(3 images\), 1 E07_w2") as error:
        open_stack(tmp_path)
    assert "--channel" in error.value.message()
    assert [int(p[0, 0]) for p in open_stack(tmp_path, channel=1)] == [21, 22, 23]


def test_channel_behind_the_plane_number_is_a_series_too(tmp_path: Path) -> None:
    write(tmp_path, {f"img_z{z}_ch{c}.png": grey(10 * c + z) for c in (0, 1) for z in (1, 2)})
    assert [int(p[0, 0]) for p in open_stack(tmp_path, channel=1)] == [11, 12]


def test_dates_in_names_are_no_series(tmp_path: Path) -> None:
    names = ["shot 12h59m58.png", "shot 12h59m59.png", "shot 13h00m01.png"]
    stack = open_stack(write(tmp_path, {name: grey(k) for k, name in enumerate(names)}))
    assert [int(p[0, 0]) for p in stack] == [0, 1, 2]


def test_a_picture_that_is_not_of_the_series_is_left_out_and_named(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {"pcb_1.png": grey(1), "pcb_2.png": grey(2), "fused.png": grey(9)}))
    assert len(stack) == 2
    assert "fused.png" in stack.notes[0]


def test_a_pattern_takes_the_files_it_names(tmp_path: Path) -> None:
    write(tmp_path, {"a_1.png": grey(1), "a_2.png": grey(2), "b_1.png": grey(3), "b_2.png": grey(4)})
    assert [int(p[0, 0]) for p in open_stack(tmp_path / "b_*.png")] == [3, 4]


def test_a_missing_number_keeps_its_place(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {f"z{k}.png": grey(k) for k in (3, 4, 6)}), step_um=2.0)
    assert stack.z_um is not None
    assert stack.z_um.tolist() == [0, 2, 6]
    assert "number 5" in stack.notes[0]


def test_sizes_that_differ_name_both_files_and_sizes(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {"a1.png": grey(1), "a2.png": grey(2, (12, 17))}))
    with pytest.raises(InputError, match=r"a1.png is 16×12 px grey uint8, a2.png is 17×12 px grey uint8"):
        list(stack)


def test_grey_among_colour_is_refused(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {"a1.png": grey(1, (12, 16, 3)), "a2.png": grey(2)}))
    with pytest.raises(InputError, match=r"a1.png is 16×12 px colour uint8, a2.png is 16×12 px grey uint8"):
        list(stack)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_a_cut_file_is_named(tmp_path: Path, suffix: str, share: float) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (40, 50), np.uint8)
    write(tmp_path, {f"a1.{suffix}": pixels, f"a2.{suffix}": pixels})
    whole = (tmp_path / f"a2.{suffix}").read_bytes()
    (tmp_path / f"a2.{suffix}").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=rf"a2.{suffix} is damaged") as error:
        list(open_stack(tmp_path))
    assert error.value.code == "input-damaged"


def test_an_empty_folder_says_where_images_are(tmp_path: Path) -> None:
    (tmp_path / "stack7").mkdir()
    write(tmp_path / "stack7", {"a1.png": grey(1)})
    with pytest.raises(InputError, match="holds no images") as error:
        open_stack(tmp_path)
    assert "stack7" in error.value.message()


def test_one_plane_works_and_says_what_it_cannot_know(tmp_path: Path) -> None:
    stack = open_stack(write(tmp_path, {"only.png": grey(1)}), step_um=2.0)
    assert len(stack) == 1
    assert stack.z_um is None
    assert "nothing can be said about depth" in stack.notes[0]


@pytest.mark.parametrize("step_um", [float("nan"), 0.0, -1.0, float("inf")])
def test_a_spacing_that_makes_no_sense_is_refused(tmp_path: Path, step_um: float) -> None:
    write(tmp_path, {"a1.png": grey(1), "a2.png": grey(2)})
    with pytest.raises(InputError, match="--step-um gives a plane spacing of"):
        open_stack(tmp_path, step_um=step_um)


def test_what_is_not_there_or_unknown_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no"):
        open_stack(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(InputError, match="of no known kind"):
        open_stack(tmp_path / "notes.txt")
