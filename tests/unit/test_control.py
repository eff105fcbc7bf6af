"""Questions of a run: whoever hears one may answer it at once."""

import pytest

from acquire.control import Control, Held
from acquire.state import Board, Question, RunState
from devices.errors import InputError


class NoWaiting:
    """A clock whose time passes at once."""

    def now(self):
        return 0.0

    def sleep(self, _seconds):
        pass


NO_WAITING = NoWaiting()
QUESTION = Question("knife-failed", "The knife is stuck.", {"again": "look again", "not-done": "cut now"})


def test_an_answer_given_while_the_question_is_being_told_counts():
    def tell(event):
        if event["event"] == "hold":
            assert event["asks"]
            with pytest.raises(InputError, match="no answer"):
                control.answer("perhaps")
            control.answer("not-done")

    control = Control(Board(), NO_WAITING, tell=tell)
    assert control.ask(QUESTION) == "not-done"
    assert control.question is None


def test_a_question_answered_beforehand_asks_nobody():
    told = []
    control = Control(Board(), NO_WAITING, tell=told.append, answers=["again"])
    assert control.ask(QUESTION) == "again"
    assert [event["asks"] for event in told if event["event"] == "hold"] == [False]


def test_an_answer_to_the_question_before_is_none_to_the_next():
    answers = iter(["again", None])

    def tell(event):
        if event["event"] == "hold" and (choice := next(answers)):
            control.answer(choice)
        elif event == {"event": "state", "state": RunState.HOLD} and len(told) > 3:
            control.answer("not-done")
        told.append(event)

    told = []
    control = Control(Board(), NO_WAITING, tell=tell)
    assert control.ask(QUESTION) == "again"
    assert control.ask(QUESTION) == "not-done"


def test_nobody_there_to_answer_ends_the_run():
    told = []
    control = Control(Board(), NO_WAITING, tell=told.append, attended=False)
    with pytest.raises(Held):
        control.ask(QUESTION)
    assert control.question is None
    assert not told[0]["asks"]
