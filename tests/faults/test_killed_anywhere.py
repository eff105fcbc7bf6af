"""Whatever instant kills a run of sections: it goes on to the same planes, byte for byte, and cuts as often as planned.

`killing` says how. Here 200 instants are tried: every record of the journal (before, half written, after), every plane
on its way to the disk, and exchanges with the devices chosen anew each time. ``--long`` tries all of them, and kills
many a run twice; docs/reliability.md has the last result of that.
"""

import random
import shutil
from pathlib import Path

import pytest
from killing import PLANE, RECORD, WIRE, Stable
from sections import BENCH, RECIPE, files

from acquire.store import RunEnd, open_run
from devices.errors import StereotomeError

SECTIONS = 2
THICKNESS = '= "1: 500, 2-: 300"'  # the run changes it between its two cuts, wherever it is killed
CUTS = {f"{RECORD} {when} cut_{what}" for when in ("before", "after") for what in ("intent", "done")}
IN_CI = 200
AWAY_S = (0.0, 0.3, 60.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where runs are kept; in memory, where there is some: a kill is no power cut."""
    memory = Path("/dev/shm")
    if not memory.is_dir():
        yield tmp_path_factory.mktemp("runs")
        return
    made = memory / f"stereotome-test-{random.SystemRandom().randrange(10**9)}"
    made.mkdir()
    yield made
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def stable(folder):
    instrument, recipe = files(
        folder, BENCH, RECIPE.replace("count = 3", f"count = {SECTIONS}").replace("= 500", THICKNESS)
    )
    horses = Stable(instrument, recipe, folder / "stable")
    yield horses
    horses.close()


def planes_of(folder):
    run = open_run(folder)
    return {slot: run.read(slot).tobytes() for slot in run.planes}


@pytest.fixture(scope="module")
def whole(stable, folder):
    """The run that nothing interrupts: its instants, its planes, and what became of the block."""
    told = stable.run(folder / "whole")
    assert told["state"] == "COMPLETED", told
    assert stable.truth()["removed_um"] == pytest.approx([0.0, 0.3], abs=0.002)  # of the first cut, the touch
    return told["labels"], planes_of(folder / "whole"), stable.truth()


def instants(labels):
    """Every instant, as a label and which of that label it is."""
    seen = {}
    for label in labels:
        seen[label] = seen.get(label, 0) + 1
        yield label, seen[label]


def violations(stable, folder, whole, kill_at, away_s=0.3, again_at=None, **broken):
    """Kill a run, perhaps twice, let it go on, and say what of it is wrong."""
    _, planes, block = whole
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    if not stable.run(run, kill_at=kill_at, **broken)["killed"]:
        return []  # there are now and then fewer looks at a moving device than in the whole run
    if not (run / "journal.jsonl").exists():
        return []  # it died before there was a run
    if again_at is not None:
        stable.go_on(run, away_s=away_s, kill_at=again_at, **broken)
    told = stable.go_on(run, away_s=away_s, **broken)
    if told.get("state") == "raised" and "nothing is missing" in told["said"]:
        told = {"state": str(open_run(run).state), "said": ""}  # the first resume came to its end before its kill
    return [*wrong_end(told, run), *wrong_planes(run, planes), *wrong_cuts(stable.truth(), block)]


def wrong_end(told, run):
    if told.get("state") != "COMPLETED" or open_run(run).state is not RunEnd.COMPLETED:
        yield f"it ended as {told}"


def wrong_planes(run, planes):
    try:
        same = planes_of(run) == planes
    except StereotomeError as error:
        yield f"a plane cannot be read: {error}"
    else:
        if not same:
            yield "its planes are not those of the whole run"


def wrong_cuts(truth, block):
    for what in ("cuts", "begun", "removed_um"):
        if truth[what] != block[what]:
            yield f"{what}: {truth[what]}, not {block[what]}"


def test_a_run_killed_anywhere_goes_on_to_the_same_planes_and_cuts(stable, folder, whole, pytestconfig):
    everything = list(instants(whole[0]))
    chosen = [instant for instant in everything if not instant[0].startswith(WIRE)]
    wires = [instant for instant in everything if instant[0].startswith(WIRE)]
    dice = random.Random()
    long = pytestconfig.getoption("long")
    chosen += wires if long else dice.sample(wires, IN_CI - len(chosen))
    found = {}
    for kill_at in chosen:
        if wrong := violations(stable, folder, whole, kill_at, dice.choice(AWAY_S)):
            found[kill_at] = wrong
    for _ in range(len(everything) if long else 0):
        kill_at, again_at = dice.choice(everything), (None, dice.randrange(1, len(everything)))
        if wrong := violations(stable, folder, whole, kill_at, dice.choice(AWAY_S), again_at=again_at):
            found[kill_at, again_at] = wrong
    assert not found, found
    assert len(chosen) >= IN_CI
    assert {label for label, _ in chosen} >= CUTS | {f"{PLANE} before", f"{PLANE} after", f"{RECORD} half"}


@pytest.mark.parametrize(
    ("broken", "label"),
    [("blind-cut", f"{RECORD} before cut_done"), ("record-first", f"{PLANE} before")],
)
def test_a_program_that_breaks_the_rules_is_found_out(stable, folder, whole, broken, label):
    found = [violations(stable, folder, whole, (label, nth), broken=broken) for nth in range(1, SECTIONS + 1)]
    assert any(found)
