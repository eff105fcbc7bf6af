"""Real sections put out of place by known maps.

The specimen itself drifts by half a pixel a section in these pictures (undisturbed, it is found so too), which no
picture can tell from drifting sections. So without marks the undisturbed sections, aligned the same way, are the truth
of each step; with marks it is the known maps themselves.
"""

import csv
import json
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tifffile

from processing.align_cli import align
from processing.align_models import applied, distance_px
from processing.align_stack import SectionAligner

DATA = os.environ.get("STEREOTOME_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="STEREOTOME_DATA does not name the folder of example data")
SHAPE = (200, 200)
MARKS = np.array([(20.0, 25.0), (170.0, 30.0), (25.0, 175.0), (178.0, 168.0)])


@pytest.fixture(scope="module")
def source():
    return next((Path(str(DATA)) / "sections_misaligned").glob("*.tif"))


@pytest.fixture(scope="module")
def truth():
    """Maps from the block, cropped as section 0 is, to each section."""
    path = Path(str(DATA)) / "sections_misaligned" / "truth" / "transforms.json"
    crop = np.array([[1, 0, 25], [0, 1, 25], [0, 0, 1.0]])
    taken = [s["matrix_out_xy_to_src_xy"] for s in json.loads(path.read_text(encoding="utf-8"))["sections"]]
    return [np.linalg.inv(np.vstack([m, [0, 0, 1]])) @ crop for m in taken]


def found(folder):
    report = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    return [np.array(section["matrix"]) for section in report["sections"]]


def correlations(folder):
    stack = tifffile.imread(folder / "aligned.ome.tif")[:, 45:-45, 45:-45].reshape(60, -1)
    return [np.corrcoef(a, b)[0, 1] for a, b in pairwise(stack)]


def test_disturbed_sections_are_aligned_as_undisturbed_ones_are(source, truth, tmp_path, capsys):
    align(source, output=tmp_path / "out", model="rigid")
    assert "not unique" in capsys.readouterr().err
    assert np.mean(correlations(tmp_path / "out")) >= 0.95
    undisturbed = tifffile.imread(next((Path(str(DATA)) / "fibsem_medulla").glob("*.tif")))[:60, 25:225, 25:225]
    aligner = SectionAligner("rigid")
    for section in undisturbed:
        aligner.add(section)
    expected = [t @ section.matrix for t, section in zip(truth, aligner.finish().sections, strict=True)]
    errors = [distance_px(m, t, SHAPE) for m, t in zip(steps(found(tmp_path / "out")), steps(expected), strict=True)]
    assert np.mean(errors) <= 0.1


def steps(matrices):
    return [second @ np.linalg.inv(first) for first, second in pairwise(matrices)]


def test_marks_put_every_section_where_it_was(source, truth, tmp_path):
    rng = np.random.default_rng(11)
    with (tmp_path / "marks.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("section", "mark", "x_px", "y_px"))
        for k, matrix in enumerate(truth):
            places = applied(matrix, MARKS) + rng.normal(0, 0.1, MARKS.shape)
            table.writerows([(k, m, x, y) for m, (x, y) in enumerate(places)])
        table.writerows([("known", m, x, y) for m, (x, y) in enumerate(MARKS)])
    align(source, output=tmp_path / "out", fiducials=str(tmp_path / "marks.csv"), quiet=True)
    errors = [distance_px(m, t, SHAPE) for m, t in zip(found(tmp_path / "out"), truth, strict=True)]
    assert np.mean(errors) <= 0.3
    assert np.mean(correlations(tmp_path / "out")) >= 0.95
