"""A picture of the review, what it shows, and where in the specimen its pixels are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from display.modes import find_mode
from display.relief import Relief
from display.relief_plots import profile
from display.resolve import camera, fitting_pixel_um, resolve
from display.scene import Light, Scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.controls import Shown
    from display.relief_plots import Profile
    from display.resolve import Drawing
    from processing.heights import Heights

    Picture = NDArray[np.uint8]

CUTS = ("slice", "oblique")
FLAT = ("extended focus", "range", "relief")
ROUNDING = 1e-9
Line = tuple[tuple[int, int], tuple[int, int]]
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Wish:
    """What is to be drawn.

    Attributes
    ----------
    folder : str
        The run, or anything else `display.load.load_volume` reads.
    shown : Shown
        Kind of picture, viewer, stereo, plane.
    size : (width, height)
        In pixels.
    colours : str
        Colour table; empty for the data's own.
    points : tuple of (value, opacity)
        Opacity against value, for translucent volumes; empty for the usual.
    threshold : float or None
        Value of a surface.
    """

    folder: str
    shown: Shown
    size: tuple[int, int]
    colours: str = ""
    points: tuple[tuple[float, float], ...] = ()
    threshold: float | None = None
    light: Light = field(default_factory=Light)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture, what it is of, and in what scene, so that places in it can be measured."""

    wish: Wish
    picture: Picture
    scene: Scene
    heights: Heights | None = None

    def place_um(self, pixel: tuple[float, float]) -> Place | None:
        """Return where in the specimen a pixel (x, y) of the picture is; None beside the data or where it is not known.

        x and y from the corner of the data; the third is the height there in pictures of a surface, in slices
        its depth from the front of the volume on. In other pictures a pixel is no place.
        """
        third = self.third
        if not third:
            return None
        [drawing], size_um = resolve(self.scene, self.wish.size), self._size_um
        seen, (normal, distance_um) = drawing.camera, self._plane(drawing)
        from_um = seen.corner + pixel[0] * seen.right + pixel[1] * seen.down
        way = seen.along if seen.eye is None else from_um - seen.eye
        place = from_um + (distance_um - normal @ from_um) / (normal @ way) * way
        if np.any(np.abs(place) > size_um * (0.5 + ROUNDING)):
            return None
        place = np.clip(place + size_um / 2, 0, size_um)
        depth = float(place[2]) if third == "depth" else self._height_at(place[:2] / size_um[:2])
        return None if np.isnan(depth) else (float(place[0]), float(place[1]), depth)

    def pixel_of(self, place: Place) -> tuple[float, float]:
        """Return where a place is seen, (x, y); its height does not move it in a picture from above."""
        size_um = self._size_um
        third_um = place[2] if self.third == "depth" else size_um[2] / 2
        middle = np.array([*place[:2], third_um]) - size_um / 2
        x, y, _ = camera(self.scene, self.wish.size).project(middle[None])[0]
        return float(x), float(y)

    @property
    def third(self) -> str:
        """What the third number of a place is: ``height``, ``depth``, or nothing where a pixel is no place."""
        mode = self.wish.shown.mode
        if self.scene.stereo.mode != "mono":  # each eye sees it elsewhere
            return ""
        if mode in FLAT[:2]:
            return "" if self.heights is None else "height"
        return "depth" if mode in CUTS else ""

    @property
    def unit(self) -> str:
        """Of places."""
        return str(self.scene.layers[0].data.unit) if self.heights is None else self.heights.unit

    def _plane(self, drawing: Drawing) -> tuple[NDArray[np.float64], float]:
        """Return the plane that is seen, n · p = d in µm from the middle of the data."""
        if self.third == "height":
            return np.array([0.0, 0.0, 1.0]), 0.0
        mode: Any = find_mode(self.wish.shown.mode)
        plane = mode.planes(drawing)[0]
        return plane[:3], float(plane[3])

    @property
    def _size_um(self) -> NDArray[np.float64]:
        return np.asarray(self.scene.size_um, np.float64)

    def _height_at(self, shares: NDArray[np.float64]) -> float:
        """Return the height at a place given as shares (x, y) of the whole; NaN where none was found."""
        assert self.heights is not None
        values = self.heights.values
        row, column = (min(int(share * n), n - 1) for share, n in zip(shares[::-1], values.shape, strict=True))
        return float(values[row, column])

    @property
    def pixel_um(self) -> float:
        """Size of a pixel of the picture in the screen plane."""
        return fitting_pixel_um(self.scene, self.wish.size)

    @property
    def _corner_px(self) -> NDArray[np.float64]:
        """Where the corner of the data lies in a flat picture, (x, y) in pixels."""
        middle_um = self._most_um / 2 + np.array(self.scene.view.centre_um[:2])
        return np.asarray(np.array(self.wish.size) / 2 - middle_um / self.pixel_um)

    @property
    def _most_um(self) -> NDArray[np.float64]:
        """Width and height of the data."""
        return np.asarray(self.scene.layers[0].data.size_um[:2], np.float64)

    def ends_um(self, line: Line) -> NDArray[np.float64]:
        """Return the ends of a line between two pixels (x, y), (2, 2), as far as the data go, from their corner on."""
        return np.asarray(np.clip((np.array(line) - self._corner_px) * self.pixel_um, 0, self._most_um))

    def ends_px(self, line: Line) -> NDArray[np.float64]:
        """Return these ends in the picture, (2, 2)."""
        return np.asarray(self._corner_px + self.ends_um(line) / self.pixel_um)

    def length_um(self, line: Line) -> float:
        """Return the length of a line between two pixels (x, y) of a flat picture, as far as the data go."""
        return float(np.hypot(*np.diff(self.ends_um(line), axis=0)[0]))

    def profile(self, line: Line) -> Profile | None:
        """Return heights along a line between two pixels (x, y) of a range picture; None in other pictures."""
        data = self.scene.layers[0].data
        if self.wish.shown.mode != "range" or not isinstance(data, Relief):
            return None
        (x0, y0), (x1, y1) = self.ends_um(line).tolist()
        return profile(data.heights, ((x0, y0), (x1, y1)))
