"""Runs of sections as stacks and volumes: spaced by what was fed, never by where the stage stood."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquire.export import export
from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import InputError
from display.load import load_volume
from processing.faces_cli import faces
from processing.grey_volume import read_volume
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

READ_BACK_NM = [1000.0, 1510.0, 1990.0, 2500.0]


def take(
    folder: Path,
    planes: int = 1,
    *,
    bands: tuple[str, ...] = (),
    read_back_nm: list[float] = READ_BACK_NM,
    first_is_fed: bool = True,
    interval_s: float | None = None,
) -> Path:
    """A run of four sections; the third plane of a stack is sharp; z reads back a little different each time."""
    count, channels = len(READ_BACK_NM), max(1, len(bands))
    layout = FocalArray(
        count * channels * planes, (32, 40), "uint16", 0.0, 2.0, 0.5,
        sections=count, channels=bands, interval_s=interval_s,
    )  # fmt: skip
    told = {"plan_id": "t", "name": "t"}
    plan = {} if interval_s else {"sections": {"thickness_nm": 500}}
    store = RunStore.create(folder, {**told, "plan": plan}, layout, SystemClock())
    store.journal.append({"e": "origin", "depth_nm": 500.0 if first_is_fed else read_back_nm[0], "cuts": 0})
    for section in range(count):
        if section or first_is_fed:
            store.journal.append({"e": "feed_done", "section": section, "readback_nm": read_back_nm[section]})
        for band in range(channels):
            for plane in range(planes):
                header = FrameHeader(plane, 2.0 * plane, 2.0 * plane + 0.01 * section, 5.0, section=section, band=band)
                store.put(Frame(layout.slot_of(header), header, picture(section, band, plane)))
    store.finalise(RunEnd.COMPLETED)
    store.close()
    return folder


def picture(section: int, band: int, plane: int) -> np.ndarray:
    pixels = np.random.default_rng([section, band]).integers(100, 4000, (32, 40)).astype(float)
    for _ in range(2 * abs(plane - 2)):
        pixels = (pixels + np.roll(pixels, 1, 0) + np.roll(pixels, 1, 1)) / 3
    return pixels.astype(np.uint16)


@pytest.mark.parametrize("first_is_fed", [True, False])
def test_sections_of_one_plane_are_a_volume_spaced_as_the_feed_read_back(tmp_path: Path, first_is_fed: bool) -> None:
    run = take(tmp_path / "run", first_is_fed=first_is_fed)
    stack = open_stack(run)
    assert stack.z_um == pytest.approx([0.0, -0.51, -0.99, -1.5])
    assert "as far apart as the feed read back" in stack.notes[0]
    volume = load_volume(run)
    np.testing.assert_array_equal(volume.bands[0].values[0], picture(0, 0, 0))  # the first face is nearest
    assert read_volume(run).spacing_um == pytest.approx((0.5, 0.5, 0.5))


@pytest.mark.parametrize("read_back_nm", [[1000.0] * 4, [1000.0, 1500.0, 1500.0, 2000.0]])
def test_what_the_feed_read_back_makes_no_sense_the_plan_is_taken_and_said(tmp_path: Path, read_back_nm) -> None:
    stack = open_stack(take(tmp_path / "run", read_back_nm=read_back_nm))
    assert stack.z_um == pytest.approx([0.0, -0.5, -1.0, -1.5])
    assert stack.notes == ("the planes are sections, 500 nm apart as planned.",)


def test_sections_with_stacks_ask_which_and_take_one(tmp_path: Path) -> None:
    run = take(tmp_path / "run", planes=4)
    with pytest.raises(InputError) as error:
        load_volume(run)
    assert error.value.code == "sections-stacks"
    assert "stereotome process faces" in error.value.message()
    stack = open_stack(run, time=2)
    assert stack.z_um == pytest.approx([0.02, 2.02, 4.02, 6.02])
    np.testing.assert_array_equal(stack[1], picture(2, 0, 1))
    with pytest.raises(InputError) as error:
        open_stack(run, time=4)
    assert error.value.code == "stack-time"


def test_bands_of_a_run_are_its_channels(tmp_path: Path) -> None:
    run = take(tmp_path / "run", bands=("green", "red"))
    with pytest.raises(InputError, match="0 green, 1 red"):
        open_stack(run)
    np.testing.assert_array_equal(open_stack(run, channel=1)[3], picture(3, 1, 0))
    assert len(load_volume(run, channels=(0, 1)).bands) == 2


def test_points_in_time_are_no_depth(tmp_path: Path) -> None:
    stack = open_stack(take(tmp_path / "run", interval_s=2.0))
    assert stack.z_um is None
    assert "along time" in stack.notes[0]
    assert len(open_stack(take(tmp_path / "stacks", planes=4, interval_s=2.0))) == 4


@pytest.mark.parametrize("kind", ["ome-tiff", "ome-zarr", "ome-zarr-0.4"])
def test_an_export_with_sections_along_z_gives_their_depth_and_not_where_the_stage_stood(tmp_path: Path, kind) -> None:
    path = tmp_path / ("out.ome.tif" if kind == "ome-tiff" else "out.zarr")
    export(take(tmp_path / "run"), output=path, format_=kind, sections="z", quiet=True)
    stack = open_stack(path)
    assert stack.z_um == pytest.approx([0.0, 0.51, 0.99, 1.5])
    np.testing.assert_array_equal(stack[2], picture(2, 0, 0))


@pytest.mark.parametrize("how", ["sharpest", "extended-focus"])
def test_faces_make_a_volume_of_sections_with_stacks(tmp_path: Path, how) -> None:
    run = take(tmp_path / "run", planes=5)
    assert faces(run, output=tmp_path / "out", take=how, quiet=True) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["depth_nm"] == READ_BACK_NM
    for name in ("faces.ome.zarr", "faces.ome.tif"):
        volume = read_volume(tmp_path / "out" / name)
        assert volume.spacing_um == pytest.approx((0.5, 0.5, 0.5))
        if how == "sharpest":
            np.testing.assert_array_equal(volume.values, np.stack([picture(k, 0, 2) for k in range(4)]))
            assert report["planes"] == [2] * 4
    with pytest.raises(InputError, match="has no sections"):
        faces(take(tmp_path / "time", interval_s=1.0), output=tmp_path / "no", quiet=True)


def test_planes_closer_than_the_stage_can_tell_lie_where_it_was_sent(tmp_path: Path) -> None:
    layout = FocalArray(5, (8, 8), "uint16", 0.0, 0.05, 0.5)
    store = RunStore.create(tmp_path / "run", {"plan_id": "t", "name": "t", "plan": {}}, layout, SystemClock())
    for plane in (0, 1, 2, 4):  # 3 is lost
        sent_um = 0.05 * plane
        header = FrameHeader(plane, sent_um, round(sent_um, 1), 5.0)
        store.put(Frame(plane, header, np.full((8, 8), 100 * plane, np.uint16)))
    store.finalise(RunEnd.CANCELLED)
    store.close()
    stack = open_stack(tmp_path / "run")
    assert stack.z_um == pytest.approx([0.0, 0.05, 0.1, 0.2])
    assert any("placed where it was sent" in note for note in stack.notes)
    assert load_volume(tmp_path / "run").bands[0].values[0, 0, 0] == 400, "the highest plane is nearest to the viewer"


def test_sections_of_one_plane_are_a_volume_already(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has one plane"):
        faces(take(tmp_path / "run"), output=tmp_path / "out")
    with pytest.raises(InputError, match="no time point 2"):
        open_stack(tmp_path / "run", time=2)
