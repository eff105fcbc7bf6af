"""Numbers in registers: whatever goes in comes out, and nothing else raises anything but ValueError."""

from contextlib import nullcontext

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.wire.modbus_map import decode, encode, evaluate, width

KINDS = {"u16": (0, 2**16 - 1), "i16": (-(2**15), 2**15 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31), 2**31 - 1)}
numbers = st.sampled_from(sorted(KINDS)).flatmap(lambda kind: st.tuples(st.just(kind), st.integers(*KINDS[kind])))
orders = st.sampled_from(["big", "little"])


@given(numbers, orders)
def test_there_and_back(number, order):
    kind, value = number
    words = encode(value, kind, order)
    assert len(words) == width(kind)
    assert decode(words, kind, order) == value


@given(st.lists(st.integers()), st.sampled_from([*KINDS, "f32", "block"]), orders)
def test_any_words_are_a_number_or_a_value_error(words, kind, order):
    right = kind != "block" and len(words) == width(kind) and all(0 <= word < 2**16 for word in words)
    with nullcontext() if right else pytest.raises(ValueError, match="words"):
        assert isinstance(decode(words, kind, order), int | float)


@given(st.integers(), st.sampled_from(sorted(KINDS)), orders)
def test_what_does_not_fit_is_refused(value, kind, order):
    low, high = KINDS[kind]
    if low <= value <= high:
        assert decode(encode(value, kind, order), kind, order) == value
    else:
        with pytest.raises(ValueError, match="does not fit"):
            encode(value, kind, order)


@given(st.integers(*KINDS["i32"]))
def test_halves_make_the_whole(value):
    supplied = {"pos": value}
    words = (evaluate("hi(pos)", supplied), evaluate("lo(pos)", supplied))
    assert words == encode(value, "i32", "big")


def test_a_float():
    assert decode(encode(1.5, "f32", "little"), "f32", "little") == 1.5
