"""What the camera sees of a block: the face that feed and knife have really cut, with all that lies on or over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sim.feed import Stroke
from sim.optics import FARTHEST_UM, disc_transfer
from sim.sensor import Film

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from devices.values import CameraCaps
    from sim.block import Face
    from sim.feed import Microtome
    from sim.optics import Optics
    from sim.solid import Solid

MARGIN_PX = 48  # rendered beyond each edge of the frame, so that what is blurred into it belongs there
RESIN, RESIN_GRAIN = 0.5, 0.004
KNIFE = 0.02
BLOBS = (3, 8)
BLOB_SHARE = (0.03, 0.1)  # radius of debris, as a share of the frame's smaller side
CORNERS = 14


@dataclass(frozen=True)
class BlockSpecimen:
    """A solid seen by a frame of ``size_px`` pixels of ``pixel_um``: what it shows is known at every depth.

    Attributes
    ----------
    solid : Solid
        The tissue.
    focus_um : float
        Stage position at which the first face is in focus.
    """

    solid: Solid
    size_px: tuple[int, int]
    pixel_um: float
    focus_um: float = 0.0

    def picture(self, face: Face) -> np.ndarray:
        """Return the face as a perfect lens would show it, (height, width) float32 in 0 … 1."""
        return self.with_margin(face)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]

    def with_margin(self, face: Face) -> np.ndarray:
        """Return `picture` with a margin of `MARGIN_PX` around."""
        width, height = (side + 2 * MARGIN_PX for side in self.size_px)
        x_um, y_um = (offset_um - MARGIN_PX * self.pixel_um for offset_um in face.offset_um)
        if face.lost:
            grain = np.random.default_rng(face.section).normal(RESIN, RESIN_GRAIN, (height, width))
            return grain.astype(np.float32)
        picture = self.solid.face((width, height), self.pixel_um, face.depth_um, (x_um, y_um))
        if face.debris is not None:
            _litter(picture, min(self.size_px), np.random.default_rng((self.solid.seed, face.debris)))
        return picture

    def save_truth(self, path: Path) -> None:
        """Write ``truth.npz``: the seed, and all else that ``sim.solid.Solid(seed).face`` needs for any depth."""
        np.savez_compressed(
            path,
            kind="block",
            seed=self.solid.seed,
            pixel_um=self.pixel_um,
            size_px=self.size_px,
            focus_um=self.focus_um,
        )


class FaceSensor:
    """Takes pictures of the face of a block.

    The face is plane, so the blur is the same everywhere: the mean of the transfer functions along the path of the
    axis, exactly, in one transform.

    Parameters
    ----------
    specimen : BlockSpecimen
        The block.
    microtome : Microtome
        What has cut it.
    optics : Optics
        Through what it is seen.
    bit_depth, exposure_ms, seed, lamp
        As in `sim.sensor.Film`.
    """

    def __init__(
        self,
        specimen: BlockSpecimen,
        microtome: Microtome,
        optics: Optics,
        *,
        bit_depth: int,
        exposure_ms: float,
        seed: int,
        lamp: Callable[[], float] = lambda: 1.0,
    ) -> None:
        width, height = specimen.size_px
        self._specimen = specimen
        self._microtome = microtome
        self._optics = optics
        self._film = Film((height, width), bit_depth=bit_depth, exposure_ms=exposure_ms, seed=seed, lamp=lamp)
        self._face: Face | None = None
        self._spectrum: np.ndarray = np.empty(0)
        self._frequency: np.ndarray = np.empty(0)
        self._look_at(microtome.face)  # the first takes long: it compiles what paints a solid

    def caps(self) -> CameraCaps:
        """Return the shape and type of frames."""
        return self._film.caps()

    def expose(self, path_um: np.ndarray, exposure_ms: float, out: np.ndarray) -> None:
        """Fill ``out`` with the picture of one exposure; see `sim.sensor.Sensor.expose`."""
        knife = self._microtome.knife.state  # looked at first: a stroke that ended meanwhile has made a new face
        face = self._microtome.face
        self._look_at(face)
        distances_um = path_um - (self._specimen.focus_um + face.focus_um + self._microtome.height_um)
        light = np.fft.irfft2(self._spectrum * self._transfer(distances_um), s=self._padded_shape)
        rows, columns = self._film.light.shape
        self._film.light[:] = np.maximum(light[MARGIN_PX : MARGIN_PX + rows, MARGIN_PX : MARGIN_PX + columns], 0)
        if knife is not Stroke.CLEAR:
            self._film.light[rows // 2 :] = KNIFE
        self._film.develop(exposure_ms, out)

    @property
    def _padded_shape(self) -> tuple[int, int]:
        width, height = self._specimen.size_px
        return height + 2 * MARGIN_PX, width + 2 * MARGIN_PX

    def _look_at(self, face: Face) -> None:
        """Transform the face when it is another than before."""
        if face == self._face:
            return
        picture = self._specimen.with_margin(face)
        rows, columns = picture.shape
        self._spectrum = np.fft.rfft2(picture)
        self._frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None]).astype(np.float32)
        self._face = face

    def _transfer(self, distances_um: np.ndarray) -> np.ndarray:
        core = np.exp(-2 * (np.pi * self._optics.core_sigma_px * self._frequency) ** 2)
        within = np.minimum(np.abs(distances_um), FARTHEST_UM)
        discs = [disc_transfer(self._frequency * self._optics.disc_radius_px(distance_um)) for distance_um in within]
        return np.asarray(core * np.mean(discs, axis=0), np.float32)


def _litter(picture: np.ndarray, side_px: int, rng: np.random.Generator) -> None:
    """Let pieces of sections lie on a face: ragged, bright or dark, each with a texture of its own."""
    height, width = picture.shape
    for _ in range(int(rng.integers(*BLOBS))):
        middle = rng.uniform(MARGIN_PX, (width - MARGIN_PX, height - MARGIN_PX))
        angles = np.sort(rng.uniform(0, 2 * np.pi, CORNERS))
        reach = side_px * rng.uniform(*BLOB_SHARE) * rng.uniform(0.5, 1.2, CORNERS)
        corners = middle + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        cover = np.zeros_like(picture)
        cv2.fillPoly(cover, [np.round(corners).astype(np.int32)], 1.0)
        cover = cv2.GaussianBlur(cover, (0, 0), 1.0)
        mottled = cv2.GaussianBlur(rng.standard_normal(picture.shape, np.float32), (0, 0), 2.0)
        picture += cover * (np.float32(rng.choice([0.08, 0.95])) + np.float32(0.3) * mottled - picture)
