"""Data sets as Micro-Manager writes them: z, spacing and channels of stacks in one file and in folders of images."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import tifffile

from acquire.export import export
from acquire.store import open_run
from devices.errors import InputError
from processing.importing import import_
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

Z_UM = [100.0, 100.52, 100.98, 101.5]
CHANNELS = ("Cy5", "DAPI")
PIXEL_UM = 0.325
rng = np.random.default_rng(9)
PLANES = rng.integers(0, 4000, (2, 4, 20, 24)).astype(np.uint16)


def told(channel: int, z: int) -> dict[str, Any]:
    """What Micro-Manager says of an image, wherever it says it."""
    return {
        "ZPositionUm": Z_UM[z],
        "PixelSizeUm": PIXEL_UM,
        "Exposure-ms": 10.0,
        "Channel": CHANNELS[channel],
        "ChannelIndex": channel,
        "SliceIndex": z,
        "FrameIndex": 0,
    }


def mm_stack(path: Path, *, unit: str, positions: bool) -> Path:
    """One file, as by the OME-TIFF storage: OME-XML on the first page, a table in a tag of every page."""
    plane = '<Plane TheC="{c}" TheZ="{z}" TheT="0" ExposureTime="10.0"{place}/>'
    data = '<TiffData FirstC="{c}" FirstT="0" FirstZ="{z}" IFD="{i}" PlaneCount="1"/>'
    place = ' PositionX="0.0" PositionY="0.0" PositionZ="{}"' + unit
    order = [(z, c) for z in range(4) for c in range(2)]  # XYCZT: channels vary first
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2013-06">'
        f'<Image ID="Image:0" Name="a_MMStack_Pos0"><Pixels BigEndian="false" DimensionOrder="XYCZT" ID="Pixels:0" '
        f'PhysicalSizeX="{PIXEL_UM}" PhysicalSizeY="{PIXEL_UM}" PhysicalSizeZ="0.5" SizeC="2" SizeT="1" SizeX="24" '
        'SizeY="20" SizeZ="4" Type="uint16">'
        + "".join(f'<Channel ID="Channel:0:{c}" Name="{name}" SamplesPerPixel="1"/>' for c, name in enumerate(CHANNELS))
        + "".join(data.format(c=c, z=z, i=i) for i, (z, c) in enumerate(order))
        + "".join(plane.format(c=c, z=z, place=place.format(Z_UM[z]) if positions else "") for z, c in order)
        + "</Pixels></Image></OME>"
    )
    with tifffile.TiffWriter(path) as file:
        for number, (z, c) in enumerate(order):
            table = json.dumps(told(c, z)).encode()
            tags = [(51123, "s", len(table), table, True)]
            words = xml if number == 0 else "ImageJ=1.51s\nimages=8\n"
            file.write(PLANES[c, z], metadata=None, description=words.encode(), extratags=tags, contiguous=False)
    return path


@pytest.mark.parametrize("unit", [' PositionZUnit="µm"', ""])
@pytest.mark.parametrize("positions", [True, False])
def test_a_stack_in_one_file(tmp_path: Path, unit: str, positions: bool) -> None:
    path = mm_stack(tmp_path / "a_MMStack_Pos0.ome.tif", unit=unit, positions=positions)
    with pytest.raises(InputError, match="0 Cy5, 1 DAPI"):
        open_stack(path)
    for channel in range(2):
        stack = open_stack(path, channel=channel)
        np.testing.assert_array_equal(np.stack(list(stack)), PLANES[channel])
        assert stack.z_um == pytest.approx(Z_UM)
        assert stack.pixel_um == PIXEL_UM


def mm_folder(folder: Path, version: str, channels: int = 2) -> Path:
    """A file for each image, and ``metadata.txt`` beside them."""
    folder.mkdir()
    summary = {"Channels": channels, "Slices": 4, "z-step_um": 0.5, "MicroManagerVersion": version}
    table: dict[str, Any] = {"Summary": summary}
    for c in range(channels):
        for z in range(4):
            if version.startswith("1.4"):
                name = f"img_000000000_{CHANNELS[c]}_{z:03d}.tif"
                table[f"FrameKey-0-{c}-{z}"] = {**told(c, z), "FileName": name}
            else:
                name = f"img_channel{c:03d}_position000_time000000000_z{z:03d}.tif"
                table[f"Coords-Default/{name}"] = {"channel": c, "z": z, "time": 0, "position": 0}
                table[f"Metadata-Default/{name}"] = told(c, z)
            tifffile.imwrite(folder / name, PLANES[c, z], metadata=None, description="ImageJ=1.51s\n")
    (folder / "metadata.txt").write_text(json.dumps(table, indent=2))
    return folder


@pytest.mark.parametrize("version", ["1.4.22", "2.0.1"])
def test_a_folder_of_images(tmp_path: Path, version: str) -> None:
    folder = mm_folder(tmp_path / "Default", version)
    with pytest.raises(InputError, match="holds 2 channels"):
        open_stack(folder)
    for channel in range(2):
        stack = open_stack(folder, channel=channel)
        np.testing.assert_array_equal(np.stack(list(stack)), PLANES[channel])
        assert stack.z_um == pytest.approx(Z_UM)
        assert stack.pixel_um == PIXEL_UM


def test_an_acquisition_that_ended_early_leaves_half_of_its_table(tmp_path: Path) -> None:
    folder = mm_folder(tmp_path / "a", "1.4.22", channels=1)
    table = folder / "metadata.txt"
    table.write_text(table.read_text().rstrip("}\n") + "  }")
    assert open_stack(folder).z_um == pytest.approx(Z_UM)
    table.write_text(table.read_text()[:-60])
    stack = open_stack(folder)
    assert stack.z_um is None
    assert "metadata.txt cannot be read" in stack.notes[0]


def test_a_table_of_another_program_says_nothing(tmp_path: Path) -> None:
    folder = mm_folder(tmp_path / "a", "2.0.1", channels=1)
    (folder / "metadata.txt").write_text('{"sample": "beads"}')
    assert open_stack(folder).z_um is None


def test_it_becomes_a_run_and_an_ome_tiff_with_the_same_positions(tmp_path: Path) -> None:
    folder = mm_folder(tmp_path / "Default", "2.0.1")
    assert import_(folder, output=tmp_path / "run", channel=(0, 1), quiet=True) == 0
    stored = open_run(tmp_path / "run")
    assert [stored.planes[slot].header.z_um for slot in range(8)] == pytest.approx([*Z_UM, *Z_UM])
    assert export(tmp_path / "run", output=tmp_path / "out.ome.tif", quiet=True) == 0
    for channel in range(2):
        stack = open_stack(tmp_path / "out.ome.tif", channel=channel)
        np.testing.assert_array_equal(np.stack(list(stack)), PLANES[channel])
        assert stack.z_um == pytest.approx(Z_UM)
        assert stack.pixel_um == pytest.approx(PIXEL_UM)
