"""Every kind of plan: what a recipe or a useq file becomes, that it lists itself, and that it is taken as planned."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from near import Bench
from pydantic import ValidationError
from sections import BENCH
from wires import stereotome

from acquire.engine import RunState
from acquire.estimate import Pace, estimate, timed_steps
from acquire.per_cut import per_cut
from acquire.plan import StackPlan
from acquire.planning import plan_run
from acquire.recipe import Recipe
from acquire.run_plan import BandPlan, Kind, RunPlan, SectionPlan, SeriesPlan, plan_from
from acquire.store import open_run
from acquire.useq_file import read_useq
from devices.errors import LimitError, PlanError
from devices.rig import RigSpec
from devices.toml_model import load_text

BANDS = '[[band]]\nname = "green"\n[[band]]\nname = "red"\nexposure_ms = 3.0\ncolour = "#ff0000"\n'
RIG = load_text(BENCH + BANDS, "bench", RigSpec, PlanError)
HEAD = 'schema = 1\nname = "t"\n[output]\nkeep_free_gb = 0.001\n'


def recipe_of(**tables):
    return Recipe.model_validate({"schema": 1, **tables})


def plan_of(here_um=0.0, **tables):
    return plan_run(recipe_of(**tables), RIG, here_um)


@given(st.integers(-9_000, 0), st.integers(100, 9_000), st.integers(2, 90), st.sampled_from(["up", "down"]))
def test_planes_fill_a_range_and_none_lies_beyond_it(bottom_nm, range_nm, planes, direction):
    ends_um = {"bottom_um": bottom_nm / 1000, "top_um": (bottom_nm + range_nm) / 1000}
    plan = plan_of(stack={**ends_um, "planes": planes, "direction": direction}).stack
    places_nm = sorted(plan.z_nm(k) for k in range(planes))
    assert bottom_nm <= places_nm[0] <= bottom_nm + planes
    assert bottom_nm + range_nm - planes <= places_nm[-1] <= bottom_nm + range_nm


def test_around_here_and_offsets_go_where_the_stage_is():
    around = plan_of(12.0, stack={"around_um": 4.0, "step": 2.0})
    assert [plane.z_um for plane in around.stack] == [10.0, 12.0, 14.0]
    offsets = plan_of(12.0, stack={"offsets_um": [0.5, -1.0]})
    assert [plane.z_um for plane in offsets.stack] == [12.5, 11.0]


def test_a_list_of_positions_is_kept_plane_by_plane():
    plan = plan_of(stack={"positions_um": [0.0, 1.0, 5.0, 5.25]})
    assert [plane.z_um for plane in plan.stack] == [0.0, 1.0, 5.0, 5.25]
    with pytest.raises(LimitError):
        plan_of(stack={"positions_um": [0.0, 1000.0]})


@pytest.mark.parametrize(
    "stack",
    [
        {},
        {"top_um": 1.0, "step": 1.0},
        {"around_um": 2.0, "positions_um": [1.0]},
        {"positions_um": [1.0], "step": 1.0},
        {"positions_um": []},
        {"around_um": 2.0},
        {"top_um": -1.0, "bottom_um": 1.0, "step": 1.0},
    ],
)
def test_a_stack_is_given_in_one_way_and_whole(stack):
    with pytest.raises(ValidationError):
        recipe_of(stack=stack)


def test_sections_series_and_tilt_exclude_each_other():
    with pytest.raises(ValidationError, match="only one of"):
        recipe_of(stack={"around_um": 0.0, "planes": 1}, series={"count": 2}, tilt={"angles_deg": [-3, 3]})


def test_bands_have_the_exposure_of_the_plan_or_the_band_or_the_recipe():
    uses = ["green", "red", {"name": "green"}]
    plan = plan_of(stack={"around_um": 0.0, "planes": 1, "bands": uses[:2]})
    assert plan.bands == (BandPlan("green", 1.0), BandPlan("red", 3.0))
    plan = plan_of(stack={"around_um": 0.0, "planes": 1, "bands": [{"name": "red", "exposure_ms": 7.0}]})
    assert plan.bands == (BandPlan("red", 7.0),)


whole = st.integers(1, 4)


@given(whole, whole, whole, st.booleans(), st.sampled_from(["sections", "series", "tilts"]), st.booleans())
def test_every_slot_is_exposed_once_in_order_of_time(times, bands, planes, by_plane, what, remove_first):
    kinds = {
        "sections": {"sections": SectionPlan(times, per_cut(100), 0, remove_first=remove_first)},
        "series": {"series": SeriesPlan(times, 10.0)},
        "tilts": {"tilts_deg": tuple(float(k) for k in range(times))},
    }
    stack = StackPlan(0, 1000, planes, 5.0)
    named = tuple(BandPlan(f"b{k}", 5.0) for k in range(bands))
    plan = RunPlan(stack, bands=named, plane_by_plane=by_plane, **kinds[what])
    steps = [timed.step for timed in timed_steps(plan, Pace(1000.0, 0.0))]
    exposed = [plan.slot(step.section, step.band, step.plane) for step in steps if step.kind is Kind.EXPOSE]
    assert sorted(exposed) == list(range(len(plan)))
    assert [step.section for step in steps] == sorted(step.section for step in steps)
    assert plan_from(json.loads(json.dumps(plan.canonical()))).plan_id == plan.plan_id
    cuts = [step for step in steps if step.kind is Kind.CUT]
    assert len(cuts) == (plan.sections.removals if plan.sections else 0)
    for earlier, later in pairwise(steps):
        if later.kind in (Kind.PARK, Kind.FEED, Kind.CUT) and later.section > 0 and earlier.section != later.section:
            assert earlier.kind is Kind.COMMIT


def test_the_estimate_counts_settling_cutting_and_light_on_one_face():
    plan = RunPlan(StackPlan(0, 1000, 2, 10.0), sections=SectionPlan(3, per_cut(500), -5000))
    cost = estimate(plan, 100, Pace(1000.0, 0.1, overhead_s=0.0, feed_um_s=1.0, cut_s=4.0))
    assert (cost.planes, cost.bytes_on_disk) == (6, 600)
    assert (cost.exposure_s, cost.dose_s) == pytest.approx((0.06, 0.02))
    # each section: 0.5 s feed, 4 s cut, 0.1 s clear, 0.02 s light; ways of 5 + 1 + 6 µm; first park costs no way
    assert cost.seconds == pytest.approx(3 * (0.5 + 4 + 0.1 + 0.02 + 0.3 + 0.006) + 2 * 0.006 + 0.1 + 0.006)


def run(tmp_path, text, **options):
    bench = Bench(tmp_path / "b", BENCH + BANDS, HEAD + text)
    bench.answers = options.pop("answers", [])
    return bench, bench.run(**options), open_run(bench.run_folder)


def test_two_bands_of_a_stack_lie_side_by_side(tmp_path):
    _, outcome, stored = run(tmp_path, '[stack]\npositions_um = [0.0, 1.0, 4.0]\nbands = ["green", "red"]\n')
    assert outcome.state is RunState.COMPLETED, outcome.error
    headers = [stored.planes[slot].header for slot in range(6)]
    assert [(h.band, h.plane, h.exposure_ms) for h in headers] == [(b, p, (1, 3)[b]) for b in (0, 1) for p in range(3)]
    assert [h.setpoint_um for h in headers] == [0.0, 1.0, 4.0] * 2
    import zarr

    array = zarr.open_array(stored.folder / "focal.ome.zarr/0", mode="r")
    assert array.shape[:3] == (1, 2, 3)
    np.testing.assert_array_equal(array[0, 1, 2], stored.read(5))
    image = zarr.open_group(stored.folder / "focal.ome.zarr", mode="r")
    assert [channel["label"] for channel in image.attrs["ome"]["omero"]["channels"]] == ["green", "red"]


def test_plane_by_plane_moves_once_for_all_bands(tmp_path):
    bench, outcome, stored = run(
        tmp_path, '[stack]\npositions_um = [0.0, 1.0]\nbands = ["green", "red"]\norder = "plane"\n'
    )
    assert outcome.state is RunState.COMPLETED, outcome.error
    order = [(event["plane"], event["band"]) for event in bench.events("plane")]
    assert order == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert stored.missing == []


def test_a_series_begins_each_stack_when_it_is_due(tmp_path):
    _, outcome, stored = run(tmp_path, "[stack]\npositions_um = [0.0, 1.0]\n[series]\ncount = 4\ninterval_s = 60.0\n")
    assert outcome.state is RunState.COMPLETED, outcome.error
    starts_s = [stored.planes[2 * k].header.exposure_start_ns / 1e9 for k in range(4)]
    np.testing.assert_allclose(np.diff(starts_s), 60.0, atol=0.5)


def test_a_series_at_camera_rate_goes_to_its_place_once(tmp_path):
    bench, outcome, stored = run(tmp_path, "[stack]\npositions_um = [2.0]\n[series]\ncount = 50\n")
    assert outcome.state is RunState.COMPLETED, outcome.error
    starts = [stored.planes[k].header.exposure_start_ns for k in range(50)]
    assert np.diff(starts).max() <= 3e6  # an exposure of 1 ms and one look; no move between two frames
    assert len(bench.events("plane")) == 50


def test_a_stereo_pair_is_tilted_by_hand_and_keeps_its_angles(tmp_path):
    bench, outcome, stored = run(
        tmp_path, "[stack]\npositions_um = [0.0, 1.0]\n[tilt]\nangles_deg = [-3.0, 3.0]\n", answers=["done", "done"]
    )
    assert outcome.state is RunState.COMPLETED, outcome.error
    assert [question.code for question in bench.asked] == ["tilt", "tilt"]
    assert "-3°" in bench.asked[0].words
    assert [r["angle_deg"] for r in stored.records if r["e"] == "tilt"] == [-3.0, 3.0]
    assert stored.layout.sections == 2


USEQ = {
    "axis_order": "tpgcz",
    "channels": [{"config": "green", "exposure": 5}, {"config": "red", "exposure": 8}],
    "z_plan": {"range": 4, "step": 2},
    "time_plan": {"interval": 2, "loops": 3},
}


def test_a_useq_sequence_becomes_a_recipe(tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(USEQ))
    plan = plan_run(read_useq(path), RIG, 10.0)
    assert [plane.z_um for plane in plan.stack] == [8.0, 10.0, 12.0]
    assert plan.bands == (BandPlan("green", 5.0), BandPlan("red", 8.0))
    assert plan.series == SeriesPlan(3, 2000.0)
    assert not plan.plane_by_plane
    path.write_text(json.dumps({**USEQ, "axis_order": "tpgzc", "z_plan": {"absolute": [1, 2, 7]}}))
    plan = plan_run(read_useq(path), RIG, 10.0)
    assert plan.plane_by_plane
    assert [plane.z_um for plane in plan.stack] == [1.0, 2.0, 7.0]


def test_what_a_useq_sequence_asks_in_vain_is_said_all_at_once(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(
        "stage_positions: [{x: 1, y: 2}]\nz_plan: {range: 4, step: 1}\nchannels: [{config: green, acquire_every: 2}]\n"
        "time_plan: [{interval: 1, loops: 3}, {interval: 5, loops: 3}]\n"
    )
    with pytest.raises(PlanError) as refused:
        read_useq(path)
    for part in ("stage_positions", "acquire_every of channel green", "intervals of different length"):
        assert part in refused.value.what
    assert refused.value.code == "useq-cannot"


@pytest.mark.parametrize("text", ["", "[1, 2", "a: [", "z_plan: {range: four}"])
def test_a_file_that_is_no_sequence_is_one_clear_line(tmp_path, text):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    if not text:  # an empty sequence is one picture where the stage is
        return
    with pytest.raises(PlanError, match="no MDASequence"):
        read_useq(path)


def test_a_useq_file_is_listed_by_the_command(tmp_path):
    (tmp_path / "rig.toml").write_text(BENCH + BANDS)
    (tmp_path / "plan.yaml").write_text("channels: [green]\nz_plan: {range: 4, step: 2}\n")
    result = stereotome("run", tmp_path / "plan.yaml", "-i", tmp_path / "rig.toml", "--dry-run", "--json")
    assert result.code == 0, result.err
    events = [json.loads(line) for line in result.out.splitlines()]
    assert [event["z_um"] for event in events if event["do"] == "expose"] == [-2.0, 0.0, 2.0]
