"""Judges each section while it can still be mended: debris, frozen, broken, saturated, blurred, repeated, lost.

A `Quality` is an `acquire.verdict.Inspect`: the engine asks it about each section before the next is cut. What is
normal it learns from the sections it found good, so that stain, lamp and thickness need no parameters.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING

from acquire.measures import coherent_change, face_of, grey_range, look_at, out_of_range, shared_change
from acquire.verdict import Finding, Verdict, no_inspection

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from acquire.measures import Look
    from acquire.recipe import Recipe
    from acquire.verdict import Inspect, SectionPlanes
    from devices.values import CameraCaps

DEBRIS_SCORE = 0.35
STRANGE_AREA_PX = 4.0
LEAST_CHANGE, CHANGE_FACTOR = 1.3, 3.0
LEARNT_PAIRS = 3
REMEMBERED = 8
COMPARED = 3  # sections before, with which a change has to be seen
UNLEARNT = 10.0  # in place of the usual change before it is known: then only strange grey values speak for debris
LEAST_CONTRAST = 0.02


@dataclass(frozen=True)
class Limits:
    """Where good ends. The defaults were chosen on simulated blocks; docs/quality.md says how often they err.

    Attributes
    ----------
    saturated_share : float
        Share of pixels at the top of the scale.
    empty_rows : int
        Uniform rows at an end of the frame.
    contrast : float
        Least standard deviation, as a share of the usual one: below, nothing is there.
    light : (float, float)
        Least and greatest mean, as shares of the usual one.
    sharpness : float
        Least sharpness, as a share of the usual one.
    same_face : float
        Share of the difference to the section before that is coarse; below, it is noise and defocus: the same face.
    debris_score : float
        From 0, as the sections before, to 1; higher finds less.
    """

    saturated_share: float = 0.05
    empty_rows: int = 3
    contrast: float = 0.1
    light: tuple[float, float] = (0.6, 1.6)
    sharpness: float = 0.45
    same_face: float = 0.04
    debris_score: float = DEBRIS_SCORE


@dataclass(frozen=True)
class Seen:
    """What is remembered of a section: its sharpest plane."""

    section: int
    slot: int
    look: Look
    face: np.ndarray


@dataclass
class Usual:
    """What sections looked like lately.

    Attributes
    ----------
    looks : deque of Look
        Of those that were good.
    faces : dict of int to ndarray
        By section; also those with debris on them that were accepted: what comes after need not look like what was
        before them.
    changes : dict of int to float
        By section: how much it differed from the one before.
    """

    looks: deque[Look] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    faces: dict[int, np.ndarray] = field(default_factory=dict)
    changes: dict[int, float] = field(default_factory=dict)

    def of(self, name: str) -> float | None:
        """Return the median of a number of `Look`, None before the first section."""
        return median(getattr(look, name) for look in self.looks) if self.looks else None

    def grey_range(self, but: int) -> tuple[float, float]:
        """Return the darkest and the brightest that was seen in other sections, one odd section left out."""
        ranges = [grey_range(face) for section, face in self.faces.items() if section != but]
        odd = int(len(ranges) > 2)
        return sorted(low for low, _ in ranges)[odd], sorted(high for _, high in ranges)[-1 - odd]

    def remember(self, seen: Seen, change: float | None) -> None:
        """Keep a face, in place of an earlier one of its section; the oldest goes."""
        self.faces[seen.section] = seen.face
        if change is not None:
            self.changes[seen.section] = change
        for kept in (self.faces, self.changes):
            while len(kept) > REMEMBERED:
                del kept[min(kept)]


def quality_of(recipe: Recipe, caps: CameraCaps) -> Inspect:
    """Return what looks at the sections of a recipe."""
    if recipe.sections is None:
        return no_inspection
    table = recipe.sections.debris_check
    return Quality((1 << caps.bit_depth) - 1, Limits(debris_score=table.threshold), debris=table.enabled)


class Quality:
    """Call it with a section and the one before; it returns a `Verdict`.

    Parameters
    ----------
    top : int
        The largest grey value the camera can give.
    limits : Limits
        Where good ends.
    debris : bool
        Whether to look for debris.
    """

    def __init__(self, top: int, limits: Limits = Limits(), *, debris: bool = True) -> None:
        self._top = top
        self._limits = limits
        self._debris = debris
        self._usual = Usual()
        self._last: Seen | None = None

    def __call__(self, section: SectionPlanes, previous: SectionPlanes | None) -> Verdict:
        """Judge a section."""
        before = self._before(previous)
        if not section.slots:
            return Verdict()
        looks = {slot: look_at(section.pixels(slot), self._top) for slot in section.slots}
        seen = _sharpest(section, looks)
        figures = self._figures(seen, before)
        verdict = self._frames(section, previous, looks) or self._face(seen, before, figures)
        self._remember(seen, figures, verdict.finding)
        return Verdict(verdict.finding, verdict.words, verdict.planes, figures)

    def _before(self, previous: SectionPlanes | None) -> Seen | None:
        """Return what was seen of the section before; read from the disk when a run goes on."""
        if previous is None or not previous.slots:
            return None
        if self._last is not None and self._last.section == previous.section:
            return self._last
        self._last = _sharpest(previous, {slot: look_at(previous.pixels(slot), self._top) for slot in previous.slots})
        if not self._usual.looks:
            self._usual.looks.append(self._last.look)
            self._usual.remember(self._last, None)
        return self._last

    def _figures(self, seen: Seen, before: Seen | None) -> dict[str, float]:
        look = seen.look
        figures = {"mean": look.mean, "sd": look.sd, "sharpness": look.sharpness, "saturated": look.saturated}
        if before is not None and before.face.shape == seen.face.shape:
            figures["shared_change"] = shared_change(seen.face, before.face)
            figures |= self._debris_figures(seen) if self._debris else {}
        return {name: round(value, 5) for name, value in figures.items()}

    def _debris_figures(self, seen: Seen) -> dict[str, float]:
        faces = [face for section, face in sorted(self._usual.faces.items()) if section != seen.section]
        alike = [face for face in faces[-COMPARED:] if face.shape == seen.face.shape]
        if not alike:
            return {}
        change = min(coherent_change(seen.face, face) for face in alike)
        strange = out_of_range(seen.face, *self._usual.grey_range(but=seen.section))
        return {"change": change, "out_of_range": strange, "debris_score": self._score(seen.section, change, strange)}

    def _score(self, section: int, change: float, strange: float) -> float:
        """Return how much speaks for debris, from 0 to 1, `DEBRIS_SCORE` at the limit."""
        changes = [kept for of, kept in self._usual.changes.items() if of != section]
        usual = median(changes) if len(changes) >= LEARNT_PAIRS else UNLEARNT
        weight = max(strange / STRANGE_AREA_PX, change / max(LEAST_CHANGE, CHANGE_FACTOR * usual))
        return weight / (weight + 1 / DEBRIS_SCORE - 1)

    def _frames(self, section: SectionPlanes, previous: SectionPlanes | None, looks: dict[int, Look]) -> Verdict | None:
        """Judge planes one by one: what the camera or the lamp did."""
        burnt = [slot for slot in looks if looks[slot].saturated > self._limits.saturated_share]
        if burnt:
            share = max(looks[slot].saturated for slot in burnt)
            limit = self._limits.saturated_share
            return _of_planes(Finding.SATURATED, burnt, f"{share:.1%} of the pixels are saturated, limit {limit:.0%}")
        broken = [slot for slot in looks if looks[slot].empty_rows >= self._limits.empty_rows]
        if broken:
            rows = max(looks[slot].empty_rows for slot in broken)
            return _of_planes(Finding.INCOMPLETE, broken, f"{rows} rows of the frame were not filled")
        return _repeated(section, previous)

    def _face(self, seen: Seen, before: Seen | None, figures: dict[str, float]) -> Verdict:
        """Judge the face: whether it is there, sharp, new and clean."""
        for name, judge in (("sd", self._lost), ("mean", self._light), ("sharpness", self._blurred)):
            usual = self._usual.of(name)
            if usual and (verdict := judge(getattr(seen.look, name) / usual)) is not None:
                return verdict
        if before is None:
            return self._first(seen.look)
        if figures.get("shared_change", 1.0) < self._limits.same_face:
            words = f"it shows the face of section {before.section}: perhaps nothing was taken off"
            return Verdict(Finding.DUPLICATE, words)
        score = figures.get("debris_score", 0.0)
        if score > self._limits.debris_score:
            return Verdict(Finding.DEBRIS, f"debris score {score:.2f}, limit {self._limits.debris_score:g}")
        return Verdict()

    def _first(self, look: Look) -> Verdict:
        if look.sd >= LEAST_CONTRAST * look.mean:
            return Verdict()
        return Verdict(Finding.LOST, f"there is hardly anything to see: contrast is {look.sd / max(look.mean, 1):.1%}")

    def _lost(self, share: float) -> Verdict | None:
        if share >= self._limits.contrast:
            return None
        return Verdict(Finding.LOST, f"there is hardly anything to see: contrast is {share:.0%} of the usual")

    def _light(self, share: float) -> Verdict | None:
        low, high = self._limits.light
        if low <= share <= high:
            return None
        return Verdict(Finding.LIGHT, f"brightness is {share:.0%} of the usual, {low:.0%} … {high:.0%} is allowed")

    def _blurred(self, share: float) -> Verdict | None:
        if share >= self._limits.sharpness:
            return None
        return Verdict(Finding.BLURRED, f"sharpness is {share:.0%} of the usual, limit {self._limits.sharpness:.0%}")

    def _remember(self, seen: Seen, figures: dict[str, float], finding: Finding) -> None:
        self._last = seen
        if finding is Finding.GOOD:
            self._usual.looks.append(seen.look)
        if finding in (Finding.GOOD, Finding.DEBRIS):
            self._usual.remember(seen, figures.get("change"))


def _sharpest(section: SectionPlanes, looks: dict[int, Look]) -> Seen:
    best = max(looks, key=lambda slot: looks[slot].energy)
    return Seen(section.section, best, looks[best], face_of(section.pixels(best)))


def _repeated(section: SectionPlanes, previous: SectionPlanes | None) -> Verdict | None:
    """Tell planes that have the very bits of one taken before: noise makes that impossible for two exposures."""
    crcs = {slot: section.header(slot).crc32 for slot in section.slots}
    first_of = {crc: slot for slot, crc in reversed(crcs.items())}
    frozen = [slot for slot, crc in crcs.items() if crc and first_of[crc] != slot]
    if frozen:
        return _of_planes(Finding.FROZEN, frozen, "they have the very pixels of a plane taken before them")
    old = set() if previous is None else {previous.header(slot).crc32 for slot in previous.slots}
    again = [slot for slot, crc in crcs.items() if crc and crc in old]
    if again and previous is not None:
        return _of_planes(Finding.DUPLICATE, again, f"they have the very pixels of section {previous.section}")
    return None


def _of_planes(finding: Finding, slots: Sequence[int], words: str) -> Verdict:
    return Verdict(finding, f"plane{'s' if len(slots) > 1 else ''} {', '.join(map(str, slots))}: {words}", tuple(slots))
