"""Going on over the same view: z is where it was, or nothing more is taken."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from near import Bench

from acquire.same_view import compare_z
from acquire.state import RunState
from acquire.store import open_run
from devices.errors import Unsafe

STACK = """
schema = 1
name = "t"
[output]
keep_free_gb = 0.001
[stack]
top_um = 10.0
bottom_um = -10.0
step = 2.0
"""
BLOCKS = 10_000


def anywhere(_):
    return True


def peaked(at_nm, width_nm):
    return lambda z_nm: float(np.exp(-(((z_nm - at_nm) / width_nm) ** 2)))


@given(st.integers(-50_000, 50_000), st.integers(100, 5000), st.integers(-8, 8))
def test_a_plane_is_found_where_it_is(z_nm, step_nm, steps):
    score = peaked(z_nm + steps * step_nm, 6 * step_nm)
    apart_nm, best_nm = compare_z(score, z_nm, step_nm, BLOCKS, anywhere)
    assert apart_nm is not None
    assert abs(best_nm - z_nm - steps * step_nm) < apart_nm
    assert (best_nm == z_nm) == (steps == 0)


def test_what_looks_the_same_everywhere_tells_nothing():
    assert compare_z(lambda _: 0.9, 0, 1000, BLOCKS, anywhere) == (None, 0)


def test_less_alike_on_one_side_alone_tells_nothing():
    assert compare_z(peaked(0, 2000), 0, 1000, BLOCKS, lambda z_nm: z_nm <= 0) == (None, 0)


def test_the_search_stays_where_the_stage_may_go():
    assert compare_z(peaked(9000, 12_000), 0, 1000, BLOCKS, lambda z_nm: abs(z_nm) <= 3000) == (1000, 3000)


def layered(bench):
    """A specimen whose layers come into focus one after the other: pictures change slowly along z."""
    layers = np.random.default_rng(5).integers(0, 300, (41, 16, 24)).astype(float)
    depths_um = np.linspace(-20, 20, len(layers))

    def expose(exposure_ms):
        start_s = bench.world.clock.now()
        weights = np.exp(-(((bench.world.axis.load_um(start_s) - depths_um) / 3.0) ** 2))
        bench.world.clock.sleep(exposure_ms / 1000)
        pixels = np.tensordot(weights, layers, 1).astype("<u2")
        return pixels.tobytes(), round(start_s * 1e9), round(bench.world.clock.now() * 1e9)

    bench.world._expose = expose


def cancelled(tmp_path):
    """A bench on which a stack was ended after five planes."""
    bench = Bench(tmp_path / "bench", recipe=STACK)
    layered(bench)
    bench.on["plane"] = lambda event: bench.session.cancel() if event["plane"] == 4 else None
    assert bench.run().state is RunState.CANCELLED
    bench.on.clear()
    return bench


def test_a_stack_goes_on_where_z_reads_as_it_did(tmp_path):
    bench = cancelled(tmp_path)
    assert bench.go_on().state is RunState.COMPLETED
    record = next(record for record in open_run(bench.run_folder).records if record["e"] == "compared")
    assert record["plane"] == 4
    assert record["likeness"] > 0.99
    assert record["apart_um"] <= 8.0
    assert "plane 4 is where it was" in (bench.run_folder / "report.md").read_text()


@pytest.mark.parametrize("by_um", [2.0, -2.0])
def test_a_stack_does_not_go_on_with_another_zero(tmp_path, by_um):
    bench = cancelled(tmp_path)
    journal = (bench.run_folder / "journal.jsonl").read_bytes()
    stage = bench.rig().stage
    stage.move_to(by_um)
    stage.settle(10.0)
    stage.zero_here()
    with pytest.raises(Unsafe) as caught:
        bench.go_on()
    assert caught.value.code == "z-shifted"
    plane_um = open_run(bench.run_folder).planes[4].header.setpoint_um
    assert f"was taken at {plane_um:+.2f} µm and is found at about {plane_um - by_um:+.2f} µm" in caught.value.what
    assert (bench.run_folder / "journal.jsonl").read_bytes() == journal


def test_a_view_that_is_the_same_everywhere_is_told(tmp_path):
    bench = Bench(tmp_path / "bench", recipe=STACK)
    picture = np.random.default_rng(5).integers(0, 300, (16, 24)).astype("<u2").tobytes()
    bench.world._expose = lambda _: (picture, round(bench.clock.now() * 1e9), round(bench.clock.now() * 1e9) + 1)
    bench.on["plane"] = lambda event: bench.session.cancel() if event["plane"] == 4 else None
    bench.run()
    bench.on.clear()
    assert bench.go_on().state is RunState.COMPLETED
    assert [event["code"] for event in bench.events("warn")] == ["z-not-compared"]
    assert "nothing tells whether z reads as it did" in (bench.run_folder / "report.md").read_text()


def test_a_stage_that_was_parked_for_the_knife_and_reads_another_place_is_asked_about(tmp_path):
    bench = Bench(tmp_path / "bench")
    bench.knife.jam = True
    assert bench.run(attended=False).held.code == "knife-failed"
    bench.knife.jam = False
    begun = bench.knife.strokes_begun
    bench.rig().stage.zero_here()
    bench.answers = ["not-done", "end"]
    assert bench.go_on().state is RunState.CANCELLED
    assert [question.code for question in bench.asked] == ["knife-failed", "stage-moved"]
    assert bench.knife.strokes_begun == begun
