"""Volume filters against the slow functions of SciPy, and against what can be said in advance."""

from __future__ import annotations

import json
from itertools import product

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from devices.errors import InputError
from processing import volume_filters as filters
from processing.neighbours import ball, neighbours
from processing.networks import selecting_pairs, sorting_pairs

RNG = np.random.default_rng(41)
CUT = (7, 9, 11)
NOISE = RNG.random(CUT)


def noise(dtype: str) -> np.ndarray:
    top = {"uint8": 256, "uint16": 65536, "float32": 1}[dtype]
    return (NOISE * top).astype(dtype)


def footprint(near) -> np.ndarray:
    reach = np.abs(near.offsets).max(axis=0)
    mask = np.zeros(2 * reach + 1, bool)
    mask[tuple((near.offsets + reach).T)] = True
    return mask


KINDS = [(6, 0.0), (18, 0.0), (26, 0.0), (26, 2.3)]


@pytest.mark.parametrize("count", range(1, 12))
def test_a_network_sorts_every_order_of_zeros_and_ones_hence_every_order(count: int) -> None:
    for bits in product((0, 1), repeat=count):
        numbers = list(bits)
        for low, high in sorting_pairs(count):
            if numbers[low] > numbers[high]:
                numbers[low], numbers[high] = numbers[high], numbers[low]
        assert numbers == sorted(bits)


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=40), st.data())
def test_a_network_cut_down_to_one_rank_still_finds_it(numbers: list[int], data: st.DataObject) -> None:
    rank = data.draw(st.integers(0, len(numbers) - 1))
    work = list(numbers)
    for low, high in selecting_pairs(len(numbers), rank):
        if work[low] > work[high]:
            work[low], work[high] = work[high], work[low]
    assert work[rank] == sorted(numbers)[rank]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize(("rule", "radius"), KINDS)
def test_ranks_equal_scipys(dtype: str, rule: int, radius: float) -> None:
    grey, near = noise(dtype), ball(radius) if radius else neighbours(rule)
    count = len(near.offsets)
    for percent in (0, 30, 50, 100):
        place = int(np.ceil(percent / 100 * (count - 1) - 0.5))
        expected = ndimage.rank_filter(grey, place, footprint=footprint(near), mode="nearest")
        np.testing.assert_array_equal(filters.rank(grey, percent=percent, rule=rule, radius=radius), expected)
    assert filters.median(grey, rule=rule, radius=radius).dtype == grey.dtype


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize(("rule", "radius"), KINDS)
def test_variance_and_entropy_equal_the_slow_ones(dtype: str, rule: int, radius: float) -> None:
    grey, near = noise(dtype), ball(radius) if radius else neighbours(rule)
    slow = {"footprint": footprint(near), "mode": "nearest"}
    expected = ndimage.generic_filter(grey.astype(np.float64), np.var, **slow)
    np.testing.assert_allclose(filters.variance(grey, rule=rule, radius=radius), expected, rtol=2e-5)
    levels = ((grey - np.float32(grey.min())) * np.float32(63.999 / np.ptp(grey.astype(float)))).astype(np.uint8)
    expected = ndimage.generic_filter(levels.astype(np.float64), bits, **slow)
    np.testing.assert_allclose(filters.entropy(grey, rule=rule, radius=radius), expected, atol=1e-5)


def bits(values: np.ndarray) -> float:
    share = np.unique(values, return_counts=True)[1] / values.size
    return float(-(share * np.log2(share)).sum())


def test_variance_of_bright_even_noise_does_not_cancel() -> None:
    grey = (60000 + RNG.integers(0, 2, CUT)).astype(np.uint16)
    assert 0.2 < filters.variance(grey).mean() < 0.26


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_gradient_of_a_ramp_is_its_slope_in_um(dtype: str) -> None:
    z, y, x = np.meshgrid(*(np.arange(n, dtype=float) for n in CUT), indexing="ij")
    ramp = (2 * z + 3 * y + 6 * x).astype(dtype)
    spacing_um = (1.0, 0.5, 0.5)
    inside = (slice(1, -1),) * 3
    slope = np.array([2 / 1.0, 3 / 0.5, 6 / 0.5])
    np.testing.assert_allclose(filters.sobel(ramp, spacing_um)[inside], np.linalg.norm(slope), rtol=1e-5)
    length, azimuth, elevation = filters.gradient(ramp, spacing_um)
    np.testing.assert_allclose(length[inside], np.linalg.norm(slope), rtol=1e-5)
    np.testing.assert_allclose(azimuth[inside], np.degrees(np.arctan2(slope[1], slope[2])), rtol=1e-5)
    np.testing.assert_allclose(elevation[inside], np.degrees(np.arcsin(2 / np.linalg.norm(slope))), rtol=1e-4)


def test_sobel_equals_scipys() -> None:
    grey = noise("uint16").astype(np.float64)
    expected = np.sqrt(sum(ndimage.sobel(grey, axis, mode="nearest") ** 2 for axis in range(3))) / 32
    np.testing.assert_allclose(filters.sobel(grey.astype(np.uint16)), expected, rtol=1e-4)


def basis() -> np.ndarray:
    """The 27 products, each (3, 3, 3), as Frei and Chen would have them."""
    lines = [np.array([1, 1, 1]) / 3**0.5, np.array([-1, 0, 1]) / 2**0.5, np.array([1, -2, 1]) / 6**0.5]
    return np.array([np.einsum("i,j,k", a, b, c) for a, b, c in product(lines, repeat=3)])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_frei_chen_equals_the_projection_on_the_basis(seed: int) -> None:
    cube = np.random.default_rng(seed).integers(0, 256, (3, 3, 3)).astype(np.uint8)
    edges, lines = filters.frei_chen(cube)
    members = basis()
    odd = np.array([np.allclose(member, -member[::-1, ::-1, ::-1]) for member in members])
    assert odd.sum() == 13
    shares = np.tensordot(members, cube.astype(float), 3) ** 2
    spent = shares[1:].sum()
    np.testing.assert_allclose(edges[1, 1, 1], np.sqrt(shares[odd].sum() / spent), atol=1e-5)
    np.testing.assert_allclose(lines[1, 1, 1], np.sqrt(shares[~odd][1:].sum() / spent), atol=1e-5)


def test_frei_chen_tells_a_step_from_a_line_whatever_the_contrast() -> None:
    step, line = np.zeros((5, 5, 5), np.float32), np.zeros((5, 5, 5), np.float32)
    step[:, :, 2:] = 0.25
    step[:, :, 2] = 0.125
    line[:, 2, 2] = 700
    assert filters.frei_chen(step)[0][2, 2, 2] == pytest.approx(1)
    assert filters.frei_chen(line)[1][2, 2, 2] == pytest.approx(1)
    assert not np.any(filters.frei_chen(np.full((4, 4, 4), 9, np.uint8)))


def test_a_template_is_found_where_it_is_at_any_brightness() -> None:
    grey = RNG.normal(0, 0.05, (12, 20, 20)).astype(np.float32)
    pattern = np.zeros((3, 5, 5), np.float32)
    pattern[1, 1:4, 1:4] = 1
    grey[5:8, 8:13, 3:8] += 3 * pattern + 7
    found = filters.template(grey, pattern)
    assert np.unravel_index(found.argmax(), found.shape) == (6, 10, 5)


def test_distant_planes_do_not_mix_and_it_is_said() -> None:
    grey, far = noise("uint8"), (3.5, 1.0, 1.0)
    expected = [ndimage.median_filter(plane, 3, mode="nearest") for plane in grey]
    np.testing.assert_array_equal(filters.median(grey, far), expected)
    assert "plane by plane" in filters.note_on(far)
    assert not filters.note_on((3.0, 1.0, 1.0))
    sharp = np.zeros(CUT, np.uint8)
    sharp[3] = 200
    assert not filters.sobel(sharp, far).any()
    with pytest.raises(InputError, match="cubes"):
        filters.frei_chen(grey, far)


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (lambda: filters.median(np.zeros((3, 4))), "volume-shape"),
        (lambda: filters.median(np.zeros((0, 4, 4))), "volume-shape"),
        (lambda: filters.sobel(np.full((3, 3, 3), np.nan)), "volume-nan"),
        (lambda: filters.rank(np.zeros(CUT), percent=101), "operator-params"),
        (lambda: filters.median(np.zeros(CUT), rule=8), "neighbours"),
        (lambda: filters.median(np.zeros(CUT), (0.0, 1.0, 1.0)), "spacing"),
        (lambda: filters.template(np.zeros(CUT), np.zeros((3, 3, 3))), "operator-inputs"),
    ],
)
def test_what_cannot_be_filtered_is_refused_in_words(wrong, code: str) -> None:
    with pytest.raises(InputError) as refused:
        wrong()
    assert refused.value.code == code


def test_one_plane_and_one_voxel_are_volumes_too() -> None:
    for shape in ((1, 4, 5), (1, 1, 1)):
        grey = np.full(shape, 7, np.uint8)
        np.testing.assert_array_equal(filters.median(grey), grey)
        assert not filters.sobel(grey).any()
        assert not filters.variance(grey).any()
        assert not filters.entropy(grey).any()


def test_the_command_filters_a_stack_and_says_how(tmp_path, capsys) -> None:
    from devices.cli import run

    np.save(tmp_path / "grey.npy", noise("uint8"))
    arguments = [
        str(tmp_path / "grey.npy"),
        "-o",
        str(tmp_path / "out"),
        "--step-um",
        "2",
        "--pixel-um",
        "0.5",
        "--json",
    ]
    assert run(["process", "volume", "filter.median:rule=6", *arguments, "--then", "filter.sobel"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert [step["operator"] for step in report["steps"]] == ["filter.median", "filter.sobel"]
    assert report["spacing_um"] == [2, 0.5, 0.5]
    assert "plane by plane" in said.err
    made = tifffile.imread(tmp_path / "out" / "volume.ome.tif")
    np.testing.assert_array_equal(
        made, filters.sobel(filters.median(noise("uint8"), (2, 0.5, 0.5), rule=6), (2, 0.5, 0.5))
    )


@pytest.mark.parametrize("wrong", ["filter.medain", "filter.median:rule=7", "filter.median:rule", "absent.toml"])
def test_a_wrong_step_is_one_clear_line_and_leaves_nothing(wrong: str, tmp_path, capsys) -> None:
    from devices.cli import run

    np.save(tmp_path / "grey.npy", np.zeros(CUT, np.uint8))
    assert run(["process", "volume", wrong, str(tmp_path / "grey.npy"), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("error[") == 1
    assert not (tmp_path / "out").exists()
