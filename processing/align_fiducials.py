"""Fiducial marks: holes, threads or dots that run straight through the specimen, found, fitted, used as absolutes."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from devices.errors import InputError
from processing.align_models import applied, distance_px, fitted
from processing.align_pair import grey
from processing.align_solve import Row
from processing.readers import reading

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.align_models import Model
    from processing.registration import Planes

    Array = NDArray[Any]

COLUMNS = ("section", "mark", "x_px", "y_px")
KNOWN = "known"
FEWEST: dict[str, int] = {"translation": 1, "rigid": 2, "similarity": 2, "uniaxial": 3, "affine": 3}
MARK_SIGMAS_PX = (2.0, 3.0, 4.5, 7.0)
CANDIDATES = 40
STANDS_OUT = 4.5  # times the usual response of the spot filter
STEADY = 0.15  # variation of contrast and size of one mark from section to section
PRESENT = 0.8  # of the sections must show a mark
SEARCH_PX = 12  # around where a mark is expected
FIT_STEPS = 25
REACH_SIGMAS = 2.5  # of the window a spot is fitted in: at its rim the spot is gone
MARK_ERROR_PX = 0.1  # assumed of places from a table
EARLY = 5  # sections after which spots that are no marks are given up
MOST_MARKS = 16  # of which every three are tried
AGREE_PX = 0.7
LEAST_FOUND = 4  # any three agree
CONTRADICTS_PX = 2.0  # by which no specimen leans or twists from one section to the next
LEAST_AREA_PX = 1000.0  # twice that of the triangle three marks span


@dataclass(frozen=True)
class Marks:
    """Places of marks.

    Attributes
    ----------
    places : array (sections, marks, 2) float64
        As (x, y) in pixels; NaN where a mark was not seen.
    known : array (marks, 2) float64
        True places in the output; NaN where they are to be taken from the reference section.
    error_px : float
        Of one place.
    """

    places: Array
    known: Array
    error_px: float

    def targets(self, reference: int) -> Array:
        """Return where marks belong in the output: their known places, else those in the reference section."""
        return np.where(np.isfinite(self.known), self.known, self.places[reference])

    def rows(self, model: Model, reference: int) -> list[Row]:
        """Return the maps of all sections that show enough marks, as absolute rows for the solution.

        Raises
        ------
        InputError
            ``align-marks``: no section but the reference shows enough marks.
        """
        target, rows = self.targets(reference), []
        for k, seen in enumerate(self.places):
            both = np.isfinite(seen).all(axis=1) & np.isfinite(target).all(axis=1)
            if both.sum() >= FEWEST[model]:
                error = self.error_px * float(np.sqrt(FEWEST[model] / both.sum()))
                rows.append(Row(None, k, fitted(model, target[both], seen[both]), 1.0, error))
        if len(rows) < 2:
            raise InputError(
                f"fewer than two sections show {FEWEST[model]} marks, which {model} maps need.",
                fix=("give more marks", "take a model with fewer parameters: --model rigid"),
                code="align-marks",
            )
        return rows

    def words(self) -> str:
        """Return what was used."""
        sections, marks = np.nonzero(np.isfinite(self.places[:, :, 0]))
        return f"{np.unique(marks).size} marks, seen in {np.unique(sections).size} sections, fix the alignment."


def read_marks(path: Path, sections: Planes) -> Marks:
    """Read a table of marks: CSV with columns section, mark, x_px, y_px.

    Raises
    ------
    InputError
        ``align-marks``: a column is missing, a value is no number, or a section is not there.
    """
    with reading(path), path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    missing = [name for name in COLUMNS if not lines or name not in lines[0]]
    if missing:
        raise _bad_table(path, f"it has no column {', '.join(missing)}" if lines else "it is empty")
    names = sorted({line["mark"] for line in lines})
    places = np.full((len(sections) + 1, len(names), 2), np.nan)
    for number, line in enumerate(lines, start=2):
        row, place = _place(path, number, line, len(sections))
        places[row, names.index(line["mark"])] = place
    return Marks(places[:-1], places[-1], MARK_ERROR_PX)


def _place(path: Path, number: int, line: dict[str, str], count: int) -> tuple[int, tuple[float, float]]:
    try:
        section = count if line["section"] == KNOWN else int(line["section"])
        place = float(line["x_px"]), float(line["y_px"])
    except (TypeError, ValueError):
        raise _bad_table(path, f"line {number} has a value that is no number") from None
    if not 0 <= section <= count or (section == count and line["section"] != KNOWN) or not np.isfinite(place).all():
        raise _bad_table(path, f"line {number} names section {line['section']}; there are 0 … {count - 1}")
    return section, place


def _bad_table(path: Path, why: str) -> InputError:
    return InputError(
        f"{path} is no table of marks: {why}.",
        fix=f"give CSV with the columns {', '.join(COLUMNS)}; sections are counted from 0, or called {KNOWN}.",
        code="align-marks",
    )


@dataclass(frozen=True)
class Spot:
    """A round mark: place in pixels, contrast against its surroundings (negative when dark), radius (σ), misfit."""

    x: float
    y: float
    contrast: float
    sigma: float
    misfit: float


def fit_spot(picture: Array, x: float, y: float, sigma: float) -> Spot | None:
    """Fit a round spot on an inclined ground by Gauss-Newton; None when it runs away.

    Parameters
    ----------
    picture : array (h, w) float32
        Grey.
    x, y, sigma : float
        Roughly where it is and how large, in pixels.
    """
    reach = int(np.ceil(REACH_SIGMAS * sigma))
    x0, y0 = round(x) - reach, round(y) - reach
    part = picture[max(y0, 0) : y0 + 2 * reach + 1, max(x0, 0) : x0 + 2 * reach + 1]
    if part.shape != (2 * reach + 1, 2 * reach + 1):
        return None
    yy, xx = np.mgrid[y0 : y0 + 2 * reach + 1, x0 : x0 + 2 * reach + 1].astype(np.float64)
    found = np.array([x, y, sigma, 0.0, 0.0])
    for _ in range(FIT_STEPS):
        step, linear, misfit = _spot_step(part, xx, yy, found)
        found[:3] += np.clip(step, -1, 1)
        if np.abs(found[:2] - (x, y)).max() > reach or not 0.5 < found[2] < 2 * sigma:
            return None
        if np.abs(step).max() < 1e-4:
            break
    return Spot(float(found[0]), float(found[1]), float(linear[0]), float(found[2]), misfit)


def _spot_step(part: Array, xx: Array, yy: Array, found: Array) -> tuple[Array, Array, float]:
    """Contrast and ground by least squares, then one step of place and size (variable projection)."""
    dx, dy, sigma = xx - found[0], yy - found[1], found[2]
    shape = np.exp(-(((dx**2 + dy**2) / (2 * sigma**2)) ** 2))  # a disc with a soft rim: marks are holes
    ground = np.stack([shape.ravel(), np.ones(shape.size), dx.ravel(), dy.ravel()], axis=1)
    linear, *_ = np.linalg.lstsq(ground, part.ravel(), rcond=None)
    rest = part - (ground @ linear).reshape(part.shape)
    squared = (dx**2 + dy**2) / (2 * sigma**2)
    slope = linear[0] * shape * 2 * squared
    columns = np.stack([slope * dx / sigma**2, slope * dy / sigma**2, slope * 2 * squared / sigma], axis=-1)
    columns = np.column_stack([columns.reshape(-1, 3), ground])
    step = np.linalg.lstsq(columns, rest.ravel(), rcond=1e-9)[0][:3]
    return step, linear, float(np.sqrt((rest**2).mean()) / max(abs(linear[0]), 1e-9))


def spots(picture: Array) -> list[Spot]:
    """Find round spots that stand out from everything else in a grey picture, strongest first."""
    found: list[tuple[float, Spot]] = []
    for sigma in MARK_SIGMAS_PX:
        response = cv2.GaussianBlur(picture, (0, 0), sigma) - cv2.GaussianBlur(picture, (0, 0), 1.6 * sigma)
        strength = np.abs(response)
        usual = 1.4826 * float(np.median(strength)) + 1e-9
        peaks = (strength == cv2.dilate(strength, np.ones((9, 9)))) & (strength > STANDS_OUT * usual)
        for y, x in np.argwhere(peaks):
            if (spot := fit_spot(picture, float(x), float(y), 1.3 * sigma)) is not None:
                found.append((abs(spot.contrast), spot))
    return _separate(sorted(found, key=lambda pair: -pair[0]))


def _separate(found: Sequence[tuple[float, Spot]]) -> list[Spot]:
    kept: list[Spot] = []
    for _, spot in found:
        if all(np.hypot(spot.x - k.x, spot.y - k.y) > 2 * k.sigma for k in kept):
            kept.append(spot)
    return kept[:CANDIDATES]


def find_marks(sections: Planes, matrices: Array, reference: int) -> Marks:
    """Find marks that look the same in all sections and keep their places to each other.

    Spots of the reference section are followed from section to section, so that a specimen that leans or twists does
    not lead away from them. Of the steady ones the largest set is taken that affine maps of the sections bring to
    agreement: features of the specimen that happen to be round wander on their own.

    Parameters
    ----------
    sections : sequence of array
        Grey or RGB.
    matrices : array (sections, 3, 3)
        From the reference section to each section; from one to the next right to `SEARCH_PX`.
    reference : int
        Where marks are looked for first.

    Raises
    ------
    InputError
        ``align-marks``: fewer than four such marks, as any three agree; or they contradict the pictures.
    """
    candidates = spots(grey(sections[reference]))
    rows: list[list[Spot | None]] = [[None] * len(candidates) for _ in range(len(sections))]
    rows[reference] = list(candidates)
    alive = list(range(len(candidates)))
    for walk in (range(reference + 1, len(sections)), range(reference - 1, -1, -1)):
        alive = _follow(sections, matrices, rows, alive, walk)
    steady = [m for m in alive if _is_mark([row[m] for row in rows])]
    places = np.array([[(s.x, s.y) if (s := row[m]) else (np.nan, np.nan) for m in steady] for row in rows])
    kept = consistent(places.reshape(len(sections), len(steady), 2), reference)
    if len(kept) < LEAST_FOUND:
        raise InputError(
            f"{len(kept)} fiducial marks were found, of {len(candidates)} spots in section {reference}; "
            f"{LEAST_FOUND} are needed.",
            why="A mark is a round spot of steady size and contrast, seen in four of five sections and more; marks "
            "keep their places to each other.",
            fix=("give their places: --fiducials marks.csv", "leave out --fiducials"),
            code="align-marks",
        )
    _check_agreement(places[:, kept], matrices, reference, sections[reference].shape)
    return Marks(places[:, kept], np.full((len(kept), 2), np.nan), MARK_ERROR_PX)


def _check_agreement(places: Array, matrices: Array, reference: int, shape: tuple[int, ...]) -> None:
    """Refuse marks whose steps from section to section are not at all those of the pictures."""
    own = {}
    for k, seen in enumerate(places):
        both = np.isfinite(seen).all(axis=1) & np.isfinite(places[reference]).all(axis=1)
        if both.sum() >= FEWEST["affine"]:
            own[k] = fitted("affine", places[reference][both], seen[both])
    off = [
        distance_px(own[k] @ np.linalg.inv(own[k - 1]), matrices[k] @ np.linalg.inv(matrices[k - 1]), shape)
        for k in own
        if k - 1 in own
    ]
    typical = float(np.median(off)) if off else 0.0
    if typical > CONTRADICTS_PX:
        raise InputError(
            f"the {places.shape[1]} round spots that were followed are no fiducial marks: they contradict the pictures "
            f"by {typical:.1f} px from section to section.",
            fix=("give places of marks: --fiducials marks.csv", "leave out --fiducials"),
            code="align-marks",
        )


def _follow(
    sections: Planes, matrices: Array, rows: list[list[Spot | None]], alive: list[int], walk: range
) -> list[int]:
    """Follow marks along a walk away from the reference; returns those that are still worth it."""
    last = {m: rows[walk.start - walk.step][m] for m in alive}
    for done, k in enumerate(walk, start=1):
        picture, step = grey(sections[k]), matrices[k] @ np.linalg.inv(matrices[k - walk.step])
        for m in alive:
            spot = last[m]
            assert spot is not None
            found = rows[k][m] = _followed(picture, spot, step)
            x, y = applied(step, np.array([[spot.x, spot.y]]))[0]
            last[m] = found or replace(spot, x=float(x), y=float(y))
        if done == EARLY:
            first = walk.start - walk.step
            alive = [m for m in alive if _is_mark([rows[first + walk.step * n][m] for n in range(done + 1)])]
    return alive


def consistent(places: Array, reference: int) -> list[int]:
    """Return the largest set of marks, (sections, marks, 2), that affine maps of each section bring to agreement.

    Every three marks fix the map of each section; others that agree with them within `AGREE_PX` (median of all
    sections) are counted, the better the more.
    """
    count = places.shape[1]
    if count < FEWEST["affine"]:
        return []
    best: tuple[float, list[int]] = (0.0, [])
    known = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=2)
    for three in combinations(range(min(count, MOST_MARKS)), 3):
        corner = known[reference, list(three)]
        if abs(np.linalg.det(corner)) < LEAST_AREA_PX:
            continue
        maps = np.einsum("ij,njk->nik", np.linalg.inv(corner), places[:, list(three)])
        off = np.linalg.norm(known[reference] @ maps - places, axis=2)
        typical = np.nanmedian(np.where(np.isfinite(off), off, np.nan), axis=0)
        inside = [m for m in range(count) if typical[m] <= AGREE_PX]
        best = max(best, (float((1 - (typical[inside] / AGREE_PX) ** 2).sum()), inside))
    return best[1]


def _followed(picture: Array, mark: Spot, step: Array) -> Spot | None:
    """Find a mark near its expected place: the extreme of the blurred picture, then the fit."""
    expected = applied(step, np.array([[mark.x, mark.y]]))[0]
    x0, y0 = (round(float(c)) - SEARCH_PX for c in expected)
    side = 2 * SEARCH_PX + 1
    if min(x0, y0) < 0 or x0 + side > picture.shape[1] or y0 + side > picture.shape[0]:
        return None
    reach = int(np.ceil(2 * mark.sigma))
    part = picture[max(y0 - reach, 0) : y0 + side + reach, max(x0 - reach, 0) : x0 + side + reach]
    blurred = cv2.GaussianBlur(part, (0, 0), mark.sigma / 1.5)[min(reach, y0) :, min(reach, x0) :][:side, :side]
    y, x = np.unravel_index(int((blurred * np.sign(mark.contrast)).argmax()), blurred.shape)
    return fit_spot(picture, float(x0 + x), float(y0 + y), mark.sigma)


def _is_mark(seen: Sequence[Spot | None]) -> bool:
    there = [spot for spot in seen if spot is not None]
    if len(there) < PRESENT * len(seen):
        return False
    contrast, sigma = (np.array([getattr(s, name) for s in there]) for name in ("contrast", "sigma"))
    return all(float(np.median(np.abs(v / np.median(v) - 1))) < STEADY for v in (contrast, sigma))
