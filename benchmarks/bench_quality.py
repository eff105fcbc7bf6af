"""How often the quality checks find what is there, and cry out when nothing is: on simulated blocks of many seeds.

The limits in `acquire.quality` were chosen on seeds 0 to 7. Usage: bench_quality.py [first seed] [seeds]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from sections_seen import BROKEN, judge_series

THICKNESSES_UM = (0.07, 0.2, 0.5, 1.0)


def main(first: int = 100, seeds: int = 20) -> None:
    """Print a table: for each thickness false alarms, and for each fault how many were found."""
    print("| thickness | sections | false alarms |", " | ".join(BROKEN), "|")
    print("|" + "---|" * (3 + len(BROKEN)))
    for thickness_um in THICKNESSES_UM:
        alarms, sections, found = 0, 0, {name: np.zeros(2, int) for name in BROKEN}
        for seed in range(first, first + seeds):
            result = judge_series(seed, thickness_um)
            alarms += len(result.alarms)
            sections += result.good
            for name, hit in result.found:
                found[name] += hit, 1
        cells = " | ".join(f"{hits} of {tried}" for hits, tried in found.values())
        print(f"| {1000 * thickness_um:.0f} nm | {sections} | {alarms} | {cells} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
