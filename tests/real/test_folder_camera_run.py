"""Images replayed by the folder camera, taken by a run on the simulated stage, give the range image of the folder."""

import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
from wires import stereotome

pytestmark = pytest.mark.skipif("STEREOTOME_DATA" not in os.environ, reason="STEREOTOME_DATA names no example data")

RIG = """
schema = 1
name = "replay"
[camera]
driver = "folder"
source = "{images}"
z0_um = 0.0
step_um = 1.0
exposure_ms = 1.0
[optics]
magnification = 10.0
na = 0.3
[stage.z]
driver = "asi-ms2000"
port = "the bench's"
baud = 115200
limits = {{ min_um = -50.0, max_um = 50.0 }}
"""

RECIPE = """
schema = 1
[output]
keep_free_gb = 0.1
[stack]
bottom_um = 0.0
top_um = 40.0
step = 1.0
[process]
range_image = true
"""


def test_a_run_of_replayed_images_gives_the_range_of_their_folder(tmp_path):
    images = Path(os.environ["STEREOTOME_DATA"]) / "focus_generated" / "stack1"
    (tmp_path / "rig.toml").write_text(RIG.format(images=images))
    (tmp_path / "recipe.toml").write_text(RECIPE)
    run = tmp_path / "run"
    taken = stereotome("run", tmp_path / "recipe.toml", "-i", tmp_path / "rig.toml", "--sim", "--out", run)
    assert taken.code == 0, taken.err
    direct = stereotome("process", "focus", images, "-o", tmp_path / "direct", "--step-um", "1.0")
    assert direct.code == 0, direct.err
    for name in ("range.tif", "extended_focus.tif", "confidence.tif"):
        np.testing.assert_array_equal(
            tifffile.imread(run / "focus" / name), tifffile.imread(tmp_path / "direct" / name)
        )
