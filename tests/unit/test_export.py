"""Exports of a run, judged by readers that know nothing of it."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import tifffile
import zarr
from ome_types import from_xml, validate_xml
from ome_zarr_models.v04.image import ImageAttrs
from ome_zarr_models.v05.image import Image as Image05
from wires import stereotome
from yaozarrs import validate_zarr_store

from acquire.export import export
from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import InputError

GREY = FocalArray(planned=4, shape=(600, 56), dtype="uint16", start_um=-3.0, step_um=1.5, pixel_um=0.25)
SECTIONS = FocalArray(
    planned=12,
    shape=(40, 56),
    dtype="uint16",
    start_um=-1.0,
    step_um=1.0,
    pixel_um=0.25,
    sections=3,
    channels=("DAPI", "GFP"),
    colours=("#0000ff", None),
)
FACES = dataclasses.replace(SECTIONS, planned=3, channels=(), colours=())
COLOUR = dataclasses.replace(GREY, shape=(40, 56, 3), dtype="uint8")


def pixels(layout, plane):
    return np.random.default_rng(plane).integers(0, 256, layout.shape).astype(layout.dtype)


def finished(folder, layout, planes=range(4)):
    plan = {"sections": {"thickness_nm": 70}}
    store = RunStore.create(folder, {"name": "wing", "plan_id": "x", "plan": plan}, layout, SystemClock())
    for k in planes:
        section, band, plane = layout.place(k)
        start_ns = 1_000_000_000 + 50_000_000 * k
        z_um = layout.start_um + layout.step_um * plane
        header = FrameHeader(plane, z_um, z_um + 0.01, 12.5, exposure_start_ns=start_ns, section=section, band=band)
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


def test_ome_tiff_of_sections_and_bands_is_valid_ome_and_keeps_every_plane_in_place(tmp_path, capsys):
    missing = 5
    run = finished(tmp_path / "run", SECTIONS, planes=[k for k in range(12) if k != missing])
    assert export(run, output=tmp_path / "out.ome.tif", quiet=True) == 0
    assert "plane 5 was never taken; in the copy it is black there" in capsys.readouterr().err
    with tifffile.TiffFile(tmp_path / "out.ome.tif") as tiff:
        validate_xml(tiff.ome_metadata)
        ome = from_xml(tiff.ome_metadata)
        stack = tiff.series[0].asarray()
        assert tiff.series[0].axes == "TCZYX"
    told = ome.images[0].pixels
    assert (told.size_t, told.size_c, told.size_z) == (3, 2, 2)
    assert [channel.name for channel in told.channels] == ["DAPI", "GFP"]
    assert "[5]" in ome.images[0].description
    where = {(plane.the_t, plane.the_c, plane.the_z): plane for plane in told.planes}
    for k in range(12):
        t, c, z = SECTIONS.place(k)
        expected = np.zeros_like(stack[0, 0, 0]) if k == missing else pixels(SECTIONS, k)
        np.testing.assert_array_equal(stack[t, c, z], expected)
        assert where[t, c, z].position_z == pytest.approx(-1.0 + z + (0.01 if k != missing else 0.0))
        assert where[t, c, z].delta_t == pytest.approx(0.05 * k if k != missing else 0.0)


@pytest.mark.parametrize("format_", ["ome-zarr", "ome-zarr-0.4"])
@pytest.mark.parametrize("layout", [GREY, COLOUR, SECTIONS, FACES])
def test_ome_zarr_is_accepted_by_two_independent_checkers(tmp_path, layout, format_):
    run = finished(tmp_path / "run", layout, planes=range(layout.planned))
    assert export(run, output=tmp_path / "out.ome.zarr", format_=format_, quiet=True) == 0
    validate_zarr_store(str(tmp_path / "out.ome.zarr"))
    group = zarr.open_group(tmp_path / "out.ome.zarr", mode="r")
    newest = format_ == "ome-zarr"
    # the package's model of a whole 0.4 image does not load with the newest pydantic; that of its metadata does
    told = Image05.from_zarr(group).ome_attributes if newest else ImageAttrs.model_validate(dict(group.attrs))
    transform = told.multiscales[0].datasets[0].coordinateTransformations
    assert tuple(transform[0].scale) == (1.0, 1.0, layout.step_um, 0.25, 0.25)
    array = group["0"]
    assert array.metadata.zarr_format == (3 if newest else 2)
    for k in range(layout.planned):
        t, c, z = layout.place(k)
        expected = pixels(layout, k)
        planar = expected[np.newaxis] if expected.ndim == 2 else np.moveaxis(expected, -1, 0)
        np.testing.assert_array_equal(array[t, c * layout.bands : (c + 1) * layout.bands, z], planar)
    facts = group.attrs["stereotome"]["planes"]
    assert [fact["time_s"] for fact in facts] == pytest.approx([0.05 * k for k in range(layout.planned)])
    assert {fact["exposure_ms"] for fact in facts} == {12.5}


def test_faces_lie_along_z_with_what_was_cut_between_them(tmp_path):
    run = finished(tmp_path / "run", FACES, planes=range(3))
    assert export(run, output=tmp_path / "out.ome.tif", sections="z", quiet=True) == 0
    size, _ = plane_elements(tmp_path / "out.ome.tif")
    assert (size["SizeZ"], size["SizeT"], float(size["PhysicalSizeZ"])) == ("3", "1", 0.07)


def test_sections_with_stacks_do_not_fit_along_z(tmp_path):
    run = finished(tmp_path / "run", SECTIONS, planes=range(12))
    with pytest.raises(InputError, match="cannot all lie along z"):
        export(run, output=tmp_path / "out.ome.tif", sections="z", quiet=True)


@pytest.mark.parametrize("layout", [GREY, COLOUR])
def test_ome_tiff_validates_against_the_schema(tmp_path, layout):
    run = finished(tmp_path / "run", layout)
    assert export(run, output=tmp_path / "out.ome.tif", quiet=True) == 0
    with tifffile.TiffFile(tmp_path / "out.ome.tif") as tiff:
        validate_xml(tiff.ome_metadata)


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
