"""The lease: one commands, falls silent, and another takes over; and each request is carried out once."""

import pytest

from acquire.answers import WORKING, Answers, RequestRefused
from acquire.lease import LeaseBook, NotCommanding
from acquire.replies import Done, Picture, Position
from sim.clock import SimClock


@pytest.fixture
def clock():
    return SimClock()


@pytest.fixture
def book(clock):
    return LeaseBook(clock, lasts_s=3.0)


def code_of(call, *arguments):
    with pytest.raises(NotCommanding) as refusal:
        call(*arguments)
    return refusal.value.code


def test_a_second_commander_is_told_who_commands(book):
    book.take("ann")
    with pytest.raises(NotCommanding, match="ann commands") as refusal:
        book.take("bob")
    assert (refusal.value.code, refusal.value.exit_code) == ("lease-held", 8)


def test_a_holder_who_speaks_keeps_it(book, clock):
    token = book.take("ann")
    for _ in range(10):
        clock.sleep(2.9)
        book.keep(token)
    assert book.holder == "ann"
    assert code_of(book.take, "bob") == "lease-held"


def test_a_silent_holder_loses_it_to_whoever_asks(book, clock):
    token = book.take("ann")
    clock.sleep(3.0)
    assert book.holder == ""
    taken = book.take("bob")
    assert book.holder == "bob"
    assert code_of(book.keep, token) == "lease-lost"
    assert code_of(book.release, token) == "lease-lost"
    book.keep(taken)


def test_a_holder_who_wakes_before_anybody_asked_goes_on(book, clock):
    token = book.take("ann")
    clock.sleep(60.0)
    book.keep(token)
    assert book.holder == "ann"


def test_given_back_it_is_free_at_once(book):
    token = book.take("ann")
    book.release(token)
    assert book.holder == ""
    assert code_of(book.keep, token) == "lease-lost"
    book.take("bob")


def test_without_a_lease_one_is_told_to_take_it(book):
    assert code_of(book.keep, "") == "lease-needed"
    book.take("ann")
    assert code_of(book.keep, "") == "lease-needed"
    assert code_of(book.keep, "ä guess") == "lease-lost"


def test_a_request_that_comes_again_gets_the_answer_it_had():
    answers = Answers()
    assert answers.begin("c", 1, b"cut") is None
    assert answers.begin("c", 1, b"cut") is WORKING
    answers.finish("c", 1, Done())
    assert answers.begin("c", 1, b"cut") == Done()
    assert answers.begin("other", 1, b"cut") is None


def test_a_number_used_for_two_requests_is_refused():
    answers = Answers()
    answers.begin("c", 1, b"cut")
    with pytest.raises(RequestRefused, match="another request"):
        answers.begin("c", 1, b"feed")


def test_a_forgotten_number_is_refused_rather_than_done_again():
    answers = Answers(kept=4)
    for number in range(1, 11):
        assert answers.begin("c", number, b"cut") is None
        answers.finish("c", number, Position(z_um=number))
    assert answers.begin("c", 10, b"cut") == Position(z_um=10)
    for number in range(1, 6):
        with pytest.raises(RequestRefused, match="too old"):
            answers.begin("c", number, b"cut")


def test_of_pictures_only_the_last_few_are_kept():
    answers = Answers()
    picture = Picture(shape=(1, 1), dtype="uint8", pixels=b"x", z_um=0.0, exposure_ms=1.0, utc_ns=0)
    for number in range(1, 7):
        answers.begin("c", number, b"snap")
        answers.finish("c", number, picture)
    kept = [answers.begin("c", number, b"snap") for number in range(1, 7)]
    assert [reply == picture for reply in kept] == [False] * 2 + [True] * 4
    assert all(reply is not None for reply in kept)  # forgotten, and not taken again by itself


def test_what_is_under_way_is_not_forgotten():
    answers = Answers(kept=2)
    answers.begin("c", 1, b"long")
    for number in range(2, 20):
        answers.begin("c", number, b"short")
        answers.finish("c", number, Done())
    assert answers.begin("c", 1, b"long") is WORKING


def test_the_client_silent_for_longest_is_forgotten_whole():
    answers = Answers(clients=2)
    for client in ("a", "b", "c"):
        answers.begin(client, 1, b"x")
    answers.finish("a", 1, Done())  # nobody to keep it for: it is dropped
    assert answers.begin("a", 1, b"x") is None
