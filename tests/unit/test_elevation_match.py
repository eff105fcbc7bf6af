"""Area matching, interest operators, ordered points, markers and facets, each against a truth written out here."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import InputError
from processing import stereo_match
from processing.stereo_interest import OPERATORS, cubic_facet, isophote_curvature, local_entropy, local_variance
from processing.stereo_match import match_area
from processing.stereo_points import (
    assigned,
    best_in_order,
    facet_contours,
    facet_raster,
    facets_between,
    match_markers,
    match_points,
    misfit_to_neighbours,
    read_matches,
    shortest_network,
)

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = (120, 180)


def texture(seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(size=(shape[0], shape[1] + 80)).astype(np.float32)
    return 128 + 60 * cv2.GaussianBlur(grain, (0, 0), 1.2) / 0.23


def pair(parallax: np.ndarray, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Views whose left pixel (y, x) is seen at x - parallax in the right one; the parallax is a function of x alone."""
    scene = texture(seed)
    x = np.arange(SHAPE[1], dtype=np.float32) + 40
    left = scene[:, 40:-40]
    source = np.interp(x, x - parallax, x).astype(np.float32)  # place in the left view of each right pixel
    rows = np.arange(SHAPE[0], dtype=np.float32)[:, np.newaxis].repeat(SHAPE[1], 1)
    right = cv2.remap(scene, source[np.newaxis].repeat(SHAPE[0], 0), rows, cv2.INTER_CUBIC)
    noise = np.random.default_rng(seed + 1).normal(0, 2, (2, *SHAPE))
    return (left + noise[0]).astype(np.float32), (1.2 * right + 10 + noise[1]).astype(np.float32)


def test_a_slope_is_matched_to_hundredths_of_a_pixel_and_the_error_is_honest() -> None:
    parallax = 3.3 + 0.05 * np.arange(SHAPE[1]) - 4
    left, right = pair(parallax)
    found = match_area(left, right)
    inner = (slice(6, -6), slice(12, -20))
    error = (found.parallax_px - parallax)[inner]
    assert np.isfinite(error).mean() > 0.97
    assert np.nanmedian(np.abs(error)) < 0.05
    ratio = np.nanmedian(np.abs(error) / found.sigma_px[inner]) / 0.6745
    assert 0.6 < ratio < 1.6
    assert found.band_px[0] < parallax.min()
    assert found.band_px[1] > parallax.max()


def test_what_one_view_hides_is_left_open() -> None:
    step = np.where(np.arange(SHAPE[1]) < 90, 0.0, 12.0)
    scene = texture(5)
    left = scene[:, 40:-40].copy()
    right = texture(9)[:, 40:-40].copy()  # what only the right view sees
    right[:, :90] = left[:, :90]
    right[:, 90 - 12 : -12] = left[:, 90:]
    found = match_area(left, right, band_px=(-4, 20))
    hidden, seen = found.valid[8:-8, 80:87], np.delete(found.valid[8:-8, 8:-8], np.s_[66:90], axis=1)
    assert hidden.mean() < 0.15
    assert seen.mean() > 0.95
    wrong = np.abs(found.parallax_px - step)[:, 14:] > 1
    assert (wrong & found.valid[:, 14:]).mean() < 0.01


def test_bands_of_rows_give_the_same_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = (np.vstack([view] * 2) for view in pair(np.full(SHAPE[1], 5.4)))
    whole = match_area(left, right, band_px=(0, 12))
    monkeypatch.setattr(stereo_match, "MEMORY_BYTES", 3 * 13 * SHAPE[1] * 110)
    banded = match_area(left, right, band_px=(0, 12))
    assert np.mean(whole.valid == banded.valid) > 0.98
    both = whole.valid & banded.valid
    assert np.abs(whole.parallax_px - banded.parallax_px)[both].max() < 0.1
    monkeypatch.setattr(stereo_match, "MEMORY_BYTES", 3 * 13 * SHAPE[1] * 20)
    with pytest.raises(InputError) as refused:
        match_area(left, right, band_px=(0, 12))
    assert refused.value.code == "stereo-memory"


@pytest.mark.parametrize(
    ("left", "right", "code"),
    [
        (texture(1), texture(1)[:-1], "stereo-size"),
        (texture(1)[:20, :20], texture(1)[:20, :20], "stereo-size"),
        (np.full(SHAPE, 255, np.uint8), texture(1)[:, :180], "stereo-featureless"),
        (texture(1), np.full_like(texture(1), np.nan), "stack-nan"),
        (texture(1), texture(2), "stereo-no-match"),
        (texture(1), texture(1)[::-1], "stereo-no-match"),
    ],
)
def test_views_that_cannot_be_matched_are_refused(left: np.ndarray, right: np.ndarray, code: str) -> None:
    with pytest.raises(InputError) as refused:
        match_area(left, right)
    assert refused.value.code == code


@pytest.mark.parametrize("band", [(5, 5), (9, -9), (-500, 3)])
def test_bands_that_make_no_sense_are_refused(band: tuple[int, int]) -> None:
    with pytest.raises(InputError) as refused:
        match_area(texture(1), texture(1), band_px=band)
    assert refused.value.code == "stereo-band"


def test_a_cubic_surface_gives_its_own_coefficients() -> None:
    k = (7.0, 1.5, -2.0, 0.3, 0.7, -0.4, 0.05, -0.02, 0.03, 0.01)
    r, c = np.mgrid[-6:7, -6:7].astype(np.float64)
    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
    surface = sum(q * r**i * c**j for q, (i, j) in zip(k, powers, strict=True))
    np.testing.assert_allclose([a[6, 6] for a in cubic_facet(surface)], k[1:6], atol=1e-10)
    curvature, steep = isophote_curvature(surface)
    k2, k3, k4, k5, k6 = k[1:6]
    assert steep[6, 6] == pytest.approx(math.hypot(k2, k3))
    bend = -2 * (k2**2 * k6 - k2 * k3 * k5 + k3**2 * k4) / (k2**2 + k3**2) ** 1.5
    assert curvature[6, 6] == pytest.approx(bend)


@pytest.mark.parametrize("radius", [8.0, 15.0, 30.0])
def test_isophotes_of_a_bowl_have_the_curvature_of_circles(radius: float) -> None:
    y, x = np.mgrid[-40:41, -40:41].astype(np.float64)
    curvature, _ = isophote_curvature(x**2 + y**2)
    assert curvature[40, 40 + int(radius)] == pytest.approx(-1 / radius, rel=1e-6)
    flipped, _ = isophote_curvature(-(x**2) - y**2)
    assert flipped[40, 40 + int(radius)] == pytest.approx(1 / radius, rel=1e-6)
    assert isophote_curvature(np.full((20, 20), 3.0))[0].max() == 0


def test_variance_and_entropy_equal_their_definitions() -> None:
    image = np.random.default_rng(3).integers(0, 256, (30, 30)).astype(np.float32)
    window = image[7:14, 10:17]
    assert local_variance(image)[10, 13] == pytest.approx(window.var(), rel=1e-5)
    low, high = image.min(), image.max()
    classes = np.minimum(((window - low) * 16 / (high - low)).astype(int), 15)
    share = np.bincount(classes.ravel()) / 49
    bits = -(share[share > 0] * np.log2(share[share > 0])).sum()
    assert local_entropy(image)[10, 13] == pytest.approx(bits, rel=1e-4)


@pytest.mark.parametrize("interest", list(OPERATORS))
def test_points_of_every_operator_are_matched_in_order(interest) -> None:
    parallax = 2 + 0.04 * np.arange(SHAPE[1])
    found = match_points(*pair(parallax), interest=interest)
    assert len(found) > 30
    error = found.parallax_px - parallax[found.left[:, 0].astype(int)]
    assert np.median(np.abs(error)) < 0.08
    assert np.mean(np.abs(error) > 0.5) < 0.05


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 5))
def test_the_ordered_pairing_has_the_highest_gain_of_all(seed: int, rows: int, columns: int) -> None:
    gain = np.random.default_rng(seed).normal(size=(rows, columns))
    pairs = best_in_order(gain)
    assert all(a < c and b < d for (a, b), (c, d) in itertools.pairwise(pairs))
    every = (
        sum(gain[a, b] for a, b in zip(chosen, others, strict=True))
        for n in range(min(rows, columns) + 1)
        for chosen in itertools.combinations(range(rows), n)
        for others in itertools.combinations(range(columns), n)
    )
    assert sum(gain[a, b] for a, b in pairs) == pytest.approx(max(every))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 2))
def test_the_assignment_is_the_cheapest_of_all(seed: int, rows: int, more: int) -> None:
    cost = np.random.default_rng(seed).uniform(0, 10, (rows, rows + more))
    chosen = assigned(cost)
    assert len(set(chosen)) == rows
    best = min(sum(cost[k, j] for k, j in enumerate(p)) for p in itertools.permutations(range(rows + more), rows))
    assert sum(cost[k, j] for k, j in enumerate(chosen)) == pytest.approx(best)


def test_markers_that_pass_each_other_are_matched() -> None:
    rng = np.random.default_rng(8)
    places = np.stack([rng.uniform(30, 370, 25), 12 + 11.0 * np.arange(25)], axis=1)
    parallax = rng.uniform(-20, 20, 25)
    views = []
    y, x = np.mgrid[:300, :400]
    for sign in (0.5, -0.5):
        view = rng.normal(200, 3, (300, 400))
        for (px, py), p in zip(places, parallax, strict=True):
            view -= 120 * np.exp(-((x - px - sign * p) ** 2 + (y - py) ** 2) / (2 * 2.0**2))
        views.append(view.astype(np.float32))
    found = match_markers(*views, band_px=(-25, 25))
    assert len(found) == 25
    order = np.argsort(found.left[:, 1])
    np.testing.assert_allclose(found.parallax_px[order], parallax, atol=0.3)
    assert np.any(np.diff(found.right[np.argsort(found.left[:, 0]), 0]) < 0)


def test_a_list_edited_by_hand_is_read_and_a_broken_one_refused(tmp_path: Path) -> None:
    good = tmp_path / "good.csv"
    good.write_text("x_right,remark,x_left,y_left,y_right\n1,mine,2,3,3\n4,,6,5,5\n7,,9,9,9\n")
    np.testing.assert_allclose(read_matches(good).parallax_px, [1, 2, 2])
    for text, code in (("a,b\n1,2\n", "stereo-matches"), ("x_left,y_left,x_right,y_right\n1,2,3,4\n", "stereo-points")):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(InputError) as refused:
            read_matches(tmp_path / "bad.csv")
        assert refused.value.code == code


def test_facets_carry_a_plane_exactly_and_their_contours_are_its_lines() -> None:
    points = np.random.default_rng(6).uniform(2, 58, (40, 2))
    values = 3 + 0.5 * points[:, 0] - 0.25 * points[:, 1]
    facets = facets_between(points)
    raster = facet_raster(points, facets, values, (60, 60))
    y, x = np.mgrid[:60, :60]
    known = np.isfinite(raster)
    assert known.mean() > 0.6
    np.testing.assert_allclose(raster[known], (3 + 0.5 * x - 0.25 * y)[known], atol=1e-4)
    (pieces,) = facet_contours(points, facets, values, np.array([10.0]))
    np.testing.assert_allclose(3 + 0.5 * pieces[..., 0] - 0.25 * pieces[..., 1], 10, atol=1e-9)
    corners = points[facets]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    hull = cv2.contourArea(cv2.convexHull(points.astype(np.float32)))
    assert np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2 == pytest.approx(hull, rel=0.03)


def test_facets_know_how_far_they_may_be_off() -> None:
    y, x = np.mgrid[0:60:12, 0:60:12]
    points = np.stack([x, y], axis=-1).reshape(-1, 2) + np.random.default_rng(3).uniform(-2, 2, (25, 2))
    plane = 2 + 0.1 * points[:, 0] - 0.3 * points[:, 1]
    facets = facets_between(points)
    assert misfit_to_neighbours(points, facets, plane).max() < 1e-9
    cliff = plane + 7 * (points[:, 0] > 30)
    off = misfit_to_neighbours(points, facets, cliff)
    assert np.median(off[np.abs(points[:, 0] - 30) < 10]) > 1.5
    assert np.median(off[points[:, 0] < 15]) < 1e-9


def test_markers_along_a_thread_are_joined_in_its_order() -> None:
    turn = np.linspace(0, 9, 30)
    thread = np.stack([20 * np.cos(turn), 20 * np.sin(turn), 8 * turn], axis=1)
    shuffled = np.random.default_rng(2).permutation(30)
    links = shortest_network(thread[shuffled])
    steps = np.abs(shuffled[links[:, 0]] - shuffled[links[:, 1]])
    assert len(links) == 29
    assert np.all(steps == 1)
