"""Runs of sections in which something fails: what is done without asking, what is asked, and what the answer does."""

import inspect

import numpy as np
import pytest
from near import Bench
from sections import BENCH, RECIPE

from acquire.engine import RunState
from acquire.interlock import guarded
from acquire.state import Scope
from acquire.store import RunEnd, open_run
from acquire.verdict import GOOD, Finding, Verdict
from devices.errors import InputError, LinkLost, Unsafe
from devices.protocols import HandControls, Microtome, SequencedStage


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path / "b")


def kinds(bench):
    return [record["e"] for record in open_run(bench.run_folder).records]


def complete(bench, cuts=3):
    run = open_run(bench.run_folder)
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    assert bench.knife.cuts_executed == cuts
    np.testing.assert_allclose(bench.world.feed.machine.removed_um[1:], 0.5, atol=0.002)


def test_a_jam_with_nobody_there_ends_on_hold_and_nothing_is_cut_until_it_is_answered(bench):
    bench.knife.jam = True
    outcome = bench.run(attended=False)
    assert (outcome.state, outcome.held.code) == (RunState.HELD, "knife-failed")
    assert bench.knife.cuts_executed == 0
    assert open_run(bench.run_folder).state is RunEnd.HELD
    bench.knife.jam = False
    begun = bench.knife.strokes_begun
    assert bench.go_on(attended=False).state is RunState.HELD  # the question is still open: no stroke on a guess
    assert bench.knife.strokes_begun == begun
    bench.answers = ["again", "not-done"]  # a look alone does not tell: the knife failed on its way
    assert bench.go_on().state is RunState.COMPLETED
    assert [question.code for question in bench.asked] == ["knife-failed", "cut-ambiguous"]
    complete(bench)


def test_a_jam_is_asked_about_and_the_run_goes_on_when_it_is_freed(bench):
    bench.knife.jam, bench.answers = True, ["not-done"]
    bench.on["hold"] = lambda _: setattr(bench.knife, "jam", False)
    assert bench.run().state is RunState.COMPLETED
    assert [question.code for question in bench.asked] == ["knife-failed"]
    complete(bench)


def test_a_cut_that_the_counter_did_not_see_is_not_repeated_because_it_looks_as_if_it_was_not_made(bench):
    bench.knife.counter_dead, bench.answers = True, ["again", "done"]
    bench.on["journal"] = lambda event: setattr(bench.knife, "counter_dead", event.get("section") == 0)
    assert bench.run().state is RunState.COMPLETED
    assert [question.code for question in bench.asked] == ["feed-undecided", "cut-ambiguous"]
    assert bench.knife.strokes_begun == 3
    complete(bench)


def test_a_feed_that_was_moved_between_two_parts_of_a_run_is_asked_about(bench):
    bench.on["section"] = lambda event: bench.session.cancel() if event["section"] == 0 else None
    assert bench.run().state is RunState.CANCELLED
    feed = bench.rig().feed
    feed.approach_to(200.0)
    outcome = bench.go_on(attended=False)
    assert (outcome.state, outcome.held.code) == (RunState.HELD, "feed-moved")
    assert bench.knife.cuts_executed == 1


def test_a_face_with_debris_is_wiped_and_taken_again(bench):
    looks = []

    def inspect(section, previous):
        looks.append((section.section, None if previous is None else previous.section))
        return Verdict(Finding.DEBRIS, "12 % of the face covered, 5 % allowed") if len(looks) in (2, 3) else GOOD

    assert bench.run(inspect=inspect).state is RunState.COMPLETED
    assert looks == [(0, None), (1, 0), (1, 0), (1, 0), (2, 1)]
    assert bench.knife.cuts_executed == 3 + 2
    assert bench.world.feed.machine.removed_um == pytest.approx([0.0, 0.5, 0.0, 0.0, 0.5], abs=0.002)
    assert kinds(bench).count("sweep_intent") == kinds(bench).count("reject") == 2
    assert open_run(bench.run_folder).missing == []


@pytest.mark.parametrize(("answers", "state"), [(["accept"], "COMPLETED"), (["end"], "CANCELLED")])
def test_debris_that_stays_and_a_lost_specimen_are_shown_to_the_operator(bench, answers, state):
    bench.answers = answers

    def inspect(section, previous):
        return Verdict(Finding.LOST, "the field is empty") if section.section == 1 else GOOD

    assert str(bench.run(inspect=inspect).state) == state
    assert [question.code for question in bench.asked] == ["lost-specimen"]
    assert bench.asked[0].words == "the field is empty"
    assert bench.knife.cuts_executed == (3 if state == "COMPLETED" else 2)


def test_planes_found_bad_are_taken_again_and_no_others(bench):
    taken = []
    bench.on["plane"] = lambda event: taken.append((event["section"], event["plane"]))

    def inspect(section, previous):
        bad = section.section == 1 and len(taken) == 4
        return Verdict(Finding.FROZEN, "equal to the plane before", planes=(3,)) if bad else GOOD

    assert bench.run(inspect=inspect).state is RunState.COMPLETED
    assert taken == [(0, 0), (0, 1), (1, 0), (1, 1), (1, 1), (2, 0), (2, 1)]
    complete(bench)


def test_the_disk_is_asked_before_each_cut_and_the_run_goes_on_when_there_is_room(bench, monkeypatch):
    free, steps = [2**40], []
    monkeypatch.setattr("acquire.recorder.free_bytes", lambda _: free[-1])
    bench.on["section"] = lambda event: free.append(0)

    def held(event):
        steps.append(bench.knife.cuts_executed)
        free.append(2**40)

    bench.on["hold"] = held
    bench.answers = ["again"] * 9
    assert bench.run().state is RunState.COMPLETED
    assert steps == [1, 2]
    complete(bench)


def test_a_full_disk_with_nobody_there_stops_before_the_cut(bench, monkeypatch):
    free = [2**40]
    monkeypatch.setattr("acquire.recorder.free_bytes", lambda _: free[-1])
    bench.on["section"] = lambda event: free.append(0)
    outcome = bench.run(attended=False)
    assert (outcome.state, outcome.held.code) == (RunState.HELD, "disk-full")
    assert bench.knife.cuts_executed == 1
    free.append(2**40)
    bench.on.clear()
    assert bench.go_on(attended=False).state is RunState.COMPLETED
    complete(bench)


def test_a_disk_that_refuses_a_write_twice_ends_the_run_before_the_next_cut(bench, monkeypatch):
    from acquire import store

    write, refused = store._PlaneFiles.write, []

    def failing(self, slot, pixels):
        if slot == 3:
            refused.append(slot)
            raise OSError(5, "Input/output error")
        write(self, slot, pixels)

    monkeypatch.setattr(store._PlaneFiles, "write", failing)
    outcome = bench.run()
    assert (outcome.state, outcome.error.code) == (RunState.FAILED, "disk-failed")
    assert refused == [3, 3]
    assert bench.knife.cuts_executed == 2
    monkeypatch.undo()
    assert bench.go_on().state is RunState.COMPLETED
    complete(bench)


def silent_camera(bench, frames):
    """Let the camera give no frame for these exposures, counted from 1."""
    count = [0]

    def drop(what, given):
        if what == "expose":
            count[0] += 1
            if count[0] in frames:
                from devices.errors import CameraTimeout

                raise CameraTimeout("camera: no frame.")

    bench.near.on_wire = drop


def test_a_plane_that_cannot_be_taken_may_be_left_out_and_is_named(bench):
    silent_camera(bench, {3, 4, 5})
    bench.answers = ["leave-out"]
    assert bench.run().state is RunState.COMPLETED_WITH_GAPS
    run = open_run(bench.run_folder)
    assert (run.state, run.missing, run.missed) == (RunEnd.COMPLETED_WITH_GAPS, [2], {2: "camera-timeout"})
    assert next(r for r in run.records if r["e"] == "commit" and r["section"] == 1)["waived"] == [2]
    assert bench.knife.cuts_executed == 3


def test_a_camera_that_stays_away_is_asked_about_and_nothing_is_cut_meanwhile(bench):
    away = [True]

    def lose(what, given):
        if what == "expose" and bench.knife.cuts_executed == 2 and away[0]:
            raise LinkLost("camera: the connection broke.")

    bench.near.on_wire = lose
    bench.on["hold"] = lambda _: away.clear() or away.append(False)
    bench.answers = ["again"]
    assert bench.run().state is RunState.COMPLETED
    assert [question.code for question in bench.asked] == ["camera-gone"]
    complete(bench)


def test_a_pause_before_the_cut_is_heeded_there_and_nowhere_else(bench):
    paused = []
    bench.on["section"] = lambda event: bench.session.pause(Scope.BEFORE_CUT)

    def look(event):
        if event["state"] == "PAUSED":
            paused.append((bench.knife.cuts_executed, bench.session.status.pausing, str(bench.session.status.phase)))
            bench.session.resume()

    bench.on["state"] = look
    assert bench.run().state is RunState.COMPLETED
    assert paused == [(1, Scope.BEFORE_CUT, "parking"), (2, Scope.BEFORE_CUT, "parking")]


def test_a_cancel_during_a_cut_lets_the_cut_come_to_its_end(bench):
    bench.on["journal"] = lambda event: bench.session.cancel() if event["e"] == "cut_intent" else None
    assert bench.run().state is RunState.CANCELLED
    assert kinds(bench)[-3:] == ["cut_done", "clear", "end"]
    assert str(bench.knife.state) == "clear"
    bench.on.clear()
    assert bench.go_on().state is RunState.COMPLETED
    complete(bench)


def test_what_a_guarded_device_can_do_stands_in_its_class(bench):
    """As `isinstance` looks for it from Python 3.12 on; else no feed would have a knife there."""
    rig = guarded(bench.rig(), bench.clock)
    for device, protocol in ((rig.feed, Microtome), (rig.stage, HandControls), (rig.stage, SequencedStage)):
        for name in [name for name in vars(protocol) if not name.startswith("_")]:
            inspect.getattr_static(device, name)
    assert rig.feed.behind_nm == bench.spec.microtome.knife.clearance_um * 1000


def test_nobody_moves_the_stage_while_the_knife_is_out(bench):
    refused = []

    def try_to(event):
        if event["e"] in ("feed_intent", "cut_intent"):
            with pytest.raises(Unsafe) as no:
                bench.session.run._stage.move_to(0.0)
            refused.append(no.value.code)

    bench.on["journal"] = try_to
    assert bench.run().state is RunState.COMPLETED
    assert refused == ["interlock"] * 6


def test_an_answer_has_to_be_one(bench):
    bench.knife.jam = True
    said = []

    def answer(_):
        with pytest.raises(InputError) as no:
            bench.session.answer("maybe")
        said.append(no.value.code)

    bench.on["hold"] = answer
    bench.run()
    assert said == ["no-answer"]
    with pytest.raises(InputError):
        bench.session.answer("again")


def test_the_report_tells_the_story(bench):
    bench.knife.jam, bench.answers = True, ["not-done"]
    bench.on["hold"] = lambda _: setattr(bench.knife, "jam", False)
    bench.run()
    text = (bench.run_folder / "report.md").read_text()
    assert "# t: COMPLETED" in text
    assert "HOLD [knife-failed]" in text
    assert "answered: not-done" in text
    assert "| 2 | 1.500 | 500 | 3 |" in text


@pytest.fixture
def coarse(tmp_path):
    """A feed that goes by 10 nm, and sections of 504 nm: it reads back 500, 1010 and 1510 nm."""
    instrument = BENCH.replace("[microtome.knife]", "counts_per_um = 100\n[microtome.knife]")
    recipe = RECIPE.replace("thickness_nm = 500", "thickness_nm = 504\nthickness_tolerance_nm = 4")
    return lambda more="": Bench(tmp_path / "b", instrument, recipe + more)


@pytest.mark.parametrize(("answer", "state", "cuts"), [("accept", "COMPLETED", 3), ("end", "CANCELLED", 1)])
def test_a_section_of_another_thickness_is_asked_about_before_it_is_cut(coarse, answer, state, cuts):
    bench, seen = coarse(), []
    bench.answers = [answer]
    bench.on["hold"] = lambda _: seen.append(bench.knife.strokes_begun)
    assert str(bench.run().state) == state
    assert [question.code for question in bench.asked] == ["thickness"]
    assert "510 nm for section 1, 504 nm are planned, 4 nm off is allowed" in bench.asked[0].words
    assert seen == [1]
    assert bench.knife.cuts_executed == cuts
    assert ("accepted" in kinds(bench)) == (answer == "accept")
    assert "section 1: thickness" in (bench.run_folder / "report.md").read_text()


def test_a_thickness_that_nobody_answered_for_is_asked_about_again_and_the_run_goes_on(coarse):
    bench = coarse()
    for _ in range(2):
        outcome = bench.go_on(attended=False) if bench.run_folder.exists() else bench.run(attended=False)
        assert outcome.held.code == "thickness"
        assert bench.knife.strokes_begun == 1
    bench.answers = ["accept"]
    assert bench.go_on().state is RunState.COMPLETED
    assert bench.knife.cuts_executed == 3


def test_a_thickness_is_noted_and_accepted_where_the_recipe_says_so(coarse):
    bench = coarse('on_quality = "accept"\n')
    assert bench.run(attended=False).state is RunState.COMPLETED
    assert kinds(bench).count("accepted") == 1


def test_what_a_feed_cannot_resolve_is_not_asked_about_unless_the_recipe_says_so(coarse):
    bench = coarse()
    bench.recipe_file.write_text(bench.recipe_file.read_text().replace("thickness_tolerance_nm = 4\n", ""))
    assert bench.run(attended=False).state is RunState.COMPLETED
    assert open_run(bench.run_folder).manifest["plan"]["sections"]["tolerance_nm"] == 50
