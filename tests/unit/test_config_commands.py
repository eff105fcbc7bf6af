"""``stereotome config show`` and ``schema``, on the example files."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from wires import stereotome

EXAMPLES = Path(__file__).parents[2] / "examples"


def shown(*words):
    result = stereotome("config", *words)
    assert (result.code, result.err) == (0, "")
    return result.out


@pytest.mark.parametrize("name", ["recipe.toml", "instrument.toml", "block-face-instrument.toml"])
def test_what_is_shown_is_the_file_and_names_its_lines(name):
    lines = (EXAMPLES / name).read_text().splitlines()
    out = shown("show", EXAMPLES / name)
    assert tomllib.loads(out) == tomllib.loads((EXAMPLES / name).read_text())
    for key, line in re.findall(r"^(\S+) = .*# line (\d+)$", out, re.MULTILINE):
        assert key.rpartition(".")[2] in lines[int(line) - 1]


def test_what_is_left_out_and_what_is_set_by_hand_are_told_apart():
    out = shown("show", EXAMPLES / "recipe.toml", "--all", "--set", "stack.step = 0.5")
    assert "stack.step = 0.5  # --set\n" in out
    assert "stack.tolerance_um = 0.2  # default\n" in out
    assert "# stack.around_um is not set\n" in out
    assert tomllib.loads(out)["output"]["compression"] == "lz4"


def test_a_schema_knows_every_table():
    assert {"stack", "sections", "output"} <= json.loads(shown("schema", "recipe"))["properties"].keys()
    assert {"camera", "stage"} <= json.loads(shown("schema", "instrument"))["properties"].keys()


def test_a_file_that_is_wrong_is_told_as_check_tells_it(tmp_path):
    (tmp_path / "r.toml").write_text("[stack]\nstep = nan\n")
    result = stereotome("config", "show", tmp_path / "r.toml")
    assert (result.code, result.out) == (3, "")
    assert "r.toml:2: stack.step: must be a finite number" in result.err
