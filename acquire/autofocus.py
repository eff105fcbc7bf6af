"""Keeps a stack in focus from section to section: pure decisions, and the searches that feed them.

A stack of three planes or more is tracked from its own planes: nothing is exposed for it. Fewer planes are searched
for, coarse to fine. Either way the focus is moved at most one step a section, and never out of its bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Sequence

    from acquire.journal import Record

LEAST_CONTRAST = 1.15  # greatest over least score; below, nothing says where the focus is
COARSE = 2  # steps to either side in the first round of a search
ROUNDS = 3
TRACKED_PLANES = 3


@dataclass(frozen=True)
class Peak:
    """Where a measure of focus is greatest.

    Attributes
    ----------
    z_nm : float
        The place.
    inside : bool
        Between two positions that were measured; else the focus lies there or beyond.
    """

    z_nm: float
    inside: bool


def peak(z_nm: Sequence[float], scores: Sequence[float]) -> Peak | None:
    """Return where scores peak: the vertex of the parabola through the logarithms of the three around the greatest.

    None when nothing stands out. Positions may come in any order and at any distance.
    """
    order = np.argsort(z_nm)
    z, score = np.asarray(z_nm, float)[order], np.asarray(scores, float)[order]
    if score.min() <= 0 or score.max() / score.min() < LEAST_CONTRAST:
        return None
    best = int(score.argmax())
    if best in (0, len(z) - 1):
        return Peak(float(z[best]), inside=False)
    return Peak(_vertex(z[best - 1 : best + 2], np.log(score[best - 1 : best + 2])), inside=True)


def _vertex(z: np.ndarray, value: np.ndarray) -> float:
    """Return the vertex of the parabola through three points, the middle one highest."""
    left, right = (value[1] - value[0]) / (z[1] - z[0]), (value[2] - value[1]) / (z[2] - z[1])
    curvature = (right - left) / (z[2] - z[0])
    if not curvature < 0:
        return float(z[1])
    return float(np.clip((z[0] + z[1]) / 2 - left / (2 * curvature), z[0], z[2]))


@dataclass(frozen=True)
class FocusPlan:
    """What the autofocus may do.

    Attributes
    ----------
    most_nm : int
        Greatest move from one section to the next.
    dead_nm : int
        Errors up to this are left alone: they are noise.
    low_nm, high_nm : int
        Bounds of the offset: at both every plane of the stack, with its approach, lies within the stage's limits.
    """

    most_nm: int
    dead_nm: int
    low_nm: int
    high_nm: int


@dataclass(frozen=True)
class Focus:
    """Where the focus is held.

    Attributes
    ----------
    offset_nm : int
        By how much all planes lie above where the plan has them.
    target_nm : int or None
        Where in the plan the sharpest place belongs; None until the first section tells.
    words : str
        What was decided last, for people.
    """

    offset_nm: int = 0
    target_nm: int | None = None
    words: str = ""

    def record(self, section: int) -> Record:
        """Return what the journal keeps."""
        kept = {"offset_nm": self.offset_nm, "target_nm": self.target_nm, "words": self.words}
        return {"e": "focus", "section": section, **kept}


def focus_of(records: Iterable[dict[str, Any]]) -> Focus:
    """Return where an earlier part of a run left the focus."""
    last = [record for record in records if record["e"] == "focus"][-1:]
    return Focus(last[0]["offset_nm"], last[0]["target_nm"]) if last else Focus()


def correct(focus: Focus, found: Peak | None, plan: FocusPlan) -> Focus:
    """Return where the focus goes after the sharpest place was found at ``found``, an absolute position.

    The first sharp place inside a stack becomes the target; from then on it is held.
    """
    if found is None:
        return replace(focus, words="nothing stands out: the focus stays")
    if focus.target_nm is None:
        if found.inside:
            target_nm = round(found.z_nm) - focus.offset_nm
            return replace(
                focus, target_nm=target_nm, words=f"the focus is held at {target_nm / 1000:+.2f} µm of the plan"
            )
        return replace(focus, words="the sharpest plane is at the end of the stack: the focus is not known yet")
    error_nm = round(found.z_nm) - focus.offset_nm - focus.target_nm
    if abs(error_nm) <= plan.dead_nm:
        return replace(focus, words=f"off by {error_nm / 1000:+.2f} µm: stays")
    step_nm = max(-plan.most_nm, min(plan.most_nm, error_nm))
    offset_nm = max(plan.low_nm, min(plan.high_nm, focus.offset_nm + step_nm))
    bound = " (its bound)" if offset_nm != focus.offset_nm + step_nm else ""
    words = f"off by {error_nm / 1000:+.2f} µm: moved by {(offset_nm - focus.offset_nm) / 1000:+.2f} µm{bound}"
    return replace(focus, offset_nm=offset_nm, words=words)


def coarse_to_fine(
    centre_nm: int, reach_nm: int, low_nm: int, high_nm: int
) -> Generator[int, float, tuple[list[int], list[float]]]:
    """Ask for the score at one position after the other; return all positions and scores.

    Five positions over ``reach_nm`` to either side, then each round the two half way to the neighbours of the best.
    Positions outside the bounds are not visited.
    """
    step_nm = max(1, reach_nm // COARSE)
    scores: dict[int, float] = {}
    wanted = [centre_nm + k * step_nm for k in range(-COARSE, COARSE + 1)]
    for _ in range(ROUNDS):
        for z_nm in wanted:
            if low_nm <= z_nm <= high_nm and z_nm not in scores:
                scores[z_nm] = yield z_nm
        step_nm = max(1, step_nm // 2)
        best_nm = max(scores, key=lambda z_nm: scores[z_nm])
        wanted = [best_nm - step_nm, best_nm + step_nm]
    return list(scores), list(scores.values())


def search(measure: Callable[[int], float], centre_nm: int, plan: FocusPlan) -> Peak | None:
    """Measure coarse to fine around ``centre_nm`` and return the peak; ``measure`` goes to a position and scores it."""
    asking = coarse_to_fine(centre_nm, plan.most_nm, centre_nm + plan.low_nm, centre_nm + plan.high_nm)
    try:
        wanted_nm = next(asking)
        while True:
            wanted_nm = asking.send(measure(wanted_nm))
    except StopIteration as done:
        return peak(*done.value)
