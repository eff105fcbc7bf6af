"""Kills runs of sections at every instant, and says how many went on to the same data with exactly the planned cuts.

Run: ``python benchmarks/bench_kills.py [RUNS] [SEED]``. Instants are drawn without repetition from those of an
uninterrupted run, records of the journal and planes first; every fourth run is killed a second time while it goes on.
Prints progress, then a table and a line of JSON; ends with 1 when a single run was wrong.
"""

from __future__ import annotations

import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "faults")]

from killing import WIRE, Stable  # noqa: E402  it lies beside the tests
from sections import BENCH, RECIPE, files  # noqa: E402
from test_killed_anywhere import AWAY_S, SECTIONS, instants, planes_of, violations  # noqa: E402

from acquire.progress import progress  # noqa: E402

RUNS = 2000
TWICE_EVERY = 4


def order(everything, dice):
    """Records and planes first, then the exchanges with devices, in an order of their own; again when all are done."""
    few = [instant for instant in everything if not instant[0].startswith(WIRE)]
    many = [instant for instant in everything if instant[0].startswith(WIRE)]
    while True:
        yield from dice.sample(few, len(few)) + dice.sample(many, len(many))


def main():
    given = [int(word) for word in sys.argv[1:3]]
    runs, seed = [*given, *(RUNS, 1)[len(given) :]]
    dice = random.Random(seed)
    memory = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    folder = Path(tempfile.mkdtemp(prefix="stereotome-kills-", dir=memory))
    instrument, recipe = files(folder, BENCH, RECIPE.replace("count = 3", f"count = {SECTIONS}"))
    stable, tried, wrong = Stable(instrument, recipe, folder / "stable"), Counter(), {}
    try:
        labels = stable.run(folder / "whole")["labels"]
        whole = labels, planes_of(folder / "whole"), stable.truth()
        everything = list(instants(labels))
        with progress("kills", runs) as show:
            for number, kill_at in zip(range(1, runs + 1), order(everything, dice), strict=False):
                again = (None, dice.randrange(1, len(labels))) if number % TWICE_EVERY == 0 else None
                found = violations(stable, folder, whole, kill_at, dice.choice(AWAY_S), again_at=again)
                tried[kill_at[0].split()[0]] += 1
                tried["killed twice"] += again is not None
                if found:
                    wrong[str((kill_at, again))] = found
                    print(kill_at, again, found, flush=True)
                show(number)
    finally:
        stable.close()
        shutil.rmtree(folder, ignore_errors=True)
    for name, count in {**tried, "instants of an uninterrupted run": len(everything), "WRONG": len(wrong)}.items():
        print(f"{name:40} {count}")
    print(json.dumps({"runs": runs, "seed": seed, **tried, "wrong": wrong}))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
