"""Another thickness for each range of cuts: what is written, what is planned, and what a run of them leaves behind."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from near import Bench
from sections import BENCH, RECIPE
from wires import stereotome

from acquire.depths import depths_nm
from acquire.engine import RunState
from acquire.estimate import Pace, estimate, timed_steps
from acquire.export import export
from acquire.per_cut import PerCut, Range, per_cut
from acquire.plan import StackPlan
from acquire.planning import plan_run
from acquire.recipe import Recipe, recipe_from_text
from acquire.run_plan import Kind, RunPlan, SectionPlan, plan_from
from acquire.store import open_run
from devices.errors import LimitError, PlanError
from devices.rig import RigSpec
from devices.toml_model import load_text
from processing.stack import open_stack

RIG = load_text(BENCH, "bench", RigSpec, PlanError)
RANGES = "1-2: 500, 3-: 300"


@st.composite
def ranges(draw):
    """Ranges of cuts, the last without end or not, and the length of each cut they are for."""
    lengths = draw(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 2000)), min_size=1, max_size=5))
    firsts = [1 + sum(count for count, _ in lengths[:k]) for k in range(len(lengths))]
    parts = [Range(first, first + count - 1, nm) for first, (count, nm) in zip(firsts, lengths, strict=True)]
    if draw(st.booleans()):
        parts[-1] = Range(parts[-1].first, None, parts[-1].nm)
    return PerCut(tuple(parts)), [nm for count, nm in lengths for _ in range(count)]


@given(ranges())
def test_every_cut_has_its_length_and_the_text_says_it_again(drawn):
    cuts, each_nm = drawn
    assert per_cut(cuts.told) == per_cut(json.loads(json.dumps(cuts.told))) == per_cut(cuts) == cuts
    assert [cuts.nm(cut) for cut in range(1, len(each_nm) + 1)] == each_nm
    assert [cuts.total_nm(n) for n in range(len(each_nm) + 1)] == [sum(each_nm[:n]) for n in range(len(each_nm) + 1)]
    assert cuts.extremes_nm == (min(each_nm), max(each_nm))


@given(ranges(), st.integers(1, 20_000))
def test_as_many_cuts_as_go_into_a_depth_and_not_one_more(drawn, depth_nm):
    cuts, each_nm = drawn
    try:
        count = cuts.cuts_within(depth_nm)
    except ValueError:
        assert cuts.cuts is not None
        assert sum(each_nm) < depth_nm
    else:
        assert cuts.total_nm(count) <= depth_nm
        at_its_end = count == cuts.cuts and cuts.total_nm(count) == depth_nm
        assert at_its_end or cuts.total_nm(count) + cuts.nm(count + 1) > depth_nm


def sections(thickness, **more):
    return {"schema": 1, "stack": {"around_um": 0.0, "planes": 1}, "sections": {"thickness_nm": thickness, **more}}


@given(ranges(), st.booleans())
def test_count_and_depth_say_the_same_and_the_plan_goes_through_every_depth(drawn, cut_first):
    cuts, each_nm = drawn
    count, depth_um = len(each_nm) + (not cut_first), sum(each_nm) / 1000
    recipe = Recipe.model_validate(sections(cuts.told, count=count, cut_then_image=cut_first))
    assert Recipe.model_validate(sections(cuts.told, depth_um=depth_um)).sections.sections == len(each_nm)
    plan = SectionPlan(count, recipe.sections.thickness_nm, 0, remove_first=cut_first)
    depths_nm = [plan.depth_nm(section, 100.0) for section in range(count)]
    faces_nm = [100.0 + sum(each_nm[:cuts]) for cuts in range(len(each_nm) + 1)]
    assert depths_nm == faces_nm[cut_first:]
    assert plan.depth_um == pytest.approx(depth_um)
    whole = RunPlan(StackPlan(0, 1, 1, 1.0), sections=plan)
    assert plan_from(json.loads(json.dumps(whole.canonical()))) == whole
    fed = [timed.step.thickness_nm for timed in timed_steps(whole, Pace(1.0, 0.0)) if timed.step.kind is Kind.FEED]
    assert fed == each_nm


def test_a_single_thickness_is_planned_as_it_always_was():
    recipe = Recipe.model_validate(sections(500.4, depth_um=1.6))
    plan = plan_run(recipe, RIG).canonical()["sections"]
    assert (plan["count"], plan["thickness_nm"], plan["tolerance_nm"]) == (3, 500, 50)
    assert [type(plan[key]) for key in ("thickness_nm", "tolerance_nm")] == [int, int]
    assert recipe.model_dump(mode="json")["sections"]["thickness_nm"] == 500.4
    assert Recipe.model_validate(sections("1-: 500.4", depth_um=1.6)) == recipe
    assert per_cut(" 3- :300,1-2:500.0") == per_cut(RANGES)


@pytest.mark.parametrize(
    ("thickness", "words"),
    [
        ('"1-20: 100, 22-: 50"', "cut 21 is in no range"),
        ('"3-: 50"', "cuts 1-2 are in no range"),
        ('"1-20: 100, 20-: 50"', "cut 20 is in two ranges"),
        ('"1-: 100, 30-: 50"', "cut 30 is in two ranges"),
        ('"1-20: 100, 1-20: 100"', "cut 1 is in two ranges"),
        ('"1-20: 0, 21-: 50"', "should be above 0 nm, not 0 from cut 1 on"),
        ('"1-20: 100, 21-: -5"', "should be above 0 nm, not -5 from cut 21 on"),
        ('"1-20: nan, 21-: 50"', "should be above 0 nm, not nan from cut 1 on"),
        ('"1-20: 100, 21-: inf"', "should be above 0 nm, not inf from cut 21 on"),
        ('"0-: 100"', "cuts are counted from 1"),
        ('"1-20: 100, 40-21: 50"', "40-21 ends before it begins"),
        ('"1-20: thick"', "'thick' is no number of nm"),
        ('"1-20: 100,"', "'' is no range of cuts; write for example"),
        ('"one to ten: 100"', "'one to ten: 100' is no range of cuts"),
        ('"thick"', "'thick' is no number of nm"),
        ('"1-20: 100"', "cuts 21-30 are in no range: let the last go on, 1-"),
        ('"1-20: 100, 21-40: 50"', "there is a range for cut 40, but the run makes 30 cuts"),
        ('"1-30: 100, 31-: 50"', "there is a range for cut 31, but the run makes 30 cuts"),
        ("[100, 50]", "should be a number of nm, or ranges such as"),
        ("true", "should be a number of nm, or ranges such as"),
        ("0", "should be above 0 nm, not 0"),
        ("-70", "should be above 0 nm, not -70"),
        ("0.3", "should be above 0 nm, not 0"),
        ("nan", "must be a finite number"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words_with_its_line(thickness, words):
    text = f"[stack]\naround_um = 0.0\nplanes = 1\n[sections]\ncount = 30\nthickness_nm = {thickness}\n"
    with pytest.raises(PlanError) as error:
        recipe_from_text(text, "night.toml")
    assert words in str(error.value)
    assert "has 1 problem:\n    night.toml:" in str(error.value)


def test_a_depth_that_the_ranges_do_not_reach_is_refused():
    with pytest.raises(ValueError, match=r"the ranges end at cut 3, 0\.3 µm deep, before 1 µm are reached"):
        Recipe.model_validate(sections("1-3: 100", depth_um=1.0))
    with pytest.raises(ValueError, match="less than one section of 300 nm"):
        Recipe.model_validate(sections("1-3: 300, 4-: 20", depth_um=0.2))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"thickness": "1-2: 500, 3-: 10", "count": 5}, "a section of 10 nm is not within 20 … 2000 nm"),
        ({"thickness": "1-2: 2500, 3-: 100", "count": 5}, "a section of 2500 nm is not within"),
        ({"thickness": "1-2: 500, 3-: 2000", "count": 2003}, r"are 4003\.0 µm deep; the feed travels 4000 µm"),
    ],
)
def test_every_range_has_to_be_within_what_the_feed_can_do(table, words):
    with pytest.raises(LimitError, match=words):
        plan_run(Recipe.model_validate(sections(table.pop("thickness"), **table)), RIG)


def test_each_range_has_its_own_tolerance_and_its_own_time():
    plan = plan_run(Recipe.model_validate(sections("1-2: 500, 3-: 200", count=4)), RIG).sections
    assert [plan.tolerance_nm.nm(cut) for cut in (1, 2, 3, 4)] == [50, 50, 20, 20]
    pace = Pace(1000.0, 0.0, overhead_s=0.0, feed_um_s=1.0, cut_s=0.0)
    cost = [
        estimate(RunPlan(StackPlan(0, 1, 1, 1.0), sections=SectionPlan(4, per_cut(told), 0)), 1, pace).seconds
        for told in ("1-2: 500, 3-: 200", 500)
    ]
    assert cost[1] - cost[0] == pytest.approx(2 * 0.3)


def run_of(folder, ranges=RANGES, count=4, more=""):
    stack = RECIPE.replace("top_um = 2.0\nbottom_um = -2.0\nstep = 4.0", "top_um = 0.0\nbottom_um = 0.0\nplanes = 1")
    text = stack.replace("count = 3", f"count = {count}").replace("thickness_nm = 500", f'thickness_nm = "{ranges}"')
    return Bench(folder / "b", recipe=text + more)


def test_a_run_of_ranges_cuts_each_as_thick_as_planned_and_the_data_say_where_each_lies(tmp_path, capsys):
    bench = run_of(tmp_path)
    assert bench.run(attended=False).state is RunState.COMPLETED
    run = open_run(bench.run_folder)
    assert run.manifest["recipe"]["sections"]["thickness_nm"] == RANGES
    fed = [record["target_nm"] for record in run.records if record["e"] == "feed_intent"]
    assert fed == pytest.approx([500, 1000, 1300, 1600])
    assert bench.world.feed.machine.removed_um == pytest.approx([0.0, 0.5, 0.3, 0.3], abs=0.002)
    depth_nm, notes = depths_nm(run, range(4))
    assert depth_nm == pytest.approx(fed, abs=1)
    assert "unevenly, as planned: 1-2: 500, 3-: 300 nm" in notes[0]
    report = (run.folder / "report.md").read_text()
    assert all(row in report for row in ("| 0 | 0.500 | 500 |", "| 1 | 1.000 | 500 |", "| 2 | 1.300 | 300 |"))
    for name, kind in (("out.ome.tif", "ome-tiff"), ("out.zarr", "ome-zarr")):
        assert export(bench.run_folder, output=tmp_path / name, format_=kind, sections="z", quiet=True) == 0
        assert open_stack(tmp_path / name).z_um == pytest.approx([0.0, 0.5, 0.8, 1.1], abs=0.001)
    attributes = json.loads((tmp_path / "out.zarr" / "zarr.json").read_text())["attributes"]
    scale = attributes["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"][0]["scale"]
    assert scale[2] == pytest.approx(1.1 / 3)
    assert "one spacing stands for all, their mean" in attributes["stereotome"]["remark"]
    assert "one spacing stands for all" in capsys.readouterr().err


def test_what_was_fed_is_held_against_the_thickness_of_that_cut(tmp_path):
    """The feed goes by 10 nm: 500 nm it can, 204 nm it cannot."""
    bench = run_of(tmp_path, "1-2: 500, 3-: 204", more="thickness_tolerance_nm = 3\n")
    bench.bench = BENCH.replace("[microtome.knife]", "counts_per_um = 100\n[microtome.knife]")
    bench.__post_init__()
    outcome = bench.run(attended=False)
    assert outcome.held.code == "thickness"
    assert "The feed went 200 nm for section 2, 204 nm are planned, 3 nm off is allowed" in outcome.held.words
    assert bench.knife.cuts_executed == 2


def test_the_dry_run_tells_the_thickness_of_each_cut(tmp_path):
    (tmp_path / "bench.toml").write_text(BENCH)
    (tmp_path / "recipe.toml").write_text(RECIPE)
    thickness = f"sections.thickness_nm={RANGES}"
    told = stereotome("run", tmp_path / "recipe.toml", "-i", tmp_path / "bench.toml", "--dry-run", "--set", thickness)
    assert told.code == 0, told.err
    assert [line.split()[-2] for line in told.out.splitlines() if "feed" in line] == ["500", "500", "300"]
    assert "3 sections of 1-2: 500, 3-: 300 nm (3 removals), 1.3 µm in all" in told.err
