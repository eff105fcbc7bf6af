"""Watches the pictures of a run: mean and spread of each against limits, and the middle row of each as a slice."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.replies import RunView
    from display.console.eyes import Seen

MOST_STEPS = 2048
MOST_COLUMNS = 1024
AROUND = 0.2
MEASURES = ("mean", "sd")
WORDS = {"mean": "mean grey level", "sd": "standard deviation"}
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Step:
    """What is kept of a plane, or of the sharpest plane seen of a section.

    Attributes
    ----------
    number : int
        Plane, or section, counted from 0.
    z_um : float
        Where the stage was read back.
    mean, sd : float
        Mean and standard deviation of all its grey levels.
    row : array (columns[, 3])
        Its middle row, thinned to `MOST_COLUMNS`.
    """

    number: int
    z_um: float
    mean: float
    sd: float
    attempt: int
    score: float
    row: NDArray[Any]


def step_of(seen: Seen, number: int) -> Step:
    """Return what is kept of a frame."""
    row = seen.pixels[seen.pixels.shape[0] // 2]
    thinned = row[:: -(-row.shape[0] // MOST_COLUMNS)].copy()
    header = seen.header
    return Step(number, header.z_um, seen.mean, seen.sd, header.attempt, seen.score, thinned)


@dataclass
class Monitor:
    """What was seen of the run under way, or of the last one; used by the window's thread alone.

    Attributes
    ----------
    steps : dict of int to Step
        By plane; by section in a run with more than one.
    of_sections : bool
        Which of the two.
    limits : dict of str to (float, float)
        Of ``mean`` and ``sd``; empty when nothing is watched.
    pauses : bool
        Whether the run is to pause when a picture is outside.
    version : int
        Another one whenever the steps changed.
    """

    steps: dict[int, Step] = field(default_factory=dict)
    of_sections: bool = False
    limits: dict[str, Range] = field(default_factory=dict)
    pauses: bool = False
    version: int = 0
    _run: int = 0
    _frame: int = 0
    _open: int | None = None

    def take(self, seen: Seen, run: RunView) -> str:
        """Take over a frame of a run; return what is wrong with the step before it, once that is over, in words."""
        header = seen.header
        if run.number != self._run:
            self._begin(run)
        if seen.number == self._frame or header.plane < 0 or header.band:
            return ""
        self._frame = seen.number
        number = header.section if self.of_sections else header.plane
        words = self.outside(self._open) if number != self._open else ""
        self._open = number
        self._put(step_of(seen, number))
        return words

    def rest(self, seen: Seen | None) -> str:
        """Note that no run is under way: what is seen now belongs to none to come. Judges the last step as `take`."""
        self._frame = self._frame if seen is None else seen.number
        words, self._open = self.outside(self._open), None
        return words

    def outside(self, number: int | None) -> str:
        """Return in words which limit a step is outside of; empty for none, and for one that was not seen."""
        step = None if number is None else self.steps.get(number)
        if step is None:
            return ""
        kind = "section" if self.of_sections else "plane"
        return "; ".join(
            f"{WORDS[measure]} {value:.0f} of {kind} {step.number + 1} is outside {low:g} … {high:g}"
            for measure, (low, high) in self.limits.items()
            if not low <= (value := getattr(step, measure)) <= high
        )

    def watch_around(self) -> None:
        """Set limits around what was seen: a fifth below and above the median."""
        for measure in MEASURES:
            usual = median(getattr(step, measure) for step in self.steps.values())
            self.limits[measure] = (round((1 - AROUND) * usual), round((1 + AROUND) * usual))

    def curve(self, measure: str) -> NDArray[np.float64]:
        """Return a measure of all steps in their order."""
        return np.array([getattr(self.steps[number], measure) for number in sorted(self.steps)])

    def reslice(self, width: int, height: int) -> NDArray[Any]:
        """Return the slice through the middle rows, (height, width[, 3]), without invented levels.

        Every place shows the pixel nearest to it: across, of the row; down, of the step seen that is nearest, in z
        with the highest on top, or by the number of the section with the first on top.
        """
        rows = np.stack([self.steps[number].row for number in self.order()])
        places = self.places()
        share = (np.arange(height) + 0.5) / height * len(places) - 0.5  # as much room for each step, were they even
        wanted = places[0] + share * (places[-1] - places[0]) / max(len(places) - 1, 1)
        nearest = np.abs(np.subtract.outer(wanted, places)).argmin(axis=1)
        columns = (np.arange(width) + 0.5) * rows.shape[1] / width
        sliced: NDArray[Any] = np.ascontiguousarray(rows[nearest][:, columns.astype(int)])
        return sliced

    def order(self) -> list[int]:
        """Return the steps as they lie from the top of the slice to its bottom."""
        if self.of_sections:
            return sorted(self.steps)
        return sorted(self.steps, key=lambda number: -self.steps[number].z_um)

    def places(self) -> NDArray[np.float64]:
        """Return where the steps lie, in the order of the slice: section number, or z in µm."""
        return np.array([n if self.of_sections else self.steps[n].z_um for n in self.order()], np.float64)

    def _begin(self, run: RunView) -> None:
        self.steps, self._run, self._open = {}, run.number, None
        self.of_sections = run.sections > 1
        self.version += 1

    def _put(self, step: Step) -> None:
        """Keep the newest of a plane, the sharpest of a section unless it was cut or taken anew."""
        before = self.steps.get(step.number)
        if self.of_sections and before is not None and (step.attempt, step.score) < (before.attempt, before.score):
            return
        self.steps[step.number] = step
        self.version += 1
        if len(self.steps) > MOST_STEPS:
            for number in sorted(self.steps)[1:-1:2]:
                del self.steps[number]
