"""Which eye's turn it is, on a simulated display with a busy computer, against what the display really showed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DeviceError, DisplayError, LinkLost
from devices.glasses_timing import EyewearTiming
from display.pacing import Beat, Pacer, check_rate, measured_beat
from display.presenter import Presenter
from sim.clock import SimClock
from sim.display import SimDisplay, longest_wrong

HZ = 120.0
T = 1 / HZ


def presenter(seconds: float, **options):
    clock = SimClock(50.0)
    screen = SimDisplay(clock, **options)
    shown = Presenter(screen, clock)
    end_s = clock.now() + seconds
    while clock.now() < end_s:
        shown.step()
    return screen, shown


def even_eye(screen: SimDisplay) -> str:
    """The eye the program gave to the display's even refreshes: it cannot know the display's own numbers."""
    eyes = [eye for number, eye in screen.seen() if number % 2 == 0]
    return max(set(eyes), key=eyes.count)


def test_without_a_late_picture_every_refresh_is_its_eyes():
    screen, shown = presenter(3.0)
    assert longest_wrong(screen.seen(), even=even_eye(screen)) == (0, 0)
    assert shown.pacer.report.wrong_eye == shown.pacer.report.late == shown.pacer.report.redrawn == 0
    assert shown.pacer.report.flips == len(screen.flips()) - 1
    assert shown.pacer.report.refreshes == len(screen.seen()) - 1


@pytest.mark.parametrize("seed", range(4))
def test_late_pictures_cost_one_refresh_at_a_time(seed):
    screen, shown = presenter(60.0, late_share=0.004, seed=seed, off_ppm=80)
    wrong, longest = longest_wrong(screen.seen(), even=even_eye(screen))
    assert len(screen.seen()) == pytest.approx(7200, abs=5)
    assert screen.hold_ups > 10
    assert longest == 1
    assert wrong <= 2 * screen.hold_ups
    report = shown.pacer.report
    assert report.longest_wrong in (1, 2), "at worst: a late return at a refresh is taken for a late picture"
    assert wrong - 1 <= report.wrong_eye <= wrong + 2 * report.strays
    assert report.refreshes == pytest.approx(len(screen.seen()), abs=4)


def test_the_flips_told_are_those_that_were():
    screen, shown = presenter(5.0, late_share=0.02, seed=7, off_ppm=-60)
    told, true = list(shown.flips), screen.flips()
    assert [flip.eye for flip in told] == [flip.eye for flip in true]
    off_ms = np.abs([(a.at_ns - b.at_ns) / 1e6 for a, b in zip(told, true, strict=True)])
    assert np.median(off_ms) < 0.3
    assert np.mean(off_ms > 0.5) < 0.01, "those whose return came late by whole refreshes"


def test_exchanged_eyes_change_places_at_once():
    screen, shown = presenter(1.0)
    even = even_eye(screen)
    before = len(screen.seen())
    shown.swap = True
    for _ in range(100):
        shown.step()
    assert longest_wrong(screen.seen()[before + 2 :], even="right" if even == "left" else "left") == (0, 0)


def test_a_display_that_changes_its_beat_is_measured_anew():
    screen, shown = presenter(1.0)
    screen._begin_s += 0.4 * screen.period_s
    screen.period_s *= 1.05
    for _ in range(400):
        shown.step()
    assert shown.pacer.beat.period_s == pytest.approx(screen.period_s, rel=1e-3)
    tail = screen.seen()[-100:]
    assert longest_wrong(tail)[0] in (0, 100)


@given(number=st.integers(-1000, 10**7), part=st.floats(0.01, 0.99), period_s=st.floats(1 / 360, 1 / 96))
def test_a_beat_counts_refreshes(number, part, period_s):
    beat = Beat(7.5, period_s, 12)
    at_s = beat.time_of(number)
    assert beat.begun(at_s + part * period_s) == number
    assert beat.nearest(at_s + (part - 0.5) * 0.9 * period_s) == number


def test_a_beat_follows_a_display_that_drifts():
    beat, true_s = Beat(0.0, T), 0.0
    for _ in range(4000):
        true_s += T * (1 + 200e-6)
        beat = beat.followed(true_s)
    assert beat.period_s == pytest.approx(T * (1 + 200e-6), rel=2e-6)
    assert beat.time_of(beat.nearest(true_s)) == pytest.approx(true_s, abs=20e-6)


def test_a_beat_stays_while_the_computer_is_so_busy_that_swaps_return_at_random():
    pacer, chance, now_s = Pacer(Beat(0.0, T)), np.random.default_rng(2), 0.0
    for _ in range(5000):
        turn = pacer.upcoming(now_s)
        now_s = pacer.beat.time_of(turn.number) + float(chance.uniform(0, 4 * T))
        pacer.flipped(turn, now_s)
    assert pacer.beat.period_s == pytest.approx(T, rel=0.01)
    assert pacer.lost, "and it is known that nothing is known"


def test_a_turn_shortly_before_a_refresh_waits_for_it():
    pacer = Pacer(Beat(0.0, T))
    assert (pacer.upcoming(0.1 * T).number, pacer.upcoming(0.1 * T).eye) == (1, "right")
    early = pacer.upcoming(T - 0.2e-3)
    assert (early.number, early.not_before_s) == (2, pytest.approx(T))
    assert Pacer(Beat(0.0, T), swap=True).upcoming(0.1 * T).eye == "left"


def test_a_swap_that_returned_nowhere_near_a_refresh_says_nothing_of_the_display():
    pacer = Pacer(Beat(0.0, T))
    pacer.flipped(pacer.upcoming(0.1 * T), T)
    flip = pacer.flipped(pacer.upcoming(1.1 * T), 3.5 * T)
    assert flip.at_ns == round(2 * T * 1e9)
    assert (pacer.report.strays, pacer.report.late, pacer.beat.at_s) == (1, 0, T)


def test_a_picture_seen_one_refresh_later_is_late_and_wrong_twice():
    pacer = Pacer(Beat(0.0, T))
    pacer.flipped(pacer.upcoming(0.1 * T), T)
    pacer.flipped(pacer.upcoming(1.1 * T), 3 * T)
    report = pacer.report
    assert (report.refreshes, report.flips, report.late, report.wrong_eye, report.longest_wrong) == (2, 1, 1, 2, 2)


@pytest.mark.parametrize("skipped", [0.0, 0.3, 0.6])
def test_a_beat_is_measured_also_when_swaps_are_late(skipped):
    chance = np.random.default_rng(4)
    numbers = np.cumsum(1 + (chance.random(60) < skipped) * chance.integers(1, 4, 60))
    returns_s = 9.0 + numbers / 119.88 + chance.random(60) * 0.3e-3
    beat = measured_beat(returns_s, 120.0)
    assert 1 / beat.period_s == pytest.approx(119.88, rel=2e-4)
    off_s = [at_s - beat.time_of(beat.nearest(at_s)) for at_s in returns_s]
    assert np.abs(off_s).max() < 0.4e-3


def test_slow_displays_and_swaps_that_do_not_wait_are_refused():
    clock = SimClock(1.0)
    with pytest.raises(DisplayError, match="60 pictures a second; shutter glasses need 96 times") as refused:
        Presenter(SimDisplay(clock, 60.0), clock)
    assert refused.value.code == "refresh-too-slow"
    free = SimDisplay(clock)
    free.waits = False
    with pytest.raises(DisplayError, match="the display says 120 Hz, but pictures changed 1250 times") as refused:
        Presenter(free, clock)
    assert refused.value.code == "no-vsync"
    with pytest.raises(DisplayError, match="93\\."):
        measured_beat([k / 93.4 for k in range(60)], 100.0)
    with pytest.raises(DisplayError, match="does not say how often"):
        check_rate(0.0)
    check_rate(96.0)
    for hz in (95.9, math.nan):
        with pytest.raises(DisplayError):
            check_rate(hz)


class Told:
    """Glasses that write down what they are told, until their port is gone."""

    def __init__(self, *, free_running: bool, gone_after: int = 1 << 30) -> None:
        self.free_running = free_running
        self.eyes: list[str] = []
        self.locks: list[tuple[float, float]] = []
        self._left = gone_after
        self.timing = EyewearTiming()

    def show(self, eye):
        self._use()
        self.eyes.append(eye)

    def lock_to(self, refresh_hz, left_flip_s):
        self._use()
        self.locks.append((refresh_hz, left_flip_s))

    def _use(self):
        self._left -= 1
        if self._left < 0:
            raise LinkLost("glasses: the port is gone.")


def shown_with(glasses: Told, steps: int = 50):
    clock = SimClock(5.0)
    screen = SimDisplay(clock, late_share=0.05, seed=3)
    shown = Presenter(screen, clock, glasses)
    for _ in range(steps):
        shown.step()
        shown.lock_glasses()
    return screen, shown


def test_glasses_that_are_told_each_flip_get_whose_picture_is_seen():
    glasses = Told(free_running=False)
    screen, _ = shown_with(glasses)
    assert glasses.eyes == [flip.eye for flip in screen.flips()]
    assert glasses.locks == []


def test_glasses_that_run_free_get_the_rate_and_a_flip_of_the_left_eye():
    glasses = Told(free_running=True)
    screen, shown = shown_with(glasses)
    assert glasses.eyes == []
    left = [n for n, eye in screen.seen() if eye == "left"]
    for hz, at_s in glasses.locks[10:]:
        assert hz == pytest.approx(HZ, rel=1e-3)
        turns = (at_s - screen.time_of(left[0])) / (2 * screen.period_s)
        assert turns == pytest.approx(round(turns), abs=0.03)
    assert shown.failure is None


@pytest.mark.parametrize("free_running", [True, False])
def test_the_pictures_go_on_when_the_glasses_are_gone(free_running):
    screen, shown = shown_with(Told(free_running=free_running, gone_after=5))
    assert isinstance(shown.failure, DeviceError)
    assert len(screen.flips()) == 50
