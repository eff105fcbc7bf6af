"""When an axis counts as arrived, as a rule on readings alone."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.drivers.arrival import Arrival

TOLERANCE_UM = 0.1


def verdicts(*readings: tuple[float, float, bool], target_um: float | None = 10.0) -> list[bool]:
    arrival = Arrival(target_um, tolerance_um=TOLERANCE_UM, now=0.0)
    return [arrival.reached(z_um, now, moving=moving) for now, z_um, moving in readings]


def test_two_readings_at_the_target_10_ms_apart():
    assert verdicts((0.0, 10.0, False), (0.010, 10.1, False)) == [False, True]


def test_two_readings_too_close_together_are_one():
    assert verdicts((0.0, 10.0, False), (0.009, 10.0, False), (0.011, 10.0, False)) == [False, False, True]


@pytest.mark.parametrize("between", [(0.006, 10.3, False), (0.006, 10.0, True)])
def test_what_comes_between_starts_it_again(between: tuple[float, float, bool]):
    assert verdicts((0.0, 10.0, False), between, (0.012, 10.0, False), (0.023, 10.0, False)) == [False] * 3 + [True]


def test_without_a_target_the_readings_have_to_agree():
    readings = (0.0, 3.0, False), (0.02, 3.3, False), (0.031, 3.3, False)
    assert verdicts(*readings, target_um=None) == [False, False, True]


@given(st.lists(st.tuples(st.floats(0, 0.02), st.floats(9.5, 10.5), st.booleans()), max_size=12))
def test_it_never_arrives_but_by_the_rule(steps: list[tuple[float, float, bool]]):
    now, readings = 0.0, []
    for step_s, z_um, moving in steps:
        now += step_s
        readings.append((now, z_um, moving))
    for index, arrived in enumerate(verdicts(*readings)):
        good = [r for r in readings[: index + 1] if not r[2] and abs(r[1] - 10) <= TOLERANCE_UM * 1.01]
        assert not arrived or (readings[index] in good and len(good) >= 2 and good[-1][0] - good[0][0] >= 0.010)


@pytest.mark.parametrize(("creep_um", "stalled"), [(0.05, True), (0.2, False)])
def test_no_progress_for_a_second_is_a_stall(creep_um: float, stalled: bool):
    arrival = Arrival(10.0, tolerance_um=TOLERANCE_UM, now=0.0)
    for tick in range(3):
        arrival.reached(tick * creep_um, tick * 0.5, moving=True)
    assert arrival.stalled(1.0) == stalled


def test_it_is_asked_again_when_that_can_tell_something():
    arrival = Arrival(10.0, tolerance_um=TOLERANCE_UM, now=0.0)
    assert arrival.wait_s(0.0, 0.004) == 0.004
    arrival.reached(10.0, 0.0, moving=False)
    assert arrival.wait_s(0.003, 0.004) == pytest.approx(0.007)


@given(st.floats(0, 1e6))
def test_whoever_waits_as_told_arrives(started_s: float):
    arrival, now = Arrival(10.0, tolerance_um=TOLERANCE_UM, now=started_s), started_s
    arrived = arrival.reached(10.0, now, moving=False)
    for _ in range(3):
        now += arrival.wait_s(now, 0.004)
        arrived = arrival.reached(10.0, now, moving=False)
    assert arrived
