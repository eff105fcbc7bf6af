"""Each check of a section: finds what is there, on blocks its limits were not chosen on, and is quiet otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from faces import Faces
from sections_seen import BROKEN, TOP, Section, judge_series, taken

from acquire.measures import coherent_change, face_of, look_at, shared_change
from acquire.quality import Limits, Quality
from acquire.verdict import Finding


@pytest.mark.parametrize("thickness_um", [0.07, 0.5])
def test_every_fault_is_found_and_good_sections_pass(thickness_um):
    """A sample of what `benchmarks/bench_quality.py` counts; docs/quality.md has the rates of hundreds of sections."""
    result = judge_series(201, thickness_um, size_px=(128, 128))
    assert len(result.alarms) <= 1, result.alarms
    assert sum(not found for _, found in result.found) <= 1, result.found


def good_ones(faces: Faces, quality: Quality, rng: np.random.Generator, count: int = 5) -> Section:
    before = None
    for number in range(count):
        section = taken(faces, number, rng)
        assert quality(section, before).good
        before = section
    assert before is not None
    return before


def test_verdicts_name_planes_and_figures_for_the_journal():
    faces, quality, rng = Faces(203, 0.3), Quality(TOP), np.random.default_rng(1)
    before = good_ones(faces, quality, rng)
    verdict = quality(BROKEN["incomplete"](faces, 5, rng, before), before)
    assert verdict.finding is Finding.INCOMPLETE
    assert verdict.planes == (1,)
    assert "80 rows" in verdict.words
    assert {"mean", "sd", "sharpness", "saturated", "shared_change", "change", "debris_score"} <= set(verdict.figures)


def test_debris_that_is_accepted_does_not_condemn_what_comes_after():
    faces, quality, rng = Faces(204, 0.3), Quality(TOP), np.random.default_rng(1)
    before = good_ones(faces, quality, rng)
    littered = BROKEN["debris"](faces, 5, rng, before)
    assert quality(littered, before).finding is Finding.DEBRIS
    after = taken(faces, 6, rng)
    assert quality(after, littered).good
    assert quality(taken(faces, 7, rng), after).good


def test_debris_is_not_looked_for_when_nobody_wants_it():
    faces, rng = Faces(204, 0.3), np.random.default_rng(1)
    quality = Quality(TOP, debris=False)
    before = good_ones(faces, quality, rng)
    assert quality(BROKEN["debris"](faces, 5, rng, before), before).good


def test_a_run_that_goes_on_learns_from_the_section_on_disk():
    faces, rng = Faces(205, 0.3), np.random.default_rng(1)
    for name in ("lost specimen", "saturated", "duplicate", "light changed"):
        quality, before = Quality(TOP), taken(faces, 9, rng)
        assert quality(BROKEN[name](faces, 10, rng, before), before).finding is Finding(name)


def test_the_first_section_of_all_has_to_show_something():
    faces, rng = Faces(206, 0.3), np.random.default_rng(1)
    assert Quality(TOP)(taken(faces, 0, rng, lost=True), None).finding is Finding.LOST
    assert Quality(TOP)(taken(faces, 0, rng), None).good


def test_a_camera_that_gives_the_same_bits_for_another_section_is_told():
    faces, quality, rng = Faces(207, 0.3), Quality(TOP), np.random.default_rng(1)
    before = good_ones(faces, quality, rng)
    verdict = quality(Section(5, before.frames), before)
    assert verdict.finding is Finding.DUPLICATE
    assert verdict.planes == (0, 1, 2)


def test_limits_are_limits():
    faces, rng = Faces(208, 0.3), np.random.default_rng(1)
    strict, lax = Quality(TOP, Limits(debris_score=1e-3)), Quality(TOP, Limits(debris_score=1.0))
    first = taken(faces, 0, rng)
    for quality, finding in ((strict, Finding.DEBRIS), (lax, Finding.GOOD)):
        quality(first, None)
        assert quality(BROKEN["debris"](faces, 1, rng, first), first).finding is finding


def test_an_empty_section_is_left_to_others():
    assert Quality(TOP)(Section(0, []), None).good


def test_colour_frames_are_judged_like_grey_ones():
    faces, quality, rng = Faces(209, 0.3), Quality(TOP), np.random.default_rng(1)

    def coloured(section: Section) -> Section:
        return Section(section.section, [np.stack([frame] * 3, axis=2) for frame in section.frames])

    before = coloured(taken(faces, 0, rng))
    assert quality(before, None).good
    good = coloured(taken(faces, 1, rng))
    assert quality(good, before).good
    assert quality(coloured(taken(faces, 2, rng, light=3.0)), good).finding is Finding.SATURATED


def test_noise_alone_is_told_from_change():
    rng = np.random.default_rng(0)
    picture = rng.normal(1000, 100, (200, 200))
    first, second = (face_of(picture + rng.normal(0, 10, picture.shape)) for _ in range(2))
    assert shared_change(first, second) == pytest.approx(1 / (4 * np.pi * 4**2), rel=0.2)
    assert shared_change(first, first) == 0.0
    assert coherent_change(first, np.ones_like(first)) == 0.0  # against a face without contrast nothing can be said


def test_uniform_frames_have_no_sharpness_and_all_rows_empty():
    look = look_at(np.full((30, 40), 7, np.uint8), 255)
    assert (look.sharpness, look.energy, look.empty_rows) == (0.0, 0.0, 30)
    assert look_at(np.zeros((30, 40), np.uint8), 255).energy == 0.0
