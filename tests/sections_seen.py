"""Sections as `acquire.verdict.SectionPlanes` gives them, and series of them with something wrong now and then."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np
from faces import BIT_DEPTH, Faces

from acquire.frame import FrameHeader
from acquire.quality import Quality
from acquire.verdict import Finding

TOP = (1 << BIT_DEPTH) - 1
STACK_UM = (-2.0, 0.0, 2.0)


@dataclass
class Section:
    """The planes of one section, in memory."""

    section: int
    frames: list[np.ndarray]

    @property
    def slots(self) -> tuple[int, ...]:
        return tuple(range(len(self.frames)))

    def header(self, slot: int) -> FrameHeader:
        crc = zlib.crc32(np.ascontiguousarray(self.frames[slot]).data)
        return FrameHeader(slot, 0.0, 0.0, 1.0, section=self.section, crc32=crc)

    def pixels(self, slot: int) -> np.ndarray:
        return self.frames[slot]


def taken(faces: Faces, section: int, rng: np.random.Generator, **how: object) -> Section:
    """A section as it should be, under a lamp that flickers by 2 %; or with something else about it."""
    light = float(how.pop("light", 1.0)) * (1 + 0.02 * rng.normal())
    off_um = float(how.pop("z_um", 0.0))
    where = int(how.pop("at", section))
    return Section(section, [faces.shot(where, z_um=z + off_um, light=light, **how) for z in STACK_UM])


def stuck(section: Section) -> Section:
    return Section(section.section, [*section.frames[:2], section.frames[1]])


def half(section: Section) -> Section:
    frame = section.frames[1].copy()
    frame[len(frame) // 2 :] = 0
    return Section(section.section, [section.frames[0], frame, section.frames[2]])


Spoil = "Callable[[Faces, int, np.random.Generator, Section], Section]"
BROKEN: dict[str, Spoil] = {
    "debris": lambda faces, n, rng, before: taken(faces, n, rng, debris=n),
    "frozen": lambda faces, n, rng, before: stuck(taken(faces, n, rng)),
    "incomplete": lambda faces, n, rng, before: half(taken(faces, n, rng)),
    "saturated": lambda faces, n, rng, before: taken(faces, n, rng, light=2.5),
    "blurred": lambda faces, n, rng, before: taken(faces, n, rng, z_um=6.0),
    "duplicate": lambda faces, n, rng, before: taken(faces, n, rng, at=n - 1, z_um=-faces.thickness_um),
    "lost specimen": lambda faces, n, rng, before: taken(faces, n, rng, lost=True),
    "light changed": lambda faces, n, rng, before: taken(faces, n, rng, light=0.4),
}


@dataclass
class Judged:
    """What became of a series: good sections, alarms at them, and for each fault whether it was found."""

    good: int = 0
    alarms: list[str] = field(default_factory=list)
    found: list[tuple[str, bool]] = field(default_factory=list)


def judge_series(seed: int, thickness_um: float, *, size_px: tuple[int, int] = (160, 160)) -> Judged:
    """Judge a series in which, after a few good ones, each second section is spoilt first and good when taken again."""
    rng = np.random.default_rng(seed)
    faces, quality, result = Faces(seed, thickness_um, size_px), Quality(TOP), Judged()
    names = list(rng.permutation(list(BROKEN)))
    before: Section | None = None
    for number in range(6 + 2 * len(names)):
        if number >= 6 and number % 2 == 0:
            name = names.pop()
            verdict = quality(BROKEN[name](faces, number, rng, before), before)
            result.found.append((name, verdict.finding is Finding(name)))
        section = taken(faces, number, rng)
        verdict = quality(section, before)
        result.good += 1
        if not verdict.good:
            result.alarms.append(f"section {number}: {verdict.finding}, {verdict.words}")
        before = section
    return result
