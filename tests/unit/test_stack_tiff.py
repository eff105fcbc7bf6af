"""TIFF files as stacks: axes, spacing from every dialect, colour, and files that were cut."""

from __future__ import annotations

import contextlib
import json
import shutil
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.errors import InputError
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

PLANES = np.random.default_rng(4).integers(0, 65536, (5, 12, 17), np.uint16)


def pixels_of(path: Path, **options: Any) -> np.ndarray:
    return np.stack(list(open_stack(path, **options)))


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"imagej": True, "metadata": {"axes": "ZYX"}},
        {"ome": True, "metadata": {"axes": "ZYX"}},
        {"compression": "zlib"},
        {"tile": (16, 16)},
        {"bigtiff": True},
        {"byteorder": ">"},
        {"contiguous": False, "metadata": None},
        {"rowsperstrip": 3, "compression": "zlib", "predictor": 2},
    ],
    ids=str,
)
def test_every_dialect_gives_the_same_pixels(tmp_path: Path, how: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", PLANES, photometric="minisblack", **how)
    assert np.array_equal(pixels_of(tmp_path / "a.tif"), PLANES)
    assert open_stack(tmp_path / "a.tif").dtype == np.uint16


@pytest.mark.parametrize("bands", [(), (3,)])
def test_lzw(tmp_path: Path, bands: tuple[int, ...]) -> None:
    planes = np.random.default_rng(5).integers(0, 65536, (3, 20, 30, *bands), np.uint16)
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(planes), [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages.first.compression == tifffile.COMPRESSION.LZW
    expected = planes[..., ::-1] if bands else planes
    assert np.array_equal(pixels_of(tmp_path / "a.tif"), expected)


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_colour_whichever_way_it_is_stored(tmp_path: Path, planar: str) -> None:
    colour = np.random.default_rng(5).integers(0, 256, (4, 10, 11, 3), np.uint8)
    stored = colour if planar == "contig" else np.moveaxis(colour, -1, 1)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", planarconfig=planar)
    assert np.array_equal(pixels_of(tmp_path / "a.tif"), colour)


@pytest.mark.parametrize("axes", ["ZYX", "TYX"])
def test_a_time_that_is_not_there_is_refused_where_no_axis_is_time_and_where_the_planes_are(
    axes: str, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "a.ome.tif", np.zeros((3, 5, 6), np.uint16), metadata={"axes": axes})
    np.save(tmp_path / "a.npy", np.zeros((3, 5, 6), np.uint16))
    for name in ("a.ome.tif", "a.npy"):
        assert len(open_stack(tmp_path / name, time=0)) == 3
        with pytest.raises(InputError, match="no time point 1; it has one") as caught:
            open_stack(tmp_path / name, time=1)
        assert caught.value.code == "stack-time"


def test_hyperstack_takes_one_channel_and_time(tmp_path: Path) -> None:
    data = np.arange(2 * 3 * 4 * 5 * 6, dtype=np.uint16).reshape(2, 3, 4, 5, 6)
    tifffile.imwrite(tmp_path / "a.tif", data, imagej=True, metadata={"axes": "TZCYX"})
    with pytest.raises(InputError, match="holds 4 channels"):
        open_stack(tmp_path / "a.tif")
    assert np.array_equal(pixels_of(tmp_path / "a.tif", channel=2, time=1), data[1, :, 2])
    assert "time point 0" in open_stack(tmp_path / "a.tif", channel=0).notes[0]
    with pytest.raises(InputError, match="no time point 2"):
        open_stack(tmp_path / "a.tif", channel=0, time=2)
    with pytest.raises(InputError, match="no channel 4"):
        open_stack(tmp_path / "a.tif", channel=4)


@pytest.mark.parametrize(("unit", "factor"), [("micron", 1), ("nm", 1e-3), ("\\u00B5m", 1), ("mm", 1e3)])
def test_imagej_spacing_and_unit(tmp_path: Path, unit: str, factor: float) -> None:
    metadata = {"axes": "ZYX", "spacing": 2.5, "unit": unit}
    tifffile.imwrite(tmp_path / "a.tif", PLANES, imagej=True, resolution=(4.0, 4.0), metadata=metadata)
    stack = open_stack(tmp_path / "a.tif")
    assert stack.z_um == pytest.approx(2.5 * factor * np.arange(5))
    assert stack.pixel_um == pytest.approx(0.25 * factor)


def test_imagej_spacing_without_unit_is_no_spacing(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", PLANES, imagej=True, metadata={"axes": "ZYX", "spacing": 2.5})
    stack = open_stack(tmp_path / "a.tif")
    assert stack.z_um is None
    assert "no spacing" in stack.notes[-1]


@pytest.mark.parametrize("spacing", [0.0, float("nan")])
def test_spacing_in_the_file_that_makes_no_sense(tmp_path: Path, spacing: float) -> None:
    metadata = {"axes": "ZYX", "spacing": spacing, "unit": "um"}
    tifffile.imwrite(tmp_path / "a.tif", PLANES, imagej=True, metadata=metadata)
    with pytest.raises(InputError, match="the file gives a plane spacing of"):
        open_stack(tmp_path / "a.tif")
    assert open_stack(tmp_path / "a.tif", step_um=2).z_um == pytest.approx([0, 2, 4, 6, 8])


def ome(path: Path, **metadata: Any) -> Path:
    tifffile.imwrite(path, PLANES, ome=True, metadata={"axes": "ZYX", **metadata})
    return path


def test_ome_spacing_in_its_unit_and_the_option_goes_before_it(tmp_path: Path) -> None:
    path = ome(tmp_path / "a.ome.tif", PhysicalSizeZ=300.0, PhysicalSizeZUnit="nm", PhysicalSizeX=0.2)
    stack = open_stack(path)
    assert stack.z_um == pytest.approx(0.3 * np.arange(5))
    assert stack.pixel_um == pytest.approx(0.2)
    overruled = open_stack(path, step_um=2.0)
    assert overruled.z_um == pytest.approx(2.0 * np.arange(5))
    assert "goes before the 0.3 µm" in overruled.notes[-1]


def test_ome_positions_of_each_plane_are_kept(tmp_path: Path) -> None:
    z_um = [10.0, 11.0, 13.0, 16.0, 20.0]
    plane = {"PositionZ": z_um, "PositionZUnit": ["µm"] * 5}
    stack = open_stack(ome(tmp_path / "a.ome.tif", PhysicalSizeZ=1.0, Plane=plane))
    assert stack.z_um == pytest.approx(z_um)


def test_planes_taken_to_and_fro_are_put_in_order(tmp_path: Path) -> None:
    plane = {"PositionZ": [0.0, 2.0, 1.0, 3.0, 4.0], "PositionZUnit": ["µm"] * 5}
    stack = open_stack(ome(tmp_path / "a.ome.tif", Plane=plane))
    assert stack.z_um == pytest.approx([0, 1, 2, 3, 4])
    assert np.array_equal(stack[1], PLANES[2])
    assert "order of their z positions" in stack.notes[-1]


def test_equal_positions_are_refused(tmp_path: Path) -> None:
    plane = {"PositionZ": [0.0, 2.0, 2.0, 3.0, 4.0], "PositionZUnit": ["µm"] * 5}
    with pytest.raises(InputError, match="all different"):
        open_stack(ome(tmp_path / "a.ome.tif", Plane=plane))


def test_positions_that_never_change_say_nothing(tmp_path: Path) -> None:
    plane = {"PositionZ": [7.0] * 5, "PositionZUnit": ["µm"] * 5}
    stack = open_stack(ome(tmp_path / "a.ome.tif", PhysicalSizeZ=1.5, Plane=plane))
    assert stack.z_um == pytest.approx(1.5 * np.arange(5))


OME_SET = (
    '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
    'UUID="urn:uuid:00000000-0000-0000-0000-000000000000"><Image ID="Image:0">'
    '<Pixels ID="Pixels:0" SizeX="17" SizeY="12" '
    'SizeZ="3" SizeC="1" SizeT="1" Type="uint16" DimensionOrder="XYZCT" PhysicalSizeZ="2"><Channel ID="Channel:0:0"/>'
    + "".join(
        f'<TiffData FirstZ="{k}" IFD="0" PlaneCount="1">'
        f'<UUID FileName="s{k}.ome.tif">urn:uuid:0000000{k}</UUID></TiffData>'
        for k in range(3)
    )
    + "</Pixels></Image></OME>"
)
METASERIES = """<MetaData><PlaneInfo><prop id="spatial-calibration-x" type="float" value="1.25"/>
<prop id="spatial-calibration-units" type="string" value="um"/><prop id="z-position" type="float" value="{}"/>
</PlaneInfo><ApplicationName>MetaMorph</ApplicationName></MetaData>"""


def test_metaseries_positions_over_a_folder(tmp_path: Path) -> None:
    for k, z_um in enumerate([100.5, 103.0, 109.0]):
        tifffile.imwrite(
            tmp_path / f"w1_z{k}.tif", PLANES[k], description=METASERIES.format(z_um), software="MetaSeries"
        )
    stack = open_stack(tmp_path)
    assert stack.z_um == pytest.approx([100.5, 103.0, 109.0])
    assert stack.pixel_um == pytest.approx(1.25)


def test_micro_manager_positions_of_the_chosen_channel(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "mm.tif") as file:
        for k in range(5):
            for channel in range(2):
                table = json.dumps({"ZPositionUm": 10.0 + 1.5 * k + 0.1 * channel, "PixelSizeUm": 0.4}).encode()
                tags = [(51123, "s", len(table), table, True)]
                file.write(PLANES[k] + channel, metadata=None, extratags=tags, contiguous=False)
    stack = open_stack(tmp_path / "mm.tif")
    assert stack.pixel_um == 0.4
    assert len(stack) == 10
    assert stack.z_um == pytest.approx(np.add.outer(1.5 * np.arange(5), [10.0, 10.1]).ravel())


def test_spacing_in_z_says_nothing_about_planes_along_time(tmp_path: Path) -> None:
    metadata = {"axes": "TYX", "PhysicalSizeZ": 1.0}
    tifffile.imwrite(tmp_path / "a.ome.tif", PLANES, ome=True, metadata=metadata)
    stack = open_stack(tmp_path / "a.ome.tif")
    assert stack.z_um is None
    assert "the planes run along time" in stack.notes[0]


def test_planes_in_several_files_of_one_set(tmp_path: Path) -> None:
    """OME-TIFF may keep each plane in a file of its own; the first file tells where the others are."""
    for k in range(3):
        tifffile.imwrite(tmp_path / f"s{k}.ome.tif", PLANES[k], metadata=None, description=OME_SET)
    stack = open_stack(tmp_path / "s0.ome.tif")
    assert np.array_equal(np.stack(list(stack)), PLANES[:3])
    assert stack.z_um == pytest.approx([0, 2, 4])
    (tmp_path / "s1.ome.tif").unlink()
    with pytest.raises(InputError, match="damaged or incomplete"):
        list(open_stack(tmp_path / "s0.ome.tif"))


def test_a_file_of_many_planes_among_single_ones(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a1.tif", PLANES[0])
    tifffile.imwrite(tmp_path / "a2.tif", PLANES, photometric="minisblack")
    with pytest.raises(InputError, match=r"a2.tif holds 5 planes"):
        open_stack(tmp_path)


def test_a_folder_of_one_tiff_is_that_stack(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", PLANES, photometric="minisblack")
    assert len(open_stack(tmp_path)) == 5


@pytest.fixture(scope="module", params=["plain", "pages", "packed", "imagej", "ome"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    how: dict[str, Any] = {
        "plain": {},
        "pages": {"contiguous": False, "metadata": None},
        "packed": {"compression": "zlib"},
        "imagej": {"imagej": True},
        "ome": {"ome": True},
    }[request.param]
    path = tmp_path_factory.mktemp("tiff") / "whole.tif"
    tifffile.imwrite(path, PLANES, photometric="minisblack", **how)
    return path


@given(share=st.floats(0, 0.999))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_tiff_cut_anywhere_is_refused_or_complete(whole: Path, tmp_path: Path, share: float) -> None:
    """No cut gives fewer planes, or other pixels, without a word."""
    cut = tmp_path / "cut.tif"
    shutil.copy(whole, cut)
    with cut.open("r+b") as file:
        file.truncate(int(share * whole.stat().st_size))
    with contextlib.suppress(InputError):
        assert np.array_equal(pixels_of(cut), PLANES)


@given(content=st.binary(max_size=300), head=st.sampled_from([b"", b"II*\0", b"MM\0*", b"II+\0\x08\0\0\0"]))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_give_words(tmp_path: Path, content: bytes, head: bytes) -> None:
    (tmp_path / "noise.tif").write_bytes(head + content)
    with pytest.raises(InputError):
        pixels_of(tmp_path / "noise.tif")
