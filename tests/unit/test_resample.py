"""To cubic voxels against functions whose values between the planes are known."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile

from devices.cli import run
from devices.errors import InputError
from processing.resample import CubicPlanes, choose_method, taps
from processing.resample_cli import FILES
from processing.stack import open_stack

if TYPE_CHECKING:
    from pathlib import Path

EVEN = np.arange(8) * 2.0
UNEVEN = np.cumsum([0, 2, 1, 3, 2, 2, 1, 3.0])


def ramp(z: np.ndarray, power: int = 1) -> list[np.ndarray]:
    return [np.full((6, 7), round(10 + 1.5 * value**power), np.uint16) for value in z]


@pytest.mark.parametrize("z", [EVEN, UNEVEN, EVEN[::-1], UNEVEN[::-1]])
@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_a_slope_stays_a_slope_whatever_the_spacing(z: np.ndarray, method: str):
    planes = CubicPlanes(ramp(z * 10), z, 0.5, 0.5, method)  # type: ignore[arg-type]
    found = [float(planes[k][0, 0]) for k in range(len(planes))]
    np.testing.assert_allclose(found, 10 + 15 * planes.z_um, atol=0.51)
    assert planes.z_um[0] == 0
    assert planes.z_um[-1] == 14


def test_cubic_is_catmull_and_rom_s_on_even_planes_and_passes_through_all():
    made = taps(EVEN, 5.0, "cubic")
    assert dict(zip(made.planes, np.round(made.weights, 9), strict=True)) == {
        1: -0.0625,
        2: 0.5625,
        3: 0.5625,
        4: -0.0625,
    }
    for k, z in enumerate(EVEN):
        assert taps(EVEN, float(z), "cubic").planes == (k,)


@pytest.mark.parametrize("method", ["nearest", "linear", "cubic"])
def test_weights_sum_to_one_and_parabolas_are_kept_by_cubics(method: str):
    z = np.linspace(0, 14, 57)
    for at in z:
        made = taps(UNEVEN, float(at), method)  # type: ignore[arg-type]
        assert abs(sum(made.weights) - 1) < 1e-9
    inner = taps(EVEN, 7.3, "cubic")
    assert abs(sum(w * EVEN[k] ** 2 for k, w in zip(inner.planes, inner.weights, strict=True)) - 7.3**2) < 1e-9


def test_binning_takes_means_and_keeps_every_plane():
    rng = np.random.default_rng(1)
    stack = [rng.integers(0, 255, (12, 16), dtype=np.uint8) for _ in range(4)]
    planes = CubicPlanes(stack, np.arange(4) * 4.0, 1.0, 4.0, "bin")
    assert (len(planes), planes.shape) == (4, (3, 4))
    expected = stack[2].reshape(3, 4, 4, 4).mean((1, 3))
    np.testing.assert_allclose(planes[2], expected, atol=0.51)


def test_the_choice_is_by_the_shape_of_the_voxels():
    assert choose_method(3.1, 1.0)[0] == "bin"
    assert choose_method(2.9, 1.0)[0] == "linear"


@pytest.mark.parametrize("sizes", [(0, 1), (1, -1), (np.nan, 1), (1, 1e-9)])
def test_senseless_sizes_are_refused(sizes):
    with pytest.raises(InputError):
        CubicPlanes([np.zeros((900, 900), np.uint8)] * 3, np.arange(3.0), *sizes, "linear")


def command(path: Path, out: Path, *more: object) -> int:
    return run(["process", "resample", str(path), "-o", str(out), "-q", *map(str, more)])


def test_the_command_writes_a_volume_that_can_be_read_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "stack.npy"
    np.save(path, np.stack(ramp(EVEN * 10)))
    assert command(path, tmp_path / "out", "--step-um", 2, "--pixel-um", 1, "--method", "cubic") == 0
    assert "15×6×7 voxels of 1 µm, cubic" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(FILES)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["method"] == "cubic"
    assert report["notes"][-1] == "cubic, as asked for."
    for name in FILES[:2]:
        stack = open_stack(tmp_path / "out" / name)
        assert (len(stack), stack.shape, stack.pixel_um) == (15, (6, 7), 1.0)
        np.testing.assert_allclose(stack.z_um, np.arange(15.0))
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / FILES[1]), np.stack([stack[k] for k in range(15)]))


@pytest.mark.parametrize(
    ("shape", "more", "words"),
    [
        ((4, 6, 7), (), "does not tell the size of its voxels"),
        ((4, 6, 7), ("--step-um", -2, "--pixel-um", 1), "plane spacing of -2"),
        ((4, 6, 7), ("--step-um", 2, "--pixel-um", 0), "does not tell the size"),
        ((1, 6, 7), ("--step-um", 2, "--pixel-um", 1), "does not tell the size"),
        ((4, 6, 7), ("--step-um", 2, "--pixel-um", 1, "--side-um", 1e-9), "voxels of 1e-09 µm"),
    ],
)
def test_bad_input_is_one_clear_line(shape, more, words, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "stack.npy"
    np.save(path, np.zeros(shape, np.uint8))
    assert command(path, tmp_path / "out", *more) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
