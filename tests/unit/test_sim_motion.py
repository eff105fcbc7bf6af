"""Motion against the closed form of a trapezoid, and against itself where moves meet."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.values import Limits
from sim.clock import SimClock
from sim.motion import PATH_SAMPLES, REMEMBERED_MOVES, Axis, Ringing, Trapezoid, play

WIDE = Limits(-1e6, 1e6)
SPEED, RAMP_S = 1000.0, 0.1
RATE = SPEED / RAMP_S


def make_axis(**settings) -> tuple[SimClock, Axis]:
    clock = SimClock()
    return clock, Axis(clock, settings.pop("limits", WIDE), **{"speed_um_s": SPEED, "ramp_s": RAMP_S, **settings})


@pytest.mark.parametrize("sign", [1, -1])
def test_long_move_accelerates_cruises_and_brakes(sign):
    clock, axis = make_axis()
    axis.move_to(sign * 300.0)  # ramps take 50 µm and 0.1 s each, 200 µm in 0.2 s between them
    expected = {0.05: 12.5, 0.1: 50.0, 0.2: 150.0, 0.3: 250.0, 0.35: 287.5, 0.4: 300.0, 1.0: 300.0}
    assert [axis.load_um(t) for t in expected] == pytest.approx([sign * z for z in expected.values()])
    clock.sleep(0.3999)
    assert axis.moving()
    clock.sleep(0.0002)
    assert not axis.moving()


def test_short_move_never_reaches_its_speed():
    path = Trapezoid(0.0, 0.0, 4.0, SPEED, RATE)
    assert path.duration_s == pytest.approx(2 * math.sqrt(4.0 / RATE))
    assert path.state(path.duration_s / 2) == pytest.approx((2.0, math.sqrt(4.0 * RATE)))


def test_no_move_takes_no_time():
    path = Trapezoid(3.0, 0.0, 3.0, SPEED, RATE)
    assert path.duration_s == 0.0
    assert path.state(0.0) == (3.0, 0.0)


reach = st.floats(-500, 500)


@given(start=reach, velocity=st.floats(-2 * SPEED, 2 * SPEED), target=reach)
def test_any_start_ends_at_rest_at_the_target_without_a_jump(start, velocity, target):
    path = Trapezoid(start, velocity, target, SPEED, RATE)
    assert path.state(0.0) == pytest.approx((start, velocity)) or path.duration_s == 0
    assert path.state(path.duration_s) == (target, 0.0)
    times = np.linspace(0, path.duration_s, 400)
    states = np.array([path.state(t) for t in times])
    steps, seconds = np.diff(states, axis=0), times[1] - times[0]
    fastest = max(SPEED, abs(velocity))
    assert np.all(np.abs(steps[:, 0]) <= fastest * seconds + 1e-6)
    assert np.all(np.abs(steps[:, 1]) <= RATE * seconds + 1e-3)


def test_new_target_during_a_move_goes_on_from_there():
    clock, axis = make_axis()
    axis.move_to(300.0)
    clock.sleep(0.15)  # at 100 µm and full speed
    axis.move_to(0.0)
    assert axis.encoder_um() == pytest.approx(100.0)
    clock.sleep(0.1)
    assert axis.encoder_um() == pytest.approx(150.0)  # braked over 50 µm before it turned
    clock.sleep(10)
    assert axis.encoder_um() == 0.0


@pytest.mark.parametrize("sign", [1, -1])
def test_halt_brakes_within_the_ramp(sign):
    clock, axis = make_axis()
    axis.move_to(sign * 300.0)
    clock.sleep(0.15)
    axis.halt()
    clock.sleep(0.05)
    assert axis.encoder_um() == pytest.approx(sign * 137.5)
    clock.sleep(0.05001)
    assert axis.encoder_um() == pytest.approx(sign * 150.0)
    assert not axis.moving()


def test_targets_are_cut_to_the_soft_limits():
    clock, axis = make_axis(limits=Limits(-10.0, 10.0))
    axis.move_to(50.0)
    clock.sleep(1)
    assert axis.encoder_um() == 10.0


def test_speed_is_clipped_without_a_word():
    _, axis = make_axis()
    axis.set_speed(1e9)
    assert axis.speed_um_s == SPEED


def test_an_obstacle_holds_the_axis_which_the_controller_goes_on_driving():
    clock, axis = make_axis()
    axis.obstruct(12.5)
    axis.move_to(40.0)
    clock.sleep(100)
    assert (axis.encoder_um(), axis.load_um(clock.now()), axis.moving()) == (12.5, 12.5, True)
    axis.move_to(0.0)  # the way back is free
    clock.sleep(1)
    assert (axis.encoder_um(), axis.moving()) == (0.0, False)


def test_lost_motion_leaves_the_load_behind_on_the_way_down_only():
    clock, axis = make_axis(backlash_um=2.0)
    for target, seen in [(10.0, 10.0), (9.0, 10.0), (5.0, 7.0), (6.0, 7.0), (8.0, 8.0)]:
        axis.move_to(target)
        clock.sleep(1)
        assert (axis.encoder_um(), axis.load_um(clock.now())) == (target, pytest.approx(seen))


def test_lost_motion_is_taken_up_where_the_motor_turned():
    clock, axis = make_axis(backlash_um=2.0)
    axis.move_to(300.0)
    clock.sleep(0.15)
    axis.move_to(149.0)  # runs on to 150, which carries the load there, and comes back by less than the lost motion
    clock.sleep(5)
    assert axis.load_um(clock.now()) == pytest.approx(150.0)


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=20), st.floats(0, 3))
def test_play_keeps_the_load_within_the_lost_motion(motor, backlash):
    load = motor[0]
    for position in motor:
        load = play(load, position, backlash)
        assert position <= load <= position + backlash


def test_ringing_follows_its_formula_and_ends():
    clock, axis = make_axis(ringing=Ringing(decay_s=0.004, frequency_hz=100))
    axis.move_to(10.0)
    end_s = axis.commanded.path.duration_s
    for since_s in (0.0, 0.001, 0.0025, 0.01):
        omega = 2 * math.pi * 100
        expected = -RATE / omega**2 * math.exp(-since_s / 0.004) * math.sin(omega * since_s)
        assert axis.load_um(end_s + since_s) - 10.0 == pytest.approx(expected, abs=1e-9)
    assert axis.rests_at_s == pytest.approx(end_s + 0.02)
    assert axis.load_um(axis.rests_at_s) == 10.0
    clock.sleep(end_s + 0.001)
    assert axis.encoder_um() == 10.0  # the motor does not ring


def test_path_is_one_point_at_rest_and_the_true_way_otherwise():
    clock, axis = make_axis()
    clock.sleep(1)
    assert axis.path_um(0.2, 0.5).tolist() == [0.0]
    axis.move_to(300.0)
    path = axis.path_um(0.9, 1.05)  # begins before the move
    assert len(path) == PATH_SAMPLES
    assert path[0] == 0.0
    times = 0.9 + (np.arange(PATH_SAMPLES) + 0.5) * 0.15 / PATH_SAMPLES
    assert path == pytest.approx(np.where(times > 1, RATE / 2 * (times - 1) ** 2, 0.0))
    clock.sleep(10)
    axis.move_to(0.0)
    assert axis.path_um(0.9, 1.05) == pytest.approx(path)  # the past stays as it was


def test_the_position_depends_on_commands_not_on_looks():
    commands = [(random.Random(3).uniform(0, 0.2), random.Random(i).uniform(-100, 100)) for i in range(20)]
    watched, unwatched = make_axis(backlash_um=1), make_axis(backlash_um=1)
    for wait_s, target_um in commands:
        for clock, axis in (watched, unwatched):
            clock.sleep(wait_s)
            if axis is watched[1]:
                axis.load_um(clock.now())
                axis.encoder_um()
            axis.move_to(target_um)
    assert watched[1].load_um(3.0) == unwatched[1].load_um(3.0)


def test_memory_of_moves_is_bounded():
    _, axis = make_axis()
    for target in range(2 * REMEMBERED_MOVES):
        axis.move_to(float(target))
    assert len(axis._moves) == REMEMBERED_MOVES
