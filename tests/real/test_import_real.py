"""Data sets of other programs become runs whose planes have the pixels an independent reader sees."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
import zarr

from acquire.store import open_run
from processing.importing import import_stack

DATA = Path(os.environ.get("STEREOTOME_DATA", "/nowhere"))
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="set STEREOTOME_DATA to the folder of example data to test on real images"
)


def planes_of(run: Path) -> list[np.ndarray]:
    stored = open_run(run)
    return [stored.read(slot) for slot in sorted(stored.planes)]


@pytest.mark.parametrize(
    "name",
    [
        "ndtiff/v3_12_bit_pycromanager_mda/12_bit_pycromanager_mda_NDTiffStack.tif",
        "ndtiff/v2_ndtiffv2_0_test/Full resolution/ndtiffv2.0_test_NDTiffStack.tif",
    ],
)
@pytest.mark.parametrize("channel", [0, 1])
def test_micro_manager_ndtiff(tmp_path, name, channel):
    with tifffile.TiffFile(DATA / name) as tiff:
        series = tiff.series[0]
        expected = np.moveaxis(series.asarray(), series.axes.index("C"), 0)[channel]
    run = import_stack(DATA / name, tmp_path / "run", channels=[channel], quiet=True)
    np.testing.assert_array_equal(np.stack(planes_of(run)), expected.reshape(-1, *expected.shape[-2:]))


def test_imagexpress_series(tmp_path):
    folder = DATA / "imagexpress_zstack"
    run = import_stack(folder / "E07_s1_w1_z*.tif", tmp_path / "run", quiet=True)
    files = sorted(folder.glob("E07_s1_w1_z*.tif"))
    np.testing.assert_array_equal(np.stack(planes_of(run)), np.stack([tifffile.imread(file) for file in files]))
    z_um = [open_run(run).planes[k].header.z_um for k in range(len(files))]
    assert len(set(z_um)) == len(files)


def test_ome_zarr_of_bioformats2raw(tmp_path):
    store = DATA / "ome_zarr_bioformats2raw" / "camera.ome.zarr"
    run = import_stack(store, tmp_path / "run", quiet=True)
    full = zarr.open_group(store, mode="r")["0/0"][0, 0, 0]
    np.testing.assert_array_equal(planes_of(run)[0], full)
    assert json.loads((run / "run.json").read_text())["imported"]["from"].endswith("camera.ome.zarr")
