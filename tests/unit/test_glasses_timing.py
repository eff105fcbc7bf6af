"""Statistics of phases against cases worked out by hand."""

import math

import pytest

from devices.errors import InputError
from devices.glasses_timing import Edge, EyewearTiming, Lock, other, phase_report, turns_of

PERIOD_MS = 8.0


def train(count, *, at_ms=lambda n: n * PERIOD_MS, first="left", start_ms=5_000.0):
    eyes = (first, other(first))
    return [Edge(round((start_ms + at_ms(n)) * 1e6), eyes[n % 2]) for n in range(count)]


FLIPS = train(200)


def test_edges_at_the_flips_are_perfect():
    report = phase_report(FLIPS, FLIPS)
    assert (report.edges, report.missed, report.duplicated, report.alternation_faults) == (200, 0, 0, 0)
    assert report.period_s == pytest.approx(0.008)
    assert (report.bias_ms, report.max_ms, report.crosstalk) == pytest.approx((0, 0, 0), abs=1e-6)
    assert report.drift_ppm == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("late_ms", [-1.5, 0.25, 2.0])
def test_a_constant_lateness_is_bias_and_crosstalk(late_ms):
    report = phase_report(train(200, at_ms=lambda n: n * PERIOD_MS + late_ms), FLIPS)
    assert report.bias_ms == pytest.approx(late_ms, abs=1e-6)
    assert report.rms_ms == pytest.approx(abs(late_ms), abs=1e-6)
    assert report.jitter_p99_ms == pytest.approx(0, abs=1e-5)
    assert report.crosstalk == pytest.approx(abs(late_ms) / PERIOD_MS, rel=0.02)
    wanted = phase_report(train(200, at_ms=lambda n: n * PERIOD_MS + late_ms), FLIPS, delay_s=late_ms / 1e3)
    assert wanted.bias_ms == pytest.approx(0, abs=1e-6)


def test_a_short_window_inside_the_frame_has_no_crosstalk():
    late = train(200, at_ms=lambda n: n * PERIOD_MS + 2)
    assert phase_report(late, FLIPS, open_s=0.005).crosstalk == pytest.approx(0, abs=1e-6)
    assert phase_report(late, FLIPS, open_s=0.008).crosstalk == pytest.approx(2 / 8, rel=0.02)


def test_a_delay_that_is_meant_counts_for_crosstalk_all_the_same():
    late = train(200, at_ms=lambda n: n * PERIOD_MS + 2)
    assert phase_report(late, FLIPS, delay_s=0.002, open_s=0.005).crosstalk == pytest.approx(0, abs=1e-6)
    assert phase_report(late, FLIPS, delay_s=0.002, open_s=0.008).crosstalk == pytest.approx(2 / 8, rel=0.02)


def test_turns_are_those_given_and_those_counted_from_each_lock():
    timing = EyewearTiming((Edge(500_000_000, "right"),), 1, (Lock(100.0, 1.0), Lock(100.0, 1.041)))
    turns = turns_of(timing, 1.06, delay_s=0.001)
    assert [edge.at_ns // 1_000_000 for edge in turns] == [501, 1001, 1011, 1021, 1031, 1042, 1052]
    assert [edge.eye for edge in turns] == ["right", "left", "right", "left", "right", "left", "right"]
    assert turns_of(EyewearTiming(), 1.0) == []


def test_drift_is_told_from_jitter_and_gives_the_beat():
    report = phase_report(train(200, at_ms=lambda n: n * PERIOD_MS * (1 + 500e-6)), FLIPS)
    assert report.drift_ppm == pytest.approx(500, rel=1e-3)
    assert report.beat_s == pytest.approx(0.016 / 500e-6, rel=1e-3)
    assert report.jitter_p99_ms == pytest.approx(0, abs=1e-5)
    assert report.max_ms == pytest.approx(199 * 8 * 500e-6, rel=1e-3)


def test_missed_doubled_and_wrong_edges_are_counted():
    edges = train(200)
    del edges[50:53]
    edges.insert(20, Edge(edges[20].at_ns + 100_000, edges[20].eye))
    edges[100] = Edge(edges[100].at_ns, other(edges[100].eye))
    edges.sort(key=lambda edge: edge.at_ns)
    report = phase_report(edges, FLIPS)
    assert (report.missed, report.duplicated, report.alternation_faults) == (3, 1, 1)


def test_swapped_eyes_see_everything_wrong():
    report = phase_report(train(200, first="right"), FLIPS)
    assert report.alternation_faults == 200
    assert report.crosstalk == pytest.approx(1)


def test_percentiles_are_of_the_size():
    jitter_ms = [(-1) ** n * (2.0 if n % 50 == 7 else 0.5) for n in range(200)]
    report = phase_report(train(200, at_ms=lambda n: n * PERIOD_MS + jitter_ms[n]), FLIPS)
    assert report.p95_ms == pytest.approx(0.5)
    assert report.p99_ms == pytest.approx(2.0)
    assert report.max_ms == pytest.approx(2.0)


def test_a_late_turn_is_counted_once():
    late = train(200, at_ms=lambda n: n * PERIOD_MS + (3.99 if n % 40 == 9 else 0.0))
    report = phase_report(late, FLIPS)
    assert abs(report.drift_ppm) < 100, "a turn too many or too few would be 5000"
    assert (report.missed, report.duplicated) == (0, 0)
    assert report.max_ms == pytest.approx(3.99)


@pytest.mark.parametrize(("edges", "flips"), [([], FLIPS), (FLIPS, FLIPS[:7]), (train(20, start_ms=9e6), FLIPS)])
def test_too_few_to_say_anything(edges, flips):
    with pytest.raises(InputError, match="too few"):
        phase_report(edges, flips)


def test_a_lock_knows_how_far_a_flip_is_from_its_turns():
    lock = Lock(120.0, 10.0)
    assert lock.phase_s(10 + 2 / 120 * 77 + 0.001) == pytest.approx(0.001, abs=1e-9)
    assert abs(lock.phase_s(10 + 1 / 120)) == pytest.approx(1 / 120), "a right flip is half a cycle away"
    assert math.copysign(1, lock.phase_s(10 - 0.001)) == -1
