"""Every example of the shared data that is a stack opens as what it is; all others are refused in one clear line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from devices.errors import InputError
from processing.stack import open_stack

DATA = Path(os.environ.get("STEREOTOME_DATA", "/nowhere"))
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="set STEREOTOME_DATA to the folder of example data to test on real images"
)

# path, options, planes, shape of one, type
STACKS = [
    ("focus_pcb", {}, 7, (1536, 2048, 3), "uint8"),
    ("focus_scorpion", {}, 14, (486, 648, 3), "uint8"),
    ("focus_generated/stack1", {}, 41, (400, 400), "uint8"),
    ("focus_generated/stack2", {}, 41, (400, 400), "uint8"),
    ("focus_generated/stack3", {}, 41, (400, 400), "uint8"),
    ("confocal_arabidopsis/arabidopsis-embryo.tif", {}, 106, (112, 109), "uint8"),
    ("confocal_ovule/sample_ovule.tif", {}, 32, (128, 128), "uint8"),
    ("confocal_mitotic", {}, 6, (263, 263), "uint8"),
    ("multiband_bpae/bpae_actin_mito_nuclei_3x680x1100.tif", {}, 3, (680, 1100), "uint16"),
    ("fibsem_medulla", {}, 125, (250, 250), "uint8"),
    ("sections_misaligned", {}, 60, (200, 200), "uint8"),
    ("vol_colin27/colin27_T1_1mm.nii.gz", {}, 181, (217, 181), "uint8"),
    ("imagexpress_zstack", {"channel": 0}, 10, (512, 512), "uint16"),
    ("imagexpress_zstack", {"channel": 1}, 10, (512, 512), "uint16"),
    ("ndtiff/v3_12_bit_pycromanager_mda", {"channel": 0}, 4, (64, 64), "uint16"),
    ("ndtiff/v2_ndtiffv2_0_test/Full resolution", {"channel": 1}, 5, (32, 32), "uint16"),
    ("ome_tiff_small/bfconvert_rgb.ome.tiff", {}, 1, (25, 26, 3), "uint8"),
    ("ome_tiff_small/multiseries.ome.tiff", {"channel": 3}, 1, (5, 5), "uint16"),
    ("ome_zarr_examples/valid/image-02.zarr", {}, 1, (200, 200), "uint16"),
    ("ome_zarr_examples/valid/image-03.zarr", {}, 2, (100, 100), "uint16"),
    ("ome_zarr_bioformats2raw/camera.ome.zarr", {}, 1, (480, 640), "uint8"),
]

REFUSED = [
    ("imagexpress_zstack", "stack-channel", "--channel N"),
    ("ndtiff/v3_12_bit_pycromanager_mda", "stack-channel", "--channel N"),
    ("ome_tiff_small/multiseries.ome.tiff", "stack-channel", "--channel N"),
    ("ome_zarr_examples/valid/plate-01.zarr", "input-unknown", "It is a plate"),
    ("ome_zarr_bioformats2raw/camera.ome.zarr/0/0", "input-unknown", "the folder above"),
    ("focus_generated", "stack-empty", "stack1, stack2, stack3"),
    ("ome_companion_xml", "stack-empty", "name a folder"),
    ("heights_instruments", "stack-empty", "name a folder"),
    ("heights_instruments/al3d-1.al3d", "input-unknown", "give a run folder"),
    ("stereo_motorcycle/truth/disparity_left.npz", "stack-nan", "replace them"),
    ("README.md", "input-unknown", "give a run folder"),
]


@pytest.mark.parametrize(("name", "options", "planes", "shape", "dtype"), STACKS)
def test_a_stack_is_read_to_its_last_plane(
    name: str, options: dict[str, int], planes: int, shape: tuple[int, ...], dtype: str
) -> None:
    stack = open_stack(DATA / name, **options)  # type: ignore[arg-type]
    assert (len(stack), stack.shape, stack.dtype) == (planes, shape, dtype)
    assert stack[planes - 1].shape == shape
    assert stack[planes // 2].any()


@pytest.mark.parametrize(("name", "code", "words"), REFUSED)
def test_what_is_no_single_stack_is_refused_with_a_way_out(name: str, code: str, words: str) -> None:
    with pytest.raises(InputError) as error:
        list(open_stack(DATA / name))
    assert error.value.code == code
    assert words in error.value.message()


def test_imagexpress_positions_come_from_its_tags() -> None:
    stack = open_stack(DATA / "imagexpress_zstack", channel=0)
    assert stack.z_um is not None
    assert stack.z_um[[0, -1]] == pytest.approx([9318.24, 9363.56])
    assert np.diff(stack.z_um).mean() == pytest.approx(5.036, abs=1e-3)
    assert stack.pixel_um == pytest.approx(1.3668)
    assert stack.notes == ()


def test_mitotic_spacing_comes_from_its_imagej_tags() -> None:
    stack = open_stack(DATA / "confocal_mitotic")
    assert stack.z_um == pytest.approx(3.0 * np.arange(6))
    assert stack.pixel_um == pytest.approx(0.0852, abs=1e-4)


def test_the_fused_reference_beside_the_pcb_frames_is_left_out_and_said_so() -> None:
    assert "reference_fused_by_focus-stack.jpg" in open_stack(DATA / "focus_pcb").notes[0]


def test_bioformats2raw_equals_the_jpeg_it_was_made_from() -> None:
    raw = open_stack(DATA / "ome_zarr_bioformats2raw" / "camera.ome.zarr")
    jpeg = open_stack(DATA / "ome_zarr_bioformats2raw" / "camera.jpg")
    assert np.array_equal(raw[0], jpeg[0] if jpeg[0].ndim == 2 else jpeg[0][..., 0])


def test_colin_in_micrometres() -> None:
    stack = open_stack(DATA / "vol_colin27" / "colin27_T1_1mm.nii.gz")
    assert stack.z_um == pytest.approx(1000.0 * np.arange(181))
    assert stack.pixel_um == 1000
