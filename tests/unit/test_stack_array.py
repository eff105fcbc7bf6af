"""NPY, NPZ and NIfTI as stacks, and number types a camera does not give."""

from __future__ import annotations

from typing import TYPE_CHECKING

import nibabel
import numpy as np
import pytest

from devices.errors import InputError
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

VOLUME = np.random.default_rng(7).integers(0, 65536, (4, 8, 9), np.uint16)


def save(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def test_npy_is_z_y_x(tmp_path: Path) -> None:
    stack = open_stack(save(tmp_path / "a.npy", VOLUME), step_um=0.5)
    assert np.array_equal(np.stack(list(stack)), VOLUME)
    assert stack.z_um == pytest.approx([0, 0.5, 1, 1.5])


def test_npy_with_a_last_axis_of_three_is_colour(tmp_path: Path) -> None:
    assert open_stack(save(tmp_path / "a.npy", np.zeros((4, 8, 9, 3), np.uint8))).shape == (8, 9, 3)


def test_npz_of_one_stack(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", planes=VOLUME, spacing=0.5)
    assert np.array_equal(open_stack(tmp_path / "a.npz")[3], VOLUME[3])


@pytest.mark.parametrize("arrays", [{"a": VOLUME, "b": VOLUME}, {"a": np.zeros(3)}, {}])
def test_npz_of_no_single_stack_lists_what_it_holds(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="holds no single stack"):
        open_stack(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.nii", "a.nii.gz"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 0.98])
def test_a_cut_file_is_refused(tmp_path: Path, name: str, share: float) -> None:
    writers = {"y": np.save, "z": lambda path, array: np.savez(path, a=array)}
    path = tmp_path / name
    if ".nii" in name:
        nibabel.save(nibabel.Nifti1Image(VOLUME, np.eye(4)), path)
    else:
        writers[name[-1]](path, VOLUME)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="is damaged"):
        list(open_stack(path))


def test_npy_of_objects_is_not_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{}, []], object), allow_pickle=True)
    with pytest.raises(InputError):
        open_stack(tmp_path / "a.npy")


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000), ("micron", 1), ("unknown", 1000)])
def test_nifti_axes_and_units(tmp_path: Path, name: str, unit: str, factor: float) -> None:
    image = nibabel.Nifti1Image(VOLUME.transpose(2, 1, 0), np.diag([0.5, 0.5, 2.0, 1.0]))
    image.header.set_xyzt_units(xyz=unit)
    nibabel.save(image, tmp_path / name)
    stack = open_stack(tmp_path / name)
    assert np.array_equal(np.stack(list(stack)), VOLUME)
    assert stack.z_um == pytest.approx(2.0 * factor * np.arange(4))
    assert stack.pixel_um == pytest.approx(0.5 * factor)
    assert bool(stack.notes) == (unit == "unknown")


def test_nifti_colour(tmp_path: Path) -> None:
    voxel = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
    colour = np.random.default_rng(8).integers(0, 256, (9, 8, 4, 3), np.uint8)
    nibabel.save(nibabel.Nifti1Image(colour.view(voxel)[..., 0], np.eye(4)), tmp_path / "a.nii")
    stack = open_stack(tmp_path / "a.nii")
    assert np.array_equal(np.stack(list(stack)), colour.transpose(2, 1, 0, 3))


def test_fractions_are_mapped_to_16_bit_and_said_so(tmp_path: Path) -> None:
    volume = np.linspace(-0.25, 0.75, 4 * 8 * 9).reshape(4, 8, 9)
    stack = open_stack(save(tmp_path / "a.npy", volume))
    assert stack.dtype == np.uint16
    assert np.stack(list(stack)) == pytest.approx((volume + 0.25) * 65535, abs=0.5)
    assert "float64 pixels: -0.25 … 0.75 is mapped to 0 … 65535." in stack.notes


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.uint32, np.int64])
def test_whole_numbers_within_16_bit_are_kept(tmp_path: Path, dtype: type[np.generic]) -> None:
    volume = (VOLUME // 2).astype(dtype)
    assert np.array_equal(np.stack(list(open_stack(save(tmp_path / "a.npy", volume)))), volume)


def test_negative_whole_numbers_are_mapped(tmp_path: Path) -> None:
    volume = np.arange(-100, 100, dtype=np.int16).reshape(2, 10, 10)
    stack = open_stack(save(tmp_path / "a.npy", volume))
    assert stack[0][0, 0] == 0
    assert stack[1][-1, -1] == 65535


def test_pixels_that_are_not_numbers_are_refused(tmp_path: Path) -> None:
    volume = np.zeros((3, 4, 5))
    volume[1, 2, 2] = np.nan
    with pytest.raises(InputError, match="plane 1 has pixels that are not numbers"):
        open_stack(save(tmp_path / "a.npy", volume))


@pytest.mark.parametrize("shape", [(0, 4, 5), (3, 0, 5), (7,), (2, 2, 2, 2, 5)])
def test_shapes_that_are_no_stack(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError):
        open_stack(save(tmp_path / "a.npy", np.zeros(shape, np.uint8)))


def test_complex_pixels_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="complex128"):
        open_stack(save(tmp_path / "a.npy", np.zeros((3, 4, 5), complex)))
