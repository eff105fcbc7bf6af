"""Plans: what they list is what was asked for, and every position is where integer arithmetic puts it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.estimate import Pace, estimate
from acquire.optics import depth_of_field_um, nyquist_step_um
from acquire.plan import StackPlan, steps_in_range
from devices.errors import LimitError, PlanError
from devices.values import Limits

plans = st.builds(
    StackPlan,
    start_nm=st.integers(-(10**7), 10**7),
    step_nm=st.integers(-(10**5), 10**5).filter(bool),
    count=st.integers(1, 200),
    exposure_ms=st.just(10.0),
    approach=st.sampled_from([1, -1]),
    overshoot_nm=st.integers(0, 5000),
    return_nm=st.none() | st.integers(-(10**7), 10**7),
)


@given(plans)
def test_every_plane_stands_at_start_plus_k_steps(plan):
    planes = list(plan)
    assert len(planes) == len(plan) == plan.count
    assert [p.index for p in planes] == list(range(plan.count))
    assert [p.z_nm for p in planes] == [plan.start_nm + k * plan.step_nm for k in range(plan.count)]


@given(plans.filter(lambda plan: plan.overshoot_nm > 0))
def test_every_plane_is_reached_in_the_approach_direction(plan):
    position = None
    for plane, moves_nm in plan.route():
        for target in moves_nm:
            before, position = position, target
        assert position == plane.z_nm
        assert before is not None
        assert (position - before) * plan.approach > 0


@given(plans.filter(lambda plan: plan.overshoot_nm > 0), st.data())
def test_so_is_a_plane_after_a_gap_and_the_first_one(plan, data):
    first, last = sorted(data.draw(st.tuples(*[st.integers(0, plan.count - 1)] * 2)))
    planes = list(plan)
    *way, end = plan.moves_nm(planes[last], planes[first] if first < last else None)
    start = way[-1] if way else planes[first].z_nm
    assert end == planes[last].z_nm
    assert (end - start) * plan.approach > 0


@given(plans)
def test_equal_plans_have_equal_ids(plan):
    same = StackPlan(**plan.canonical())
    other = StackPlan(**{**plan.canonical(), "start_nm": plan.start_nm + 1})
    assert plan.plan_id == same.plan_id != other.plan_id


@given(plans)
def test_the_limits_hold_for_overshoot_and_return_too(plan):
    targets = plan.targets_nm()
    plan.check(Limits(min(targets) / 1000, max(targets) / 1000))
    if min(targets) < max(targets):
        with pytest.raises(LimitError, match="Nothing moved"):
            plan.check(Limits((min(targets) + 1) / 1000, max(targets) / 1000))


@pytest.mark.parametrize(
    ("first", "last", "step", "expected"),
    [(0, 10, 2.5, (2500, 5)), (0, 10, 3, (3000, 4)), (5, -5, 0.1, (-100, 101)), (3, 3, 1, (1000, 1))],
)
def test_planes_in_a_range(first, last, step, expected):
    assert steps_in_range(first, last, step) == expected


@pytest.mark.parametrize(
    "nonsense", [{"count": 0}, {"step_nm": 0}, {"exposure_ms": 0.0}, {"exposure_ms": float("nan")}]
)
def test_nonsense_is_refused_when_made(nonsense):
    sense = {"start_nm": 0, "step_nm": 100, "count": 3, "exposure_ms": 5.0}
    with pytest.raises(PlanError):
        StackPlan(**{**sense, **nonsense})


def test_the_estimate_adds_up():
    plan = StackPlan(start_nm=0, step_nm=1000, count=11, exposure_ms=20.0, return_nm=0)
    cost = estimate(plan, frame_bytes=100, pace=Pace(speed_um_s=10.0, settle_s=0.1, overhead_s=0.0, readout_s=0.01))
    assert cost.bytes_on_disk == 1100
    assert cost.seconds == pytest.approx(20 / 10 + 12 * 0.1 + 11 * 0.02 + 11 * 0.01)


def test_steps_from_the_optics():
    # NA 1.4 oil at 520 nm: the textbook axial Nyquist step is near 0.14 µm
    assert nyquist_step_um(1.4, 0.52, 1.515) == pytest.approx(
        0.52 / (2 * 1.515 * (1 - (1 - (1.4 / 1.515) ** 2) ** 0.5))
    )
    assert nyquist_step_um(1.4, 0.52, 1.515) == pytest.approx(0.278, abs=0.002)
    # a dry 10x/0.25 at 550 nm: 8.8 µm wave optics, 2.6 µm for a pixel of 6.5 µm
    assert depth_of_field_um(0.25, 0.55, 1.0, 10, 6.5) == pytest.approx(8.8 + 2.6)
    with pytest.raises(PlanError, match="impossible"):
        nyquist_step_um(1.2, 0.5, 1.0)
