"""Range images from files of every kind, and files that are none."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import tifffile

from devices.errors import InputError
from processing.heights import read_heights
from processing.outputs import tiff_bytes

VALUES = np.linspace(0, 5, 12, dtype=np.float32).reshape(3, 4)


def test_our_own_range_image_knows_its_pixel(tmp_path):
    path = tmp_path / "range.tif"
    path.write_bytes(tiff_bytes(VALUES, 0.25, "range in um"))
    found = read_heights(path)
    assert np.array_equal(found.values, VALUES)
    assert found.pixel == pytest.approx((0.25, 0.25), rel=1e-6)
    assert (found.unit, found.notes) == ("µm", ())
    assert read_heights(path, pixel=3.0, unit="mm").pixel == (3.0, 3.0)
    path.write_bytes(tiff_bytes(VALUES, 0.25, "range in planes counted from 0"))
    assert read_heights(path).unit == "planes"
    assert "does not say how large" in read_heights(path).notes[0]


@pytest.mark.parametrize("name", ["height_um", "elevation", "z"])
def test_arrays_by_name(tmp_path, name):
    np.savez(tmp_path / "h.npz", **{name: VALUES.astype(np.int16)}, pixel_um=np.array([0.5, 0.25]))
    found = read_heights(tmp_path / "h.npz")
    assert found.pixel == (0.5, 0.25)
    assert found.values.dtype == np.float32
    np.save(tmp_path / "h.npy", VALUES)
    assert read_heights(tmp_path / "h.npy").pixel == (1.0, 1.0)


def test_what_is_unknown_stays_unknown_and_flat_is_shown(tmp_path):
    np.save(tmp_path / "h.npy", np.where(VALUES > 4, np.inf, VALUES))
    found = read_heights(tmp_path / "h.npy")
    assert np.isnan(found.values).sum() == (VALUES > 4).sum()
    assert found.limits == (0.0, pytest.approx(VALUES[VALUES <= 4].max()))
    np.save(tmp_path / "flat.npy", np.full((2, 2), 7.0))
    assert read_heights(tmp_path / "flat.npy").limits == (6.5, 7.5)


@pytest.mark.parametrize(
    "array",
    [np.zeros((3, 4, 3)), np.zeros(5), np.zeros((1, 9)), np.full((4, 4), np.nan), np.array([["a", "b"], ["c", "d"]])],
)
def test_what_is_no_range_image_is_refused(tmp_path, array):
    np.save(tmp_path / "h.npy", array)
    with pytest.raises(InputError) as refused:
        read_heights(tmp_path / "h.npy")
    assert refused.value.code == "heights"


def test_files_that_are_not_there_or_broken_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_heights(tmp_path / "none.tif")
    (tmp_path / "bad.tif").write_bytes(b"II*\0 and so on")
    with pytest.raises(InputError, match="damaged"):
        read_heights(tmp_path / "bad.tif")
    np.savez(tmp_path / "h.npz", a=VALUES)
    with pytest.raises(InputError, match=r"holds a; none is called height_um"):
        read_heights(tmp_path / "h.npz")
    tifffile.imwrite(tmp_path / "stack.tif", np.zeros((4, 8, 8), np.float32), photometric="minisblack")
    with pytest.raises(InputError, match="no range image"):
        read_heights(tmp_path / "stack.tif")
    np.save(tmp_path / "h.npy", VALUES)
    for pixel in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="is none"):
            read_heights(tmp_path / "h.npy", pixel=pixel)


def test_instruments_need_the_extra(tmp_path, monkeypatch):
    (tmp_path / "a.al3d").write_bytes(b"AliconaImaging")
    monkeypatch.setattr("processing.heights.find_spec", lambda _: None)
    with pytest.raises(InputError) as refused:
        read_heights(tmp_path / "a.al3d")
    assert refused.value.code == "extra-missing"


def test_files_of_instruments_come_in_um_with_rows_down(tmp_path, monkeypatch):
    """The library's own view, with x first; its files are read in tests/real."""
    topography = types.SimpleNamespace(
        unit="nm", physical_sizes=(4000.0, 1500.0), heights=lambda: np.ma.masked_greater(1000 * VALUES.T, 4000)
    )
    library = types.ModuleType("SurfaceTopography")
    library.open_topography = lambda _: types.SimpleNamespace(topography=lambda: topography)
    errors = types.ModuleType("SurfaceTopography.Exceptions")
    errors.CannotDetectFileFormat = KeyError
    monkeypatch.setitem(sys.modules, "SurfaceTopography", library)
    monkeypatch.setitem(sys.modules, "SurfaceTopography.Exceptions", errors)
    monkeypatch.setattr("processing.heights.find_spec", lambda _: library)
    (tmp_path / "a.mi").write_bytes(b"x")
    found = read_heights(tmp_path / "a.mi")
    assert found.pixel == pytest.approx((0.5, 1.0))
    assert np.nanmax(np.abs(found.values - VALUES)) < 1e-6
    assert np.isnan(found.values).sum() == (VALUES > 4).sum()
