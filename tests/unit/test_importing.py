"""Stacks and cut sections of others as runs: every plane in its place with its pixels, lost ones kept and named."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from acquire.export import export
from acquire.resume import interrupted_run
from acquire.store import RunEnd, open_run
from devices.errors import InputError
from processing.importing import import_, import_sections, import_stack, read_table


def picture(k: int, shape=(24, 30)) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 4000, shape).astype(np.uint16)


def table(folder, text: str):
    path = folder / "sections.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_cut_sections_in_any_order_keep_their_places_and_lost_ones_theirs(tmp_path):
    for k in (0, 1, 4):
        tifffile.imwrite(tmp_path / f"image{k}.tif", picture(k, (24, 30 - k)))
    path = table(
        tmp_path,
        "section,file,rotation_deg,flip,note\n4,image4.tif,-12.5,yes,folded at the rim\n0,image0.tif\n"
        "2,,,,tore\n1,image1.tif,3\n",
    )
    run = import_sections(path, tmp_path / "run", thickness_nm=70, pixel_um=0.5, quiet=True)
    stored = open_run(run)
    assert stored.state is RunEnd.COMPLETED_WITH_GAPS
    assert stored.missing == [2, 3]
    assert stored.missed == {2: "tore", 3: "no row in the table"}
    for k in (0, 1, 4):
        np.testing.assert_array_equal(stored.read(k)[:, : 30 - k], picture(k, (24, 30 - k)))
        assert stored.read(k)[:, 30 - k :].max(initial=0) == 0
    kept = stored.manifest["imported"]["sections"][4]
    assert (kept["rotation_deg"], kept["flip"], kept["note"]) == (-12.5, True, "folded at the rim")
    assert export(run, output=tmp_path / "out.ome.tif", sections="z", quiet=True) == 0
    with tifffile.TiffFile(tmp_path / "out.ome.tif") as tiff:
        assert 'PhysicalSizeZ="0.07"' in tiff.ome_metadata
        assert tiff.series[0].asarray().shape == (5, 24, 30)


def test_a_stack_comes_back_with_positions_and_pixels(tmp_path):
    planes = np.stack([picture(k) for k in range(5)])
    metadata = {"axes": "ZYX", "PhysicalSizeZ": 0.5, "PhysicalSizeX": 0.2, "PhysicalSizeY": 0.2}
    tifffile.imwrite(tmp_path / "in.ome.tif", planes, metadata=metadata)
    stored = open_run(import_stack(tmp_path / "in.ome.tif", tmp_path / "run", quiet=True))
    assert stored.state is RunEnd.COMPLETED
    assert stored.layout.pixel_um == pytest.approx(0.2)
    assert [stored.planes[k].header.z_um for k in range(5)] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    for k in range(5):
        np.testing.assert_array_equal(stored.read(k), planes[k])


def test_channels_become_bands(tmp_path):
    planes = np.stack([[picture(10 * c + z) for c in range(2)] for z in range(3)])
    tifffile.imwrite(tmp_path / "in.ome.tif", planes, metadata={"axes": "ZCYX", "PhysicalSizeZ": 0.5})
    assert import_(tmp_path / "in.ome.tif", output=tmp_path / "run", channel=(0, 1), quiet=True) == 0
    stored = open_run(tmp_path / "run")
    assert stored.layout.channels == ("channel 0", "channel 1")
    for slot in range(6):
        _, band, plane = stored.layout.place(slot)
        np.testing.assert_array_equal(stored.read(slot), planes[plane, band])


def test_an_imported_run_cannot_be_gone_on_with(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", picture(0))
    path = table(tmp_path, "section,file\n0,a.tif\n2,a.tif\n")
    run = import_sections(path, tmp_path / "run", thickness_nm=70, quiet=True)
    with pytest.raises(InputError, match="imported") as error:
        interrupted_run(run, None)
    assert error.value.code == "imported-run"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("section,file\n0,\n", "it names no image"),
        ("section,file\n0,a.tif\n0,a.tif\n", "line 3: section 0 stands in the table twice"),
        ("section,file\n-1,a.tif\n", "line 2: section -1 is not within"),
        ("section,file\nx,a.tif\n", "line 2: invalid literal"),
        ("section,file\n0,gone.tif\n", "there is no"),
        ("number,file\n0,a.tif\n", "there is no column 'section'"),
        ("section,file,rotation_deg\n0,a.tif,nan\n", "is no angle"),
        ("", "it names no image"),
    ],
)
def test_every_problem_of_a_table_is_one_clear_line(tmp_path, text, words):
    tifffile.imwrite(tmp_path / "a.tif", picture(0))
    with pytest.raises(InputError, match=words) as error:
        read_table(table(tmp_path, text))
    assert error.value.code == "table"


def test_thickness_has_to_be_known_and_images_of_one_kind(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", picture(0))
    tifffile.imwrite(tmp_path / "b.tif", picture(0).astype(np.uint8))
    path = table(tmp_path, "section,file\n0,a.tif\n1,b.tif\n")
    with pytest.raises(InputError, match="thickness"):
        import_(path, output=tmp_path / "run", quiet=True)
    with pytest.raises(InputError, match="not of one kind"):
        import_(path, output=tmp_path / "run", thickness_nm=70, quiet=True)
    assert not (tmp_path / "run").exists()
