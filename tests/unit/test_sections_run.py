"""Runs of sections on the simulated bench, over its wires: what is cut, what is kept first, and what is asked."""

import numpy as np
import zarr
from sections import cuts, files, run_sections
from wires import stereotome

from acquire.engine import RunState
from acquire.store import RunEnd, open_run


def journal(folder):
    return open_run(folder).records


def test_every_face_is_durable_before_it_is_cut_away(start_bench, tmp_path):
    instrument, recipe = files(tmp_path)
    bench, told = start_bench(instrument), []
    _, outcome = run_sections(bench, recipe, tmp_path / "run", tell=told.append)
    assert outcome.state is RunState.COMPLETED
    run = open_run(tmp_path / "run")
    assert (run.state, run.missing, run.committed) == (RunEnd.COMPLETED, [], 3)
    assert cuts(bench) == 3
    array = zarr.open_array(run.folder / "focal.ome.zarr/0", mode="r")
    assert array.shape == (3, 1, 2, 40, 48)
    for slot in range(6):
        np.testing.assert_array_equal(array[slot // 2, 0, slot % 2], run.read(slot))
    events = [record["e"] for record in run.records]
    each = ["feed_intent", "feed_done", "cut_intent", "cut_done", "clear", "verdict", "commit"]
    assert events == ["run_created", "origin", *each * 3, "end"]
    done = [record["readback_nm"] for record in run.records if record["e"] == "feed_done"]
    np.testing.assert_allclose(done, [500, 1000, 1500], atol=1)
    phases = [event["plane"] for event in told if event["event"] == "plane"]
    assert phases == [0, 1] * 3


def test_the_dry_run_lists_every_step_and_what_it_costs(tmp_path):
    instrument, recipe = files(tmp_path)
    result = stereotome("run", recipe, "-i", instrument, "--dry-run", "--out", tmp_path / "run")
    assert result.code == 0, result.err
    steps = ["park", "feed 500 nm", "cut", "clear", "plane    0", "plane    1", "inspect", "commit"]
    lines = result.out.splitlines()
    assert len(lines) == 3 * len(steps)
    assert all(step in line for step, line in zip(steps * 3, lines, strict=True))
    assert "3 sections of 500 nm (3 removals)" in result.err


def test_a_camera_that_goes_away_and_comes_back_costs_a_run_nothing(start_bench, tmp_path):
    instrument, recipe = files(tmp_path)
    bench, warned = start_bench(instrument), []

    def tell(event):
        if event["event"] == "plane" and (event["section"], event["plane"]) == (1, 0):
            bench.ask(do="fault", set="camera.die")
        if event["event"] == "warn":
            warned.append(event["code"])
            bench.ask(do="fault", clear="camera.die")

    _, outcome = run_sections(bench, recipe, tmp_path / "run", tell=tell)
    assert outcome.state is RunState.COMPLETED, outcome.error
    assert warned == ["camera-gone"]
    assert open_run(tmp_path / "run").missing == []
    assert cuts(bench) == 3
