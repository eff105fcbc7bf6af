"""Numbers as people read them."""

import math

import pytest

from acquire.words import spanned


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (-18.59, 19.71, "-18.59 … 19.71"),
        (76319.8712, 76358.1234, "76319.87 … 76358.12"),
        (-0.3526, -0.2234, "-0.3526 … -0.2234"),
        (0.0, 123456.0, "0 … 123456"),
        (5.0, 5.0, "5 … 5"),
        (math.nan, 1.0, "nan … 1"),
    ],
)
def test_both_ends_show_what_lies_between_them(low, high, words):
    assert spanned(low, high) == words
