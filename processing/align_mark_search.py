"""Fiducial marks found without a table: spots followed through the stack, of which a set keeps its places.

Spots of the reference section are followed through the others, with the pictures as guide; `processing.align_mark_sets`
tells marks from features of the specimen; then marks are looked for once more, where the others foretell them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.align_fiducials import MARK_ERROR_PX, Marks
from processing.align_mark_sets import AGREE_PX, LEAST_FOUND, NOISE_PX, PRESENT, STEADY_PX, best_set, no_marks, too_few
from processing.align_models import applied
from processing.align_pair import grey
from processing.align_spots import found_again, spots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.align_mark_sets import Motion
    from processing.align_spots import Spot
    from processing.registration import Planes

    Array = NDArray[Any]

SEARCH_PX = 12  # around where a spot is expected
AGAIN_PX = 4  # around where the other marks foretell it
NEAREST_PX = 1.0  # a spot is never expected more surely
EARLY = 5  # sections after which spots that are seldom seen are given up
JITTER_PX = 2.0  # by which marks and pictures may disagree from section to section


def find_marks(sections: Planes, matrices: Array, reference: int) -> Marks:
    """Find marks: spots that keep their places to each other in all sections.

    Parameters
    ----------
    sections : sequence of array
        Grey or RGB.
    matrices : array (sections, 3, 3)
        From the output to each section, by the pictures; from one to the next right to `SEARCH_PX`.
    reference : int
        Where marks are looked for first.

    Raises
    ------
    InputError
        ``align-marks``: no four spots agree beyond chance, two sets that contradict each other do, or they do not
        move with the pictures.
    """
    candidates = spots(grey(sections[reference]))
    places = followed(sections, matrices, candidates, reference)
    found = best_set(in_output(places, matrices), candidates, reference)
    motion = found.motion
    if motion.jitter_px() > JITTER_PX:
        raise no_marks(
            f"the {len(found.members)} spots that keep their places to each other do not move with the pictures; they "
            "may be dirt of the camera"
        )
    alike = [m for m in range(len(candidates)) if all(candidates[m].like(candidates[k]) for k in found.members)]
    places = looked_up(sections, matrices, motion, [candidates[m] for m in alike])
    off = motion.misfit_px(in_output(places, matrices), reference)
    places[off > AGREE_PX] = np.nan
    kept = [m for m in range(len(alike)) if is_steady(off[:, m], found.agreement_px)]
    if len(kept) < LEAST_FOUND:
        raise too_few(len(kept), len(candidates), reference)
    return Marks(places[:, kept], np.full((len(kept), 2), np.nan), MARK_ERROR_PX)


def is_steady(off: Array, usual_px: float) -> bool:
    """Say whether a spot stays where the marks say: seen often enough, and about as near as they are."""
    near = off <= AGREE_PX
    return bool(near.mean() >= PRESENT and np.median(off[near]) <= min(max(2 * usual_px, 2 * NOISE_PX), STEADY_PX))


def followed(sections: Planes, matrices: Array, candidates: Sequence[Spot], reference: int) -> Array:
    """Follow spots from section to section, both ways; (sections, spots, 2), NaN where one was not seen."""
    places = np.full((len(sections), len(candidates), 2), np.nan)
    places[reference] = np.reshape([(s.x, s.y) for s in candidates], (-1, 2))
    alive = list(range(len(candidates)))
    for walk in (range(reference + 1, len(sections)), range(reference - 1, -1, -1)):
        trails = {m: Trail(candidates[m]) for m in alive}
        for done, k in enumerate(walk, start=1):
            picture, step = grey(sections[k]), matrices[k] @ np.linalg.inv(matrices[k - walk.step])
            for m, trail in trails.items():
                trails[m], places[k, m] = trail.stepped(picture, step)
            if done == EARLY:
                seen = np.isfinite(places[[k - walk.step * n for n in range(EARLY)], :, 0]).mean(axis=0)
                trails = {m: trail for m, trail in trails.items() if seen[m] >= PRESENT}
        alive = list(trails)
    return places


@dataclass(frozen=True)
class Trail:
    """A spot on its way: as last seen, how far it leads the pictures from section to section, and how surely."""

    spot: Spot
    lead: Array = field(default_factory=lambda: np.zeros(2))
    usual_px: float = SEARCH_PX / 3

    def stepped(self, picture: Array, step: Array) -> tuple[Trail, Array]:
        """Look for it in the next section, ``step`` away by the pictures; returns its place, NaN if not seen."""
        plain = applied(step, np.array([[self.spot.x, self.spot.y]]))[0]
        expected = plain + self.lead
        found = found_again(picture, self.spot, expected, SEARCH_PX, self.usual_px)
        if found is None:
            return replace(self, spot=replace(self.spot, x=float(expected[0]), y=float(expected[1]))), np.full(
                2, np.nan
            )
        place = np.array([found.x, found.y])
        usual = max(0.7 * self.usual_px + 0.3 * 2 * float(np.linalg.norm(place - expected)), NEAREST_PX)
        return Trail(found, 0.7 * self.lead + 0.3 * (place - plain), usual), place


def in_output(places: Array, matrices: Array) -> Array:
    """Return places (sections, spots, 2) in the frame of the output, by the pictures."""
    return np.stack([applied(np.linalg.inv(m), seen) for m, seen in zip(matrices, places, strict=True)])


def looked_up(sections: Planes, matrices: Array, motion: Motion, marks: Sequence[Spot]) -> Array:
    """Look again for spots where the motion says they are; (sections, spots, 2)."""
    places = np.full((len(sections), len(marks), 2), np.nan)
    there = motion.foretold(np.array([(s.x, s.y) for s in marks]))
    for k, matrix in enumerate(matrices):
        picture, expected = grey(sections[k]), applied(matrix, there[k])
        for m, spot in enumerate(marks):
            if np.isfinite(expected[m]).all() and (
                found := found_again(picture, spot, expected[m], AGAIN_PX, NEAREST_PX)
            ):
                places[k, m] = found.x, found.y
    return places
