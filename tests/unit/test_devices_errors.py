"""Errors: their words, and the page that lists them all."""

import re
from pathlib import Path

import pytest

import devices.errors
from devices.errors import LimitError, StereotomeError, did_you_mean

ROOT = Path(__file__).parent.parent.parent
ROW = re.compile(r"^\| `([a-z-]+)` \| (\d+) \|", re.MULTILINE)


def documented() -> dict[str, int]:
    return {code: int(leaves) for code, leaves in ROW.findall((ROOT / "docs" / "errors.md").read_text())}


def test_every_code_in_the_program_is_documented():
    packages = ("acquire", "devices", "display", "processing", "sim")
    sources = [file.read_text() for package in packages for file in (ROOT / package).rglob("*.py")]
    used = {code for text in sources for code in re.findall(r'\bcode(?:: str)? ?= ?"([a-z-]+)"', text)}
    assert len(used) > 15
    assert used - set(documented()) == set()


@pytest.mark.parametrize("kind", [kind for kind in vars(devices.errors).values() if isinstance(kind, type)])
def test_every_class_leaves_as_documented(kind: type[StereotomeError]):
    assert documented()[kind.code] == kind.exit_code


def test_a_message_says_what_why_and_each_fix():
    error = LimitError("too far.", why="because", fix=("first", "second"), code="other")
    assert error.message() == "error[other]: too far.\n  why: because\n  fix: first\n   or: second"
    assert LimitError("too far.").message() == "error[limit]: too far."


def test_a_guess():
    assert did_you_mean("prot", ["port", "baud"]) == "; did you mean 'port'?"
    assert did_you_mean("xyz", ["port", "baud"]) == "; known here: baud, port"
    assert did_you_mean("xyz", []) == ""
