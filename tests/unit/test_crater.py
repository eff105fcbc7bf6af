"""Layers at known depths, seen through a crater of known shape, come back flat."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile

from devices.cli import run
from processing.crater import depths_um, unbent

if TYPE_CHECKING:
    from pathlib import Path

HEIGHT, WIDTH, PLANES = 20, 30, 41


def floor() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return 6 + 2 * x / WIDTH + 1.5 * (y / HEIGHT) ** 2


def truth(depth: np.ndarray | float) -> np.ndarray:
    """Grey value at a depth in µm: slow layers."""
    return 100 + 80 * np.sin(np.asarray(depth) * 0.9)


def taken() -> np.ndarray:
    share = np.arange(PLANES)[:, None, None] / (PLANES - 1)
    return np.rint(truth(share * floor())).astype(np.uint8)


def test_layers_come_back_flat_and_below_the_floor_nothing_is_known():
    depths = depths_um(floor(), 33)
    for depth, (plane, known) in zip(depths, unbent(taken(), floor(), depths), strict=True):
        np.testing.assert_array_equal(known, depth <= floor() * (1 + 1e-9))
        np.testing.assert_allclose(plane[known], truth(depth), atol=1.5)
        assert (plane[~known] == 0).all()


def test_colour_planes_keep_their_colours():
    colour = np.repeat(taken()[..., None], 3, axis=3) // np.array([1, 2, 4], np.uint8)
    plane, known = next(unbent(colour, floor(), np.array([2.0])))
    np.testing.assert_allclose(plane[known][:, 1], truth(2.0) / 2, atol=1.5)


@pytest.mark.parametrize("heights", [False, True])
def test_the_command_writes_even_depths(tmp_path: Path, heights: bool):
    tifffile.imwrite(tmp_path / "stack.tif", taken(), photometric="minisblack")
    tifffile.imwrite(tmp_path / "floor.tif", (-floor() if heights else floor()).astype(np.float32))
    out = tmp_path / "out"
    arguments = [tmp_path / "stack.tif", tmp_path / "floor.tif", "-o", out, *(["--heights"] if heights else [])]
    assert run(["process", "crater", *map(str, arguments), "-q"]) == 0
    made, known = tifffile.imread(out / "unbent.tif"), tifffile.imread(out / "known.tif") > 0
    depths = np.array(json.loads((out / "report.json").read_text())["depths_um"])
    expected = np.broadcast_to(truth(depths)[:, None, None], made.shape)
    np.testing.assert_allclose(made[known], expected[known], atol=1.5)
    assert (out / "unbent.png").stat().st_size > 1000


def test_a_crater_that_makes_no_sense_is_one_clear_error(tmp_path: Path, capsys):
    tifffile.imwrite(tmp_path / "stack.tif", taken(), photometric="minisblack")
    cases = {"shape": np.ones((5, 6), np.float32), "flat": -np.ones((HEIGHT, WIDTH), np.float32)}
    for code, values in cases.items():
        np.save(tmp_path / f"{code}.npy", values)
        arguments = [tmp_path / "stack.tif", tmp_path / f"{code}.npy", "-o", tmp_path / "out", "-q"]
        assert run(["process", "crater", *map(str, arguments)]) == 2
        assert f"error[crater-{code}]" in capsys.readouterr().err
