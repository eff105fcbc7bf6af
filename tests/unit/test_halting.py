"""Halts from other threads: none is lost to a command given at the same moment, none stops the way back."""

from __future__ import annotations

import threading
from contextlib import suppress

from acquire.halting import Halting
from devices.errors import LinkLost

PATIENCE_S = 60


class Axis:
    """A device whose driver forgets an earlier halt when it is told to move, as they all do."""

    def __init__(self) -> None:
        self.halted = threading.Event()
        self.halts = 0
        self.fails = False

    def move(self) -> None:
        self.halted.clear()

    def halt(self) -> None:
        self.halts += 1
        if self.fails:
            raise LinkLost("gone")
        self.halted.set()


def test_a_stop_reaches_a_move_that_began_right_after_it():
    stage, feed = Axis(), Axis()
    halting = Halting(stage, feed)
    halting.stop()
    assert (stage.halts, feed.halts) >= (1, 1)
    feed.move()  # the run had looked a moment before the stop
    assert feed.halted.wait(PATIENCE_S)
    halting.leave()


def test_a_stop_asked_for_again_and_again_is_repeated_by_one_thread():
    halting = Halting(Axis(), Axis())
    for _ in range(20):
        halting.stop()
    repeating = [thread for thread in threading.enumerate() if thread.name == "halting"]
    halting.leave()
    for thread in repeating:
        thread.join(PATIENCE_S)
    assert len(repeating) == 1


def test_once_the_run_has_left_nothing_stops_the_way_back():
    stage = Axis()
    halting = Halting(stage, None)
    halting.leave()
    halting.stage_if(lambda: True)
    assert stage.halts == 0


def test_only_a_moving_stage_is_halted_by_a_cancel():
    stage = Axis()
    halting = Halting(stage, None)
    halting.stage_if(lambda: False)
    assert stage.halts == 0
    halting.stage_if(lambda: True)
    assert stage.halts == 1


def test_the_feed_does_not_wait_for_a_stage_that_does_not_answer():
    stage, feed = Axis(), Axis()
    stage.halt = lambda: answered.append(feed.halted.wait(PATIENCE_S))
    answered = []
    Halting(stage, feed).everything()
    assert answered == [True]


def test_the_feed_is_halted_even_if_the_stage_is_gone():
    stage, feed = Axis(), Axis()
    stage.fails = True
    halting = Halting(stage, feed)
    with suppress(LinkLost):
        halting.stop()
    assert feed.halted.is_set()
    feed.move()
    assert feed.halted.wait(PATIENCE_S)
    halting.leave()
