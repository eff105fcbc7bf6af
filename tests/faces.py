"""Frames of the simulated block, section after section, with what shall lie on them: for those who judge pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from sim.block import Face
from sim.face_sensor import BlockSpecimen, FaceSensor
from sim.feed import Stroke
from sim.optics import Optics
from sim.solid import Solid

PIXEL_UM = 0.1725
BIT_DEPTH = 12
EXPOSURE_MS = 10.0


@dataclass
class Faces:
    """The block of a seed, cut into sections of one thickness, seen by a small camera."""

    seed: int
    thickness_um: float
    size_px: tuple[int, int] = (160, 160)

    def __post_init__(self) -> None:
        self.light = 1.0
        self._microtome = SimpleNamespace(knife=SimpleNamespace(state=Stroke.CLEAR), face=Face(), height_um=0.0)
        self.specimen = BlockSpecimen(Solid(self.seed), self.size_px, PIXEL_UM)
        self._sensor = FaceSensor(
            self.specimen,
            self._microtome,
            Optics(0.45, 1.0, 0.55, PIXEL_UM),
            bit_depth=BIT_DEPTH,
            exposure_ms=EXPOSURE_MS,
            seed=self.seed,
            lamp=lambda: self.light,
        )

    def shot(self, section: int, *, z_um: float = 0.0, light: float = 1.0, **face: object) -> np.ndarray:
        """One frame of a section; more of its `Face` by name."""
        self._microtome.face = replace(Face(section * self.thickness_um, section), **face)
        self.light = light
        picture = np.empty(self.size_px[::-1], np.uint16)
        self._sensor.expose(np.array([z_um]), EXPOSURE_MS, picture)
        return picture
