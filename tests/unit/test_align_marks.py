"""Fiducial marks among features of the specimen: told by how they move, fitted by their rims, refused when in doubt."""

import cv2
import numpy as np
import pytest

from devices.errors import InputError
from processing.align_mark_search import find_marks
from processing.align_mark_sets import best_set, metric
from processing.align_spots import Spot, by_its_rim, fit_spot

SIDE, COUNT = 500, 24
MARKS = np.array([(75.0, 70.0), (420.0, 90.0), (85.0, 415.0), (410.0, 430.0)])
LOOKS = Spot(0, 0, -100, 3.3)


def disc(picture: np.ndarray, x: float, y: float, radius: float, value: float) -> None:
    yy, xx = np.mgrid[: picture.shape[0], : picture.shape[1]]
    cover = np.clip(radius + 0.5 - np.hypot(xx - x, yy - y), 0, 1)
    picture += (cover * (value - picture)).astype(np.float32)


@pytest.mark.parametrize("disturbed", ["nothing", "a cell under it", "dirt beside it", "a compressed section"])
def test_a_mark_is_fitted_to_a_tenth_of_a_pixel_whatever_touches_it(disturbed):
    rng = np.random.default_rng(3)
    picture = (160 + cv2.GaussianBlur(rng.normal(0, 30, (60, 60)), (0, 0), 2)).astype(np.float32)
    x, y = 30.3, 28.8
    if disturbed == "a cell under it":
        disc(picture, 36, 32, 7, 70)
    disc(picture, x, y, 5, 10)
    if disturbed == "dirt beside it":
        disc(picture, 23, 24, 4, 25)
    if disturbed == "a compressed section":
        picture = cv2.resize(picture, (48, 60), interpolation=cv2.INTER_AREA)
        x = (x + 0.5) * 0.8 - 0.5
    found = fit_spot(picture + rng.normal(0, 3, picture.shape).astype(np.float32), round(x), round(y), 3.5)
    assert found is not None
    assert np.hypot(found.x - x, found.y - y) < 0.1


def test_a_place_without_a_rim_is_no_spot():
    flat = np.full((40, 40), 80, np.float32)
    slope = np.tile(np.arange(40, dtype=np.float32), (40, 1))
    assert by_its_rim(flat, Spot(20, 20, -50, 3)) is None
    assert by_its_rim(slope, Spot(20, 20, -50, 3)) is None


def turned(angle_deg: float) -> np.ndarray:
    angle = np.radians(angle_deg)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def tracks(rng: np.random.Generator, marks: int, features: int, *, lean_px=0.5, twist_deg=0.0, compressed=0.0):
    """Places in the frame of the pictures: the specimen stays, its straight features wander, marks lean and twist."""
    squeeze, z = np.diag([1 - compressed, 1.0]), np.arange(COUNT)[:, None, None]
    middle = np.full(2, SIDE / 2)
    straight = np.stack([(MARKS[:marks] - middle) @ turned(twist_deg * k).T + (-lean_px * k, 0) for k in range(COUNT)])
    features_at = rng.random((features, 2)) * SIDE - middle + z * rng.normal(0, 0.35, (features, 2))
    seen = np.concatenate([straight, features_at], axis=1) @ squeeze.T + middle
    return seen + rng.normal(0, 0.05, seen.shape)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bent", [{}, {"twist_deg": 0.3}, {"twist_deg": 0.3, "compressed": 0.2}, {"lean_px": 3.0}])
def test_marks_are_told_from_straight_features_that_each_go_their_way(seed, bent):
    seen = tracks(np.random.default_rng(seed), 4, 14, **bent)
    if "twist_deg" not in bent:
        seen[16:, 2] += 6.0  # one is lost to something else on the way
    seen[3, :5] = np.nan
    found = best_set(seen, [LOOKS] * 18, 0)
    assert found.members == (0, 1, 2, 3)
    there = found.motion.foretold(seen[0, :4])
    assert np.linalg.norm(there - seen[:, :4], axis=2)[4:16].max() < 0.5


def test_the_lengths_in_which_marks_turn_are_those_before_the_reference_section_was_compressed():
    squeeze = np.array([[0.85, 0.02], [0.02, 0.97]])
    turns = np.array([squeeze @ turned(angle) @ np.linalg.inv(squeeze) for angle in np.linspace(0, 8, 12)])
    found = metric(turns, 1e-3)
    expected = squeeze @ squeeze.T
    assert found @ found.T == pytest.approx(expected / np.linalg.eigvalsh(expected)[1], abs=2e-3)
    assert metric(np.tile(np.eye(2), (12, 1, 1)), 1e-3) == pytest.approx(np.eye(2))


@pytest.mark.parametrize("seed", range(3))
def test_features_alone_are_refused(seed):
    with pytest.raises(InputError, match="0 fiducial marks were found"):
        best_set(tracks(np.random.default_rng(seed), 0, 20), [LOOKS] * 20, 0)


def test_two_sets_that_contradict_each_other_are_refused():
    rng = np.random.default_rng(2)
    seen = np.concatenate([tracks(rng, 4, 0, lean_px=0.5), tracks(rng, 4, 0, lean_px=-0.5) + 20], axis=1)
    with pytest.raises(InputError, match="contradict each other"):
        best_set(seen, [LOOKS] * 8, 0)


def test_dirt_of_the_camera_is_no_mark():
    """It stays in the frame of the camera while the sections, here all alike, were put down elsewhere each."""
    rng, side = np.random.default_rng(4), 200
    shifts = np.round(rng.uniform(-4, 4, (8, 2)))
    shifts[0] = 0
    sections, matrices = [], np.tile(np.eye(3), (8, 1, 1))
    for k, (x, y) in enumerate(shifts):
        picture = (128 + rng.normal(0, 2, (side, side))).astype(np.float32)
        for place in MARKS * (side / SIDE):
            disc(picture, place[0], place[1], 4, 20)
        matrices[k, :2, 2] = x, y
        sections.append(picture.astype(np.uint8))
    with pytest.raises(InputError, match="dirt of the camera"):
        find_marks(sections, matrices, 0)
