"""OME-Zarr and run folders as stacks: axes, units, colour, missing and damaged pieces."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zarr

from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import InputError, StereotomeError
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

UNITS = {"z": "nanometer", "y": "micrometer", "x": "micrometer"}


def write_image(
    path: Path, data: np.ndarray, axes: str, version: str = "0.5", scale: float = 500.0, **extra: Any
) -> Path:
    group = zarr.create_group(path, zarr_format=3 if version == "0.5" else 2)
    chunks = tuple(1 if a in "tcz" else n for a, n in zip(axes, data.shape, strict=True))
    array = group.create_array("full", shape=data.shape, chunks=chunks, dtype=data.dtype)
    array[:] = data
    kinds = {"t": "time", "c": "channel"}
    unit = {a: {"unit": UNITS[a]} if a in UNITS else {} for a in axes}
    scales = [scale if a == "z" else 0.25 if a in "yx" else 1.0 for a in axes]
    steps = [{"type": "scale", "scale": scales}]
    if "z" in axes:
        steps.append({"type": "translation", "translation": [2000.0 if a == "z" else 0.0 for a in axes]})
    multiscale = {
        "axes": [{"name": a, "type": kinds.get(a, "space"), **unit[a]} for a in axes],
        "datasets": [{"path": "full", "coordinateTransformations": steps}],
        "version": version,
    }
    ome = {"multiscales": [multiscale], **extra}
    group.attrs.update({"ome": {**ome, "version": version}} if version == "0.5" else ome)
    return path


def numbers(*shape: int) -> np.ndarray:
    return np.random.default_rng(6).integers(0, 65536, shape, np.uint16)


@pytest.mark.parametrize("version", ["0.4", "0.5"])
@pytest.mark.parametrize("axes", ["zyx", "czyx", "tzyx", "tczyx"])
def test_axes_units_and_offset(tmp_path: Path, axes: str, version: str) -> None:
    planes = numbers(4, 6, 7)
    data = planes.reshape((1,) * (len(axes) - 3) + planes.shape)
    stack = open_stack(write_image(tmp_path / "a.ome.zarr", data, axes, version))
    assert np.array_equal(np.stack(list(stack)), planes)
    assert stack.z_um == pytest.approx(2.0 + 0.5 * np.arange(4))
    assert stack.pixel_um == pytest.approx(0.25)


def test_one_plane_of_two_axes(tmp_path: Path) -> None:
    stack = open_stack(write_image(tmp_path / "a.zarr", numbers(6, 7), "yx"))
    assert stack.shape == (6, 7)
    assert "nothing can be said about depth" in stack.notes[-1]


def test_no_plane_yet(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no plane"):
        open_stack(write_image(tmp_path / "a.zarr", numbers(0, 6, 7), "zyx"))


def test_scale_of_the_whole_image_comes_on_top(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx")
    group = zarr.open_group(path)
    ome = dict(group.attrs["ome"])
    ome["multiscales"][0]["coordinateTransformations"] = [{"type": "scale", "scale": [10.0, 1.0, 1.0]}]
    group.attrs["ome"] = ome
    assert open_stack(path).z_um == pytest.approx(20.0 + 5.0 * np.arange(3))


def test_channels_are_named_in_the_question(tmp_path: Path) -> None:
    data = numbers(2, 3, 4, 5)
    path = write_image(tmp_path / "a.zarr", data, "czyx", omero={"channels": [{"label": "DAPI"}, {"label": "FITC"}]})
    with pytest.raises(InputError, match="2 channels: 0 DAPI, 1 FITC"):
        open_stack(path)
    assert np.array_equal(open_stack(path, channel=1)[2], data[1, 2])


def test_red_green_blue_are_one_picture(tmp_path: Path) -> None:
    data = numbers(3, 2, 4, 5)
    channels = [{"label": label} for label in ("Red", "Green", "Blue")]
    stack = open_stack(write_image(tmp_path / "a.zarr", data, "czyx", omero={"channels": channels}))
    assert np.array_equal(stack[1], np.moveaxis(data[:, 1], 0, -1))


@pytest.mark.parametrize("scale", [0.0, float("nan")])
def test_a_scale_that_makes_no_sense(tmp_path: Path, scale: float) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx", scale=scale)
    with pytest.raises(InputError, match="the file gives a plane spacing"):
        open_stack(path)
    assert open_stack(path, step_um=1.0).z_um == pytest.approx([0, 1, 2])


def test_pieces_that_are_not_there_are_said_so(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx")
    (path / "full" / "c" / "1" / "0" / "0").unlink()
    assert "1 of 3 pieces of the array are not on disk" in open_stack(path).notes[0]


@pytest.mark.parametrize("version", ["0.4", "0.5"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_cut_piece_names_its_plane(tmp_path: Path, version: str, share: float) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 40, 50), "zyx", version)
    piece = path / "full" / ("c/1/0/0" if version == "0.5" else "1.0.0")
    whole = piece.read_bytes()
    piece.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="plane 1 is damaged"):
        list(open_stack(path))


@pytest.mark.parametrize("content", ["", "{", "[]", '{"zarr_format": 3, "node_type": "group"}', "\x00\xff"])
def test_metadata_that_make_no_sense_give_words(tmp_path: Path, content: str) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx")
    (path / "zarr.json").write_text(content)
    with pytest.raises(InputError):
        open_stack(path)


@pytest.mark.parametrize("wrong", [{"axes": [{"name": "z"}]}, {"axes": 7}, {"datasets": []}, {"datasets": [{}]}])
def test_multiscales_that_make_no_sense_give_words(tmp_path: Path, wrong: dict[str, Any]) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx")
    group = zarr.open_group(path)
    ome = dict(group.attrs["ome"])
    ome["multiscales"][0] |= wrong
    group.attrs["ome"] = ome
    with pytest.raises(InputError):
        open_stack(path)


def test_a_collection_of_one_image_is_that_image(tmp_path: Path) -> None:
    root = zarr.create_group(tmp_path / "a.zarr", zarr_format=2)
    root.attrs["bioformats2raw.layout"] = 3
    root.create_group("OME")
    write_image(tmp_path / "a.zarr" / "0", numbers(3, 4, 5), "zyx", "0.4")
    assert len(open_stack(tmp_path / "a.zarr")) == 3
    write_image(tmp_path / "a.zarr" / "1", numbers(3, 4, 5), "zyx", "0.4")
    with pytest.raises(InputError, match="not one OME-Zarr image") as error:
        open_stack(tmp_path / "a.zarr")
    assert "0, 1" in error.value.message()


def test_the_array_itself_points_to_its_image(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.zarr", numbers(3, 4, 5), "zyx")
    with pytest.raises(InputError) as error:
        open_stack(path / "full")
    assert "the folder above" in error.value.message()


def take_run(folder: Path, planes: np.ndarray, z_um: list[float], skip: tuple[int, ...] = ()) -> Path:
    layout = FocalArray(len(planes), planes.shape[1:], str(planes.dtype), 5.0, 1.0, 0.5)
    store = RunStore.create(folder, {"plan_id": "t"}, layout, SystemClock())
    for k, plane in enumerate(planes):
        if k not in skip:
            store.put(Frame(k, FrameHeader(k, 5.0 + k, z_um[k], 10.0), plane))
    store.finalise(RunEnd.COMPLETED)
    store.close()
    return folder


@pytest.mark.parametrize("bands", [(), (3,)])
def test_a_run_gives_its_planes_at_the_positions_read_back(tmp_path: Path, bands: tuple[int, ...]) -> None:
    planes, z_um = numbers(4, 20, 30, *bands), [5.01, 5.98, 7.02, 8.0]
    run = take_run(tmp_path / "run", planes, z_um)
    for path in (run, run / "focal.ome.zarr"):
        stack = open_stack(path)
        assert np.array_equal(np.stack(list(stack)), planes)
        assert stack.z_um == pytest.approx(z_um)
        assert stack.pixel_um == 0.5
        assert stack.notes == ()


def test_the_image_of_a_run_alone_says_the_same(tmp_path: Path) -> None:
    planes, z_um = numbers(4, 20, 30, 3), [5.01, 5.98, 7.02, 8.0]
    run = take_run(tmp_path / "run", planes, z_um, skip=(1,))
    alone = open_stack(shutil.copytree(run / "focal.ome.zarr", tmp_path / "alone.zarr"))
    within = open_stack(run)
    assert np.array_equal(np.stack(list(alone)), np.stack(list(within)))
    assert alone.z_um == pytest.approx([5.01, 7.02, 8.0])
    assert "planes 1 were not taken" in " ".join(alone.notes)
    assert "1 of 4 planned planes are missing: 1." in within.notes


def test_a_damaged_plane_of_a_run_is_named(tmp_path: Path) -> None:
    run = take_run(tmp_path / "run", numbers(3, 20, 30), [5.0, 6.0, 7.0])
    shard = run / "focal.ome.zarr" / "0" / "c" / "0" / "0" / "1" / "0" / "0"
    shard.write_bytes(shard.read_bytes()[:-20])
    with pytest.raises(StereotomeError, match="plane 1 is damaged"):
        list(open_stack(run))
