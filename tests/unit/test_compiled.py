"""Machine code that is kept is used again only while everything it was made of is what it was."""

import subprocess
import sys

import pytest

OUTER = """
from inner import GAIN, Pair, inner
from processing.compiled import compiled

@compiled
def outer(value, pair: Pair):
    return GAIN * inner(value) + pair.first

def used():
    return outer(1.0, Pair(10.0, 20.0)), outer.stats.cache_hits[outer.signatures[0]]
"""
INNER = """
from typing import NamedTuple
from processing.compiled import compiled

GAIN = 2

class Pair(NamedTuple):
    first: float
    second: float

@compiled
def inner(value):
    return value + 100
"""


@pytest.fixture
def used(tmp_path):
    """Return a function that writes the inner module, and returns what a new process makes of both."""
    (tmp_path / "outer.py").write_text(OUTER)

    def run(inner):
        (tmp_path / "inner.py").write_text(inner)
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import outer; print(*outer.used())"
        said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
        value, hits = said.stdout.split()
        return float(value), int(hits)

    return run


def test_what_is_kept_follows_kernels_numbers_and_tuples_of_other_files(used, tmp_path):
    assert used(INNER) == (212.0, 0)
    assert used(INNER) == (212.0, 1), "nothing changed: used again"
    assert used(INNER.replace("100", "200")) == (412.0, 0)
    assert used(INNER.replace("GAIN = 2", "GAIN = 3")) == (313.0, 0)
    assert used(INNER.replace("first", "third").replace("second", "first")) == (222.0, 0)
    [index] = (tmp_path / "__pycache__").glob("outer.outer*.nbi")
    index.write_bytes(index.read_bytes()[:-20])
    assert used(INNER) == (212.0, 0), "a list that was cut short is written anew"
