"""Which of the spots that were followed through a stack are fiducial marks.

Laid over each other by the pictures, sections keep the specimen in place on the whole, while its features wander each
on its own. Marks stay where they are to each other: where the specimen leans or twists, they drift and turn together.
Three spots give the motion of all others; how unlikely it is that so many agree so well by chance tells marks from
features (number of false alarms of an a-contrario test: Desolneux, Moisan and Morel 2000; Moisan and Stival 2004).

The reference section, in whose frame all this happens, may be compressed itself. A turn then looks like a shear, too,
and is one only in lengths that are right: a metric M with Lᵀ M L = M for the linear part L of every section's motion,
which is found by least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb, log
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.align_spots import Spot

    Array = NDArray[Any]

PRESENT = 0.7  # of the sections must show a mark
LEAST_FOUND = 4
NOISE_PX = 0.1  # agreement better than this says no more
UNRELATED_PX = 2.0  # features that wander by less through the whole stack are as good as marks
FALSE_ALARMS = log(0.05)  # sets of so good an agreement expected by chance
LEAST_AREA_PX = 500.0  # of the triangle three spots span
AGREE_PX = 1.0  # from where the others say, in one section
STEADY_PX = 0.4  # the same, median of all sections
LARGEST_SHORTENING = 0.3  # of the reference section
SECTIONS = 24  # looked at, spread over the stack
ROUNDS = 4


def no_marks(what: str) -> InputError:
    """Return the error for a stack whose marks cannot be told."""
    return InputError(
        f"{what}.",
        why="A mark is a round spot of steady size and contrast, seen in most sections; marks look alike and keep "
        "their places to each other, better than features of the specimen do by chance.",
        fix=("give their places: --fiducials marks.csv", "leave out --fiducials", "choose another --reference"),
        code="align-marks",
    )


def too_few(found: int, looked_at: int, reference: int) -> InputError:
    """Return the error for spots of which not enough are marks."""
    return no_marks(
        f"{found} fiducial marks were found, of {looked_at} spots in section {reference}; {LEAST_FOUND} are needed"
    )


@dataclass(frozen=True)
class Motion:
    """What marks do in the frame of the pictures, with lengths taken by ``C⁻¹``.

    Attributes
    ----------
    shape : array (2, 2)
        C: from right lengths to those of the reference section.
    turn, shift : array (sections,) complex
        In right lengths: from x + iy in the reference section to turn · (x + iy) + shift.
    """

    shape: Array
    turn: Array
    shift: Array

    def misfit_px(self, seen: Array, reference: int) -> Array:
        """Distance of spots (sections, spots, 2) from where they should be; infinite where one was not seen."""
        right = self._right(seen)
        off = np.abs(self.turn[:, None] * right[reference] + self.shift[:, None] - right)
        return np.where(np.isfinite(off), off, np.inf)

    def foretold(self, places: Array) -> Array:
        """Return where spots of the reference section, (spots, 2), are in all: (sections, spots, 2)."""
        moved = self.turn[:, None] * self._right(places) + self.shift[:, None]
        return np.stack([moved.real, moved.imag], axis=-1) @ self.shape.T

    def _right(self, places: Array) -> Array:
        return as_complex(places @ np.linalg.inv(self.shape).T)

    def jitter_px(self) -> float:
        """How unevenly marks move in the frame of the pictures: typical second difference of their shift."""
        bends = np.abs(np.diff(self.shift, n=2))
        bends = bends[np.isfinite(bends)]
        return float(np.median(bends)) if bends.size else 0.0


def as_complex(places: Array) -> Array:
    """Return (…, 2) as x + iy."""
    return np.asarray(places[..., 0] + 1j * places[..., 1])


@dataclass(frozen=True)
class MarkSet:
    """Spots that agree, how well, and their motion."""

    members: tuple[int, ...]
    agreement_px: float
    motion: Motion


class Candidate(NamedTuple):
    """A set foretold by three spots; the first field is the logarithm of the number of false alarms."""

    false_alarms: float
    members: tuple[int, ...]
    rigid: bool
    shape: Array


def best_set(seen: Array, looks: Sequence[Spot], reference: int) -> MarkSet:
    """Return the set of spots that agree best beyond chance.

    Parameters
    ----------
    seen : array (sections, spots, 2)
        Places in the frame of the output; NaN where one was not seen.
    looks : sequence of Spot
        As in the reference section.
    reference : int
        The section all others are compared with.

    Raises
    ------
    InputError
        ``align-marks``: none does, or two that contradict each other.
    """
    sets = [found for kind in kinds(seen, looks) for found in _sets_of_a_kind(seen, kind, reference)]
    ranked = sorted((s for s in sets if s.false_alarms < FALSE_ALARMS), key=lambda s: s.false_alarms)
    if not ranked:
        raise too_few(0, len(looks), reference)
    chosen = ranked[0]
    motion = common_motion(seen, chosen, reference)
    off = np.median(motion.misfit_px(seen[:, chosen.members], reference), axis=0)
    _refuse_rivals(seen, reference, chosen, [s for s in ranked if len({*s.members} & {*chosen.members}) <= 1])
    return MarkSet(chosen.members, float(np.median(off)), motion)


def kinds(seen: Array, looks: Sequence[Spot]) -> list[list[int]]:
    """Return groups of spots that look alike and were seen often enough, none within another."""
    often = np.isfinite(seen[..., 0]).mean(axis=0) >= PRESENT
    usable = [m for m in range(len(looks)) if often[m]]
    groups = {tuple(m for m in usable if looks[k].like(looks[m])) for k in usable}
    largest = [g for g in groups if len(g) >= LEAST_FOUND and not any({*g} < {*other} for other in groups)]
    return [list(g) for g in sorted(largest)]


def _sets_of_a_kind(seen: Array, kind: Sequence[int], reference: int) -> list[Candidate]:
    """Try every three spots of a kind; returns the most meaningful set of each, rigid and with changes of scale."""
    every = np.unique(np.linspace(0, len(seen) - 1, SECTIONS).round().astype(int))
    places = seen[np.append(every, reference)][:, kind]
    threes = np.array(list(combinations(range(len(kind)), 3)))
    edges = places[-1][threes[:, 1:]] - places[-1][threes[:, :1]]
    threes = threes[np.abs(np.linalg.det(edges)) > 2 * LEAST_AREA_PX]
    found = []
    for three in threes:
        linear = linear_parts(places, three)
        off = _affine_misfit(places, linear, int(three[0]))
        if (off <= STEADY_PX).sum() < LEAST_FOUND:
            continue
        for rigid in (True, False):
            shape, own, free_px = rigidity(linear[:-1], places[-1][three], rigid=rigid)
            candidate = _meaningful(off, three, own, rigid=rigid, tries=2 * len(threes), free_px=free_px)
            members = tuple(sorted(kind[m] for m in candidate[1]))
            found.append(Candidate(candidate[0], members, rigid, shape))
    return found


def linear_parts(places: Array, three: Array) -> Array:
    """Return L of the maps that three spots give, from the last of ``places`` to each, (sections, 2, 2)."""
    edges = np.swapaxes(places[:, three[1:]] - places[:, three[:1]], 1, 2)
    return np.asarray(edges @ np.linalg.inv(edges[-1]))


def _affine_misfit(places: Array, linear: Array, corner: int) -> Array:
    """Typical distance of each spot from where three foretell it, px."""
    moved = (places[-1] - places[-1][corner]) @ np.swapaxes(linear, 1, 2) + places[:, corner][:, None]
    off = np.linalg.norm(moved - places, axis=2)[:-1]
    return np.median(np.where(np.isfinite(off), off, np.inf), axis=0)


def rigidity(linear: Array, corners: Array, *, rigid: bool) -> tuple[Array, float, float]:
    """Find the lengths in which three spots move rigidly.

    Parameters
    ----------
    linear : array (sections, 2, 2)
        Of the maps they give; NaN where one was not seen.
    corners : array (3, 2)
        In the reference section.
    rigid : bool
        False: but for changes of scale.

    Returns
    -------
    shape : array (2, 2)
        C: from right lengths to those of the reference section; M = (C Cᵀ)⁻¹.
    misfit_px : float
        Typical deviation from a rigid motion at the corners.
    free_px : float
        By how much the choice of lengths may change the motion at the corners: 0 where nothing turns.
    """
    linear = linear[np.isfinite(linear).all(axis=(1, 2))]
    size = float(np.sqrt(((corners - corners.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if not rigid:
        linear = linear / np.sqrt(np.maximum(np.abs(np.linalg.det(linear)), 1e-9))[:, None, None]
    shape = metric(linear, NOISE_PX / size)
    off = deviation(np.linalg.inv(shape) @ linear @ shape)
    turned = float(np.median(np.abs(linear[:, 1, 0] - linear[:, 0, 1]) / 2))
    return shape, float(np.median(off)) * size, LARGEST_SHORTENING * turned * size


def deviation(linear: Array) -> Array:
    """Return how far maps (n, 2, 2) are from rotations: root mean square change of unit vectors."""
    angle = np.arctan2(linear[:, 1, 0] - linear[:, 0, 1], linear[:, 0, 0] + linear[:, 1, 1])
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 2, 2)
    return np.asarray(np.sqrt(((linear - turn) ** 2).sum(axis=(1, 2)) / 2))


def metric(linear: Array, noise: float) -> Array:
    """Return C of the metric that maps (n, 2, 2) keep; the unit matrix where none does or nothing turns."""
    (a, b), (c, d) = np.moveaxis(linear, 0, 2)
    zero, one = np.zeros_like(a), np.ones_like(a)
    kept = np.stack(  # of M = [[m0, m1], [m1, m2]]: what Lᵀ M L − M is
        [
            np.stack([a * a - one, 2 * a * c, c * c], axis=-1),
            np.sqrt(2) * np.stack([a * b, a * d + b * c - one, c * d], axis=-1),
            np.stack([b * b, 2 * b * d, d * d - one], axis=-1),
        ],
        axis=1,
    )
    round_ = noise**2 * np.array([[1, zero[0], -1], [0, 4, 0], [-1, 0, 1]], np.float64)  # without evidence, round
    weight, found = one, np.array([1.0, 0.0, 1.0])
    for _ in range(ROUNDS):
        found = np.linalg.eigh(np.einsum("n,nij,nik->jk", weight / weight.sum(), kept, kept) + round_)[1][:, 0]
        off = np.linalg.norm(kept @ found, axis=1)
        weight = 1 / (1 + (off / (3 * float(np.median(off)) + noise)) ** 2) ** 2
    values, axes = np.linalg.eigh(np.array([[found[0], found[1]], [found[1], found[2]]]) * np.sign(found[0] + found[2]))
    if values[0] <= (1 - LARGEST_SHORTENING) ** 2 * values[1]:
        return np.eye(2)
    return np.asarray((axes / np.sqrt(values / values[0])) @ axes.T)


def _meaningful(
    off: Array, three: Array, own: float, *, rigid: bool, tries: int, free_px: float
) -> tuple[float, tuple[int, ...]]:
    """Return the least number of false alarms (logarithm) of the sets three spots foretell, and that set.

    ``off`` are the misfits of all spots, ``own`` that of the three themselves to a rigid motion: three coincidences, as
    another spot is two; without the scale two. As many lengths were tried as can be told from each other.
    """
    others = sorted((m for m in range(len(off)) if m not in three), key=lambda m: off[m])
    unrelated = max(UNRELATED_PX, float(np.median(off[others])))
    best: tuple[float, tuple[int, ...]] = (float("inf"), tuple(three))
    if own > STEADY_PX:
        return best
    threes = log(tries * (1 + (free_px / max(own, NOISE_PX)) ** 2)) + (1.5 if rigid else 1.0) * chance(own, unrelated)
    for count in range(LEAST_FOUND - 3, len(others) + 1):
        worst = float(off[others[count - 1]])
        if worst > STEADY_PX:
            break
        alarms = threes + log(len(others) * comb(len(others), count)) + count * chance(worst, unrelated)
        best = min(best, (alarms, (*three, *others[:count])))
    return best


def chance(off_px: float, unrelated_px: float) -> float:
    """Return the logarithm of how often a spot is so near by chance, when half of them are within ``unrelated_px``."""
    return log(log(2) * (max(off_px, NOISE_PX) / unrelated_px) ** 2)


def _refuse_rivals(seen: Array, reference: int, chosen: Candidate, others: Sequence[Candidate]) -> None:
    for other in others:
        rival = common_motion(seen, other, reference)
        apart = np.median(rival.misfit_px(seen[:, chosen.members], reference), axis=0)
        if np.median(apart) > 2 * STEADY_PX:
            raise no_marks(
                f"two sets of spots, {len(chosen.members)} and {len(other.members)}, keep their places among "
                "themselves and contradict each other: one of them belongs to the specimen"
            )


def common_motion(seen: Array, chosen: Candidate, reference: int) -> Motion:
    """Return the motion of a set in every section: what most of its spots agree on (least median of squares)."""
    places = seen[:, chosen.members]
    right = as_complex(places @ np.linalg.inv(chosen.shape).T)
    motions = [by_two(right, pair, reference, chosen) for pair in combinations(range(right.shape[1]), 2)]
    typical = np.array([np.sort(m.misfit_px(places, reference), axis=1)[:, right.shape[1] // 2] for m in motions])
    best, every = typical.argmin(axis=0), np.arange(len(seen))
    turn, shift = (np.array([getattr(m, name) for m in motions])[best, every] for name in ("turn", "shift"))
    start = Motion(chosen.shape, turn, shift)
    return _averaged(right, reference, start.misfit_px(places, reference) <= AGREE_PX, start, rigid=chosen.rigid)


def by_two(right: Array, pair: tuple[int, int], reference: int, chosen: Candidate) -> Motion:
    """Return the motion that two spots of a set give."""
    first, second = (right[:, m] for m in pair)
    turn = (second - first) / (second - first)[reference]
    if chosen.rigid:
        turn = _unit(turn)
    middle = (first + second) / 2
    return Motion(chosen.shape, turn, middle - turn * middle[reference])


def _unit(turn: Array) -> Array:
    size = np.abs(turn)
    return np.divide(turn, size, out=np.full_like(turn, np.nan), where=size > 0)


def _averaged(right: Array, reference: int, near: Array, start: Motion, *, rigid: bool) -> Motion:
    """Return the motion by least squares over the spots that are near to a first one; that where they are too few."""
    count = np.maximum(near.sum(axis=1, keepdims=True), 1)
    here, there = np.where(near, right[reference], 0), np.where(near, right, 0)
    middle, target = (part.sum(axis=1, keepdims=True) / count for part in (here, there))
    spread = near * (here - middle)
    turn = (np.conj(spread) * (there - target)).sum(axis=1) / np.maximum((np.abs(spread) ** 2).sum(axis=1), 1e-9)
    if rigid:
        turn = _unit(turn)
    enough = near.sum(axis=1) >= 2
    turn = np.where(enough, turn, start.turn)
    return Motion(start.shape, turn, np.where(enough, target[:, 0] - turn * middle[:, 0], start.shift))
