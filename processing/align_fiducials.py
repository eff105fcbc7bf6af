"""Fiducial marks: holes, threads or dots that run straight through the specimen, used as absolutes."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.align_models import fitted
from processing.align_solve import Row
from processing.readers import reading

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from processing.align_models import Model
    from processing.registration import Planes

    Array = NDArray[Any]

COLUMNS = ("section", "mark", "x_px", "y_px")
KNOWN = "known"
FEWEST: dict[str, int] = {"translation": 1, "rigid": 2, "similarity": 2, "uniaxial": 3, "affine": 3}
MARK_ERROR_PX = 0.1  # assumed of places from a table


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
