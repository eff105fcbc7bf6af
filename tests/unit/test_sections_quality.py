"""Quality and autofocus at work in runs of sections, over the bench's wires, on a block that misbehaves on request."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from sections import BENCH, RECIPE, cuts, files, run_sections

from acquire.engine import RunState
from acquire.store import open_run

if TYPE_CHECKING:
    from sim.pytest_plugin import StartBench

BLOCK = BENCH.replace("[48, 40]", "[160, 128]") + '\n[sim]\nspecimen = "block"\nseed = 11\n'
STACK = "top_um = 4.0\nbottom_um = -4.0\nstep = 2.0"
TRACKED = RECIPE.replace("top_um = 2.0\nbottom_um = -2.0\nstep = 4.0", STACK)
SINGLE = RECIPE.replace("top_um = 2.0\nbottom_um = -2.0\nstep = 4.0", "top_um = 0.0\nbottom_um = 0.0\nplanes = 1")


def test_debris_is_swept_away_and_a_frozen_camera_is_asked_again(sim_bench: StartBench, tmp_path):
    bench_file, recipe = files(tmp_path, BLOCK, SINGLE.replace("count = 3", "count = 6"))
    bench = sim_bench(bench_file, faults=["block.debris@4", "camera.partial@3"])
    _, outcome = run_sections(bench, recipe, tmp_path / "run", inspect=None, attended=False)
    assert outcome.state is RunState.COMPLETED
    stored = open_run(tmp_path / "run")
    verdicts = [(r["section"], r["finding"]) for r in stored.records if r["e"] == "verdict" and r["finding"] != "good"]
    assert verdicts == [(2, "incomplete"), (3, "debris")]
    assert cuts(bench) == 7  # six sections and one sweep
    assert stored.missing == []


def test_a_section_that_was_not_taken_off_stops_an_unattended_run(sim_bench: StartBench, tmp_path):
    bench_file, recipe = files(tmp_path, BLOCK, SINGLE.replace("count = 3", "count = 5"))
    bench = sim_bench(bench_file, faults=["block.miss@3"])
    _, outcome = run_sections(bench, recipe, tmp_path / "run", inspect=None, attended=False)
    assert outcome.state is RunState.HELD
    assert outcome.held is not None
    assert "section 1" in outcome.held.words
    assert cuts(bench) == 3


def test_the_focus_follows_the_block_from_its_own_stack(sim_bench: StartBench, tmp_path):
    bench_file, recipe = files(tmp_path, BLOCK, TRACKED.replace("count = 3", "count = 6\nautofocus_every = 1"))
    bench = sim_bench(bench_file, faults=["block.focus@900nm"])
    _, outcome = run_sections(bench, recipe, tmp_path / "run", inspect=None, attended=False)
    assert outcome.state is RunState.COMPLETED
    told = bench.ask(do="truth")["counters"]["feed"]["face"]["focus_um"]
    moved = [record["offset_nm"] / 1000 for record in open_run(tmp_path / "run").records if record["e"] == "focus"]
    assert told == pytest.approx(5.4)
    assert moved[-1] == pytest.approx(told - 2 * 0.9, abs=0.8)  # it is held where section 0 had it, one section behind
    assert max(abs(b - a) for a, b in pairwise(moved)) <= 2.0


def test_single_planes_are_searched_for(sim_bench: StartBench, tmp_path):
    bench_file, recipe = files(tmp_path, BLOCK, SINGLE.replace("count = 3", "count = 3\nautofocus_every = 1"))
    bench = sim_bench(bench_file, faults=["block.focus@1200nm"])
    _, outcome = run_sections(bench, recipe, tmp_path / "run", inspect=None, attended=False)
    assert outcome.state is RunState.COMPLETED
    stored = open_run(tmp_path / "run")
    taken = [stored.planes[slot].header.z_um for slot in sorted(stored.planes)]
    assert taken == pytest.approx([1.2, 2.4, 3.6], abs=0.4)
