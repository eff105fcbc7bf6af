"""Exports of a run, judged by readers that know nothing of it."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import tifffile
import zarr
from wires import stereotome
from yaozarrs import validate_zarr_store

from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock

GREY = FocalArray(planned=4, shape=(600, 56), dtype="uint16", start_um=-3.0, step_um=1.5, pixel_um=0.25)
COLOUR = dataclasses.replace(GREY, shape=(40, 56, 3), dtype="uint8")


def pixels(layout, plane):
    return np.random.default_rng(plane).integers(0, 256, layout.shape).astype(layout.dtype)


def finished(folder, layout, planes=range(4)):
    store = RunStore.create(folder, {"name": "wing", "plan_id": "x"}, layout, SystemClock())
    for k in planes:
        start_ns = 1_000_000_000 + 50_000_000 * k
        header = FrameHeader(k, -3.0 + 1.5 * k, -2.99 + 1.5 * k, 12.5, exposure_start_ns=start_ns)
        store.put(Frame(k, header, pixels(layout, k)))
    store.finalise(RunEnd.COMPLETED)
    store.close()
    return folder


def plane_elements(path):
    with tifffile.TiffFile(path) as tiff:
        root = ET.fromstring(tiff.ome_metadata)
    space = {"o": root.tag[1:].partition("}")[0]}
    return root.find(".//o:Pixels", space).attrib, [p.attrib for p in root.findall(".//o:Plane", space)]


@pytest.mark.parametrize("layout", [GREY, COLOUR])
def test_ome_tiff_has_every_plane_with_its_position_time_and_exposure(tmp_path, layout):
    run = finished(tmp_path / "run", layout)
    assert stereotome("export", run, "-o", tmp_path / "out.ome.tif").code == 0
    stack = tifffile.imread(tmp_path / "out.ome.tif")
    for k in range(4):
        np.testing.assert_array_equal(stack[k], pixels(layout, k))
    size, planes = plane_elements(tmp_path / "out.ome.tif")
    assert (float(size["PhysicalSizeX"]), float(size["PhysicalSizeZ"])) == (0.25, 1.5)
    assert [float(p["PositionZ"]) for p in planes] == pytest.approx([-2.99 + 1.5 * k for k in range(4)])
    assert [float(p["DeltaT"]) for p in planes] == pytest.approx([0.05 * k for k in range(4)])
    assert {(float(p["ExposureTime"]), p["ExposureTimeUnit"]) for p in planes} == {(12.5, "ms")}


@pytest.mark.parametrize("layout", [GREY, COLOUR])
def test_ome_zarr_04_is_accepted_by_an_independent_checker(tmp_path, layout):
    run = finished(tmp_path / "run", layout)
    result = stereotome("export", run, "-o", tmp_path / "out.ome.zarr", "--format", "ome-zarr-0.4")
    assert result.code == 0, result.err
    validate_zarr_store(str(tmp_path / "out.ome.zarr"))
    array = zarr.open_array(tmp_path / "out.ome.zarr" / "0", mode="r")
    assert array.metadata.zarr_format == 2
    for k in range(4):
        expected = pixels(layout, k)
        planar = expected[np.newaxis] if expected.ndim == 2 else np.moveaxis(expected, -1, 0)
        np.testing.assert_array_equal(array[0, :, k], planar)


def test_a_missing_plane_is_left_out_and_said(tmp_path):
    run = finished(tmp_path / "run", GREY, planes=(0, 1, 3))
    result = stereotome("export", run, "-o", tmp_path / "out.ome.tif")
    assert "plane 2 was never taken" in result.err
    _, planes = plane_elements(tmp_path / "out.ome.tif")
    assert [float(p["PositionZ"]) for p in planes] == pytest.approx([-2.99, -1.49, 1.51])


def test_nothing_is_overwritten(tmp_path):
    run = finished(tmp_path / "run", COLOUR)
    (tmp_path / "out.ome.tif").write_bytes(b"precious")
    result = stereotome("export", run, "-o", tmp_path / "out.ome.tif")
    assert (result.code, (tmp_path / "out.ome.tif").read_bytes()) == (2, b"precious")
    assert "error[output-exists]" in result.err


def test_a_damaged_plane_is_not_passed_on(tmp_path):
    run = finished(tmp_path / "run", GREY)
    shard = run / "focal.ome.zarr/0/c/0/0/1/0/0"
    shard.write_bytes(shard.read_bytes()[:-40])
    result = stereotome("export", run, "-o", tmp_path / "out.ome.tif")
    assert result.code == 6
    assert "plane 1 is damaged" in result.err
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_empty_run_is_said_to_be_empty(tmp_path):
    result = stereotome("export", finished(tmp_path / "run", GREY, planes=()), "-o", tmp_path / "out.tif")
    assert result.code == 2
    assert "error[no-planes]" in result.err
