"""Autofocus: the peak against its formula, decisions within their bounds, and a drifting block held in focus."""

from __future__ import annotations

import math

import numpy as np
import pytest
from faces import Faces
from hypothesis import given
from hypothesis import strategies as st

from acquire.autofocus import Focus, FocusPlan, Peak, coarse_to_fine, correct, focus_of, peak, search
from acquire.measures import look_at

PLAN = FocusPlan(most_nm=2000, dead_nm=200, low_nm=-20_000, high_nm=30_000)
MIDDLE = Focus(target_nm=0)


@given(st.floats(-900, 900), st.floats(300, 3000))
def test_the_peak_of_a_gaussian_is_its_centre(centre, width):
    z = [-1700.0, -1000.0, 0.0, 800.0, 1900.0]
    scores = [math.exp(-((k - centre) ** 2) / (2 * width**2)) + 1e-12 for k in z]
    found = peak(z, scores)
    if found is not None and max(scores) > 1e-3:
        assert found.inside
        assert found.z_nm == pytest.approx(centre, abs=1)


def test_a_peak_at_an_end_is_told_as_one_that_may_lie_beyond():
    assert peak([0, 1, 2], [3.0, 2.0, 1.0]) == Peak(0.0, inside=False)
    assert peak([2, 0, 1], [9.0, 2.0, 3.0]) == Peak(2.0, inside=False)


@pytest.mark.parametrize("scores", [[1.0, 1.1, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
def test_where_nothing_stands_out_there_is_no_peak(scores):
    assert peak([0, 1, 2], scores) is None


@given(
    st.integers(-50_000, 50_000),
    st.integers(-20_000, 30_000),
    st.one_of(st.none(), st.builds(Peak, st.floats(-1e5, 1e5), st.booleans())),
    st.one_of(st.none(), st.integers(-5000, 5000)),
)
def test_never_more_than_one_step_and_never_out_of_bounds(most, offset, found, target):
    plan = FocusPlan(most_nm=abs(most), dead_nm=200, low_nm=-20_000, high_nm=30_000)
    focus = correct(Focus(offset, target), found, plan)
    assert abs(focus.offset_nm - offset) <= plan.most_nm
    assert plan.low_nm <= focus.offset_nm <= plan.high_nm
    assert focus.words


def test_the_first_sharp_place_inside_the_stack_is_held():
    focus = correct(Focus(), Peak(2000.0, inside=False), PLAN)
    assert focus.target_nm is None
    focus = correct(focus, Peak(700.0, inside=True), PLAN)
    assert (focus.offset_nm, focus.target_nm) == (0, 700)
    focus = correct(focus, Peak(1600.0, inside=True), PLAN)
    assert (focus.offset_nm, focus.target_nm) == (900, 700)
    assert correct(focus, Peak(1700.0, inside=True), PLAN).offset_nm == 900  # less than the noise


def test_a_bound_is_said():
    assert "bound" in correct(Focus(29_900, 0), Peak(31_000.0, inside=True), PLAN).words


@given(st.integers(-5000, 5000), st.integers(0, 4000))
def test_a_search_stays_within_its_bounds_and_visits_nothing_twice(centre, high):
    asking = coarse_to_fine(centre, 2000, centre - 1500, centre + high)
    visited = [next(asking)]
    found: list[int] = []
    while not found:
        try:
            visited.append(asking.send(1.0 / (1 + abs(visited[-1] - centre))))
        except StopIteration as done:
            found = done.value[0]
    assert sorted(visited) == sorted(set(visited)) == sorted(found)
    assert all(centre - 1500 <= z <= centre + high for z in visited)
    assert len(visited) <= 9


def test_the_journal_tells_where_the_focus_was():
    held = Focus(900, 700, "off")
    records = [Focus(1, 2).record(3), {"e": "plane"}, held.record(4)]
    assert focus_of(records) == Focus(900, 700)
    assert focus_of([]) == Focus()


def test_a_search_finds_the_focus_of_a_face():
    for seed in (101, 102):
        faces, best_nm = Faces(seed, 0.5), 900

        def measure(z_nm, faces=faces, best_nm=best_nm):
            return look_at(faces.shot(3, z_um=(z_nm - best_nm) / 1000), 4095).energy

        found = search(measure, 0, PLAN)
        assert found is not None
        assert found.z_nm == pytest.approx(best_nm, abs=250)


@pytest.mark.parametrize(("seed", "thickness_um"), [(103, 0.1), (104, 0.5), (105, 1.0)])
def test_a_drifting_block_is_tracked_from_its_own_stack(seed, thickness_um):
    """The focus wanders by 0.4 µm a section, 12 µm in all; planes are 2 µm apart; a depth of field is 2.7 µm."""
    faces, focus, rng = Faces(seed, thickness_um), Focus(), np.random.default_rng(seed)
    errors_um = []
    for section in range(30):
        truth_um = 0.4 * section
        z_nm = [1000 * z + focus.offset_nm for z in (-4, -2, 0, 2, 4)]
        light = 1 + 0.02 * rng.normal()
        shots = [faces.shot(section, z_um=z / 1000 - truth_um, light=light) for z in z_nm]
        errors_um.append(focus.offset_nm / 1000 - truth_um)
        focus = correct(focus, peak(z_nm, [look_at(shot, 4095).energy for shot in shots]), PLAN)
    assert max(abs(error) for error in errors_um) < 1.0
    assert focus.offset_nm == pytest.approx(11_600, abs=800)


def test_an_empty_face_leaves_the_focus_where_it_is():
    faces = Faces(106, 0.5)
    z_um = (-4, -2, 0, 2, 4)
    scores = [look_at(faces.shot(1, z_um=z, lost=True), 4095).energy for z in z_um]
    assert peak(z_um, scores) is None
    assert correct(MIDDLE, None, PLAN).offset_nm == 0
