"""What the review shows, and what keys, fields and the mouse make of it; without a window."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from display import controls
from display.console.drawn import FLAT, Line, Wish
from display.console.picks import Picks
from display.console.review import RESULTS, first_shown
from display.scene import Light

if TYPE_CHECKING:
    from display.controls import Shown
    from display.movie import Sweep
    from display.stereo import Mode

FRAMES = 120
LIVE, REVIEW = "Live", "Review"
VIEWS = (LIVE, "extended focus", "range", "relief", "orthogonal", "mip")


@dataclass
class Viewing:
    """A choice of data and of how it is looked at.

    Attributes
    ----------
    folder, typed : str
        The run, or other data, and what stands in its field.
    shown : Shown
        Kind of picture, viewer, stereo, plane.
    colours : str
        Colour table; empty for the data's own.
    points : list of (value, opacity)
        Opacity against value; empty for the usual.
    threshold : float or None
        Value of a surface.
    light : (float, float)
        Where the light comes from: azimuth and elevation in degrees.
    line : ((x, y), (x, y)) or None
        Two pixels of the picture between which is measured.
    picks : Picks
        Points picked in the data that is looked at.
    pixel : (x, y)
        One of the picture, typed, to be picked.
    size : (width, height)
        Of the picture wished for last, in pixels.
    """

    folder: str = ""
    typed: str = ""
    shown: Shown = field(default_factory=first_shown)
    colours: str = ""
    points: list[tuple[float, float]] = field(default_factory=list)
    threshold: float | None = None
    light: tuple[float, float] = (-35.0, 40.0)
    line: Line | None = None
    picks: Picks = field(default_factory=Picks)
    pixel: tuple[int, int] = (0, 0)
    size: tuple[int, int] = (0, 0)
    sweep: Sweep = "rotation"
    frames: int = FRAMES

    @property
    def flat(self) -> bool:
        """Whether the picture is seen from above, so that lengths in it are those of the specimen."""
        return self.shown.mode in FLAT[:2]

    def open(self, folder: str) -> None:
        """Look at other data, in planes where nothing was computed of it yet."""
        self.folder = self.typed = folder
        self.line, self.points, self.threshold = None, [], None
        self.picks.forget()
        if self.shown.mode in FLAT and not (Path(folder) / RESULTS / "range.tif").exists():
            self.kind("orthogonal")

    def kind(self, mode: str) -> None:
        """Show another kind of picture; a line belongs to the one it was drawn in."""
        self.line = self.line if mode == self.shown.mode else None
        self.shown = replace(self.shown, mode=mode)

    def eyes(self, *, mode: Mode | None = None, depth_deg: float | None = None, swap: bool | None = None) -> None:
        """Show it in another stereo, deeper by another angle between the eyes, or with the eyes exchanged."""
        new = {"mode": mode, "vergence_deg": depth_deg, "swap": swap}
        stereo = replace(self.shown.stereo, **{name: value for name, value in new.items() if value is not None})  # type: ignore[arg-type]
        self.shown = replace(self.shown, stereo=stereo)

    def press(self, key: str) -> None:
        """Do what a key does in every viewer."""
        self.shown = controls.press(self.shown, key)

    def nearer(self, steps: float) -> None:
        """Enlarge the picture."""
        self.shown = controls.wheel(self.shown, steps)

    def turned(self, azimuth_deg: float, elevation_deg: float) -> None:
        """Look from another side."""
        view = replace(self.shown.view, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)
        self.shown = replace(self.shown, view=view)

    def plane(self, number: int) -> None:
        """Show another plane of the stack."""
        self.shown = replace(self.shown, plane=float(number))

    def across(self) -> None:
        """Draw the line through the middle of a flat picture, or none."""
        width, height = self.size
        middle = ((0, height // 2), (max(width - 1, 0), height // 2))
        self.line = middle if self.line is None and self.flat else None

    def wish(self, size: tuple[int, int]) -> Wish:
        """Return what is to be drawn."""
        self.size = size
        light = Light(azimuth_deg=self.light[0], elevation_deg=self.light[1])
        return Wish(self.folder, self.shown, size, self.colours, tuple(self.points), self.threshold, light)
