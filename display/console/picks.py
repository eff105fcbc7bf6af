"""Points picked in the review, and the lengths and angles along them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from processing.outputs import write_durably
from processing.picked import Picked
from processing.result_folder import csv_bytes

if TYPE_CHECKING:
    from pathlib import Path

    from display.console.drawn import Place

SHOWN_ANGLES = 3


@dataclass
class Picks:
    """One line of points, each (x, y, z) in ``unit``; z is a height in pictures of a surface, else a depth.

    Attributes
    ----------
    third : str
        What z is: ``height``, upwards, or ``depth``, from the front of the volume on.
    """

    points: list[Place] = field(default_factory=list)
    third: str = "height"
    unit: str = "µm"

    def add(self, place: Place, third: str, unit: str) -> None:
        """Add a point behind the others; one whose z is of another kind begins a new line."""
        if (third, unit) != (self.third, self.unit):
            self.points, self.third, self.unit = [], third, unit
        self.points.append(place)

    def forget(self) -> None:
        """Begin a new line."""
        self.points = []

    @property
    def length(self) -> float:
        """Length along all points."""
        return self._line.length_um((1.0, 1.0, 1.0))

    @property
    def angles_deg(self) -> list[float]:
        """Angle at each point between two others; 180 where the line goes straight on."""
        return self._line.angles_deg((1.0, 1.0, 1.0))

    @property
    def words(self) -> str:
        """What was measured, in words; empty without points."""
        if not self.points:
            return ""
        x, y, z = self.points[-1]
        words = [f"{len(self.points)} points, the last x {x:.2f} y {y:.2f} {self.third} {z:.2f} {self.unit}"]
        if len(self.points) > 1:
            words.append(f"{self.length:.2f} {self.unit} long")
        words += [f"{angle:.1f}°" for angle in self.angles_deg[-SHOWN_ANGLES:]]
        return ", ".join(words)

    def save(self, file: Path) -> None:
        """Write each point, the way to it along the line, and its angle, as a table."""
        steps = np.linalg.norm(np.diff(np.array(self.points), axis=0, prepend=[self.points[0]]), axis=1)
        angles = ["", *self.angles_deg, ""][: len(self.points)]
        rows = [
            (*point, float(way), angle) for point, way, angle in zip(self.points, steps.cumsum(), angles, strict=True)
        ]
        names = [f"{name}_{self._suffix}" for name in ("x", "y", self.third, "along")]
        write_durably(file, csv_bytes([*names, "angle_deg"], rows))

    @property
    def _suffix(self) -> str:
        return self.unit.replace("µ", "u")

    @property
    def _line(self) -> Picked:
        return Picked("line", np.array(self.points)[:, ::-1])
