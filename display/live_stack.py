"""The stack so far, from the newest frames of a ring: its volume, extended focus and range. Holds nobody up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from display.load import limits_of
from display.scene import Band, Volume
from processing.focus import FocusSweep, gather, gather_reach
from processing.pictures import RANGE_COLOURS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.frame import Frame
    from acquire.store import StoredRun

    Array = NDArray[Any]

FEWEST = 3  # planes with which something can be said about depth
ROOM = 32  # planes; doubled when it is full
MOST_BYTES = 2 * 1024**3


class LiveStack:
    """Planes as they come, each in its place; one that never came through stays dark.

    Attributes
    ----------
    count : int
        Number of the last plane so far, and one.
    newest : array (height, width), optional
        The frame that came last.
    """

    def __init__(self) -> None:
        self.count = 0
        self.newest: Array | None = None
        self._planes: Array | None = None
        self._z_um: dict[int, float] = {}
        self._section = -1
        self._in_order = True
        self._sweep: FocusSweep | None = None

    def take(self, frame: Frame) -> None:
        """Put a frame in its place; a new section, or another kind of frame, begins a new stack."""
        pixels = frame.pixels if frame.pixels.ndim == 2 else frame.pixels[..., 1]
        header = frame.header
        self.newest = pixels
        if header.plane < 0:
            return  # a live view between runs
        other = self._planes is None or self._planes.shape[1:] != pixels.shape or self._planes.dtype != pixels.dtype
        if other or header.section != self._section or (header.plane < self.count - 1 and header.plane == 0):
            self._begin(pixels, header.section)
        self._put(header.plane, pixels, header.z_um)

    def fill(self, run: StoredRun, most: int) -> int:
        """Put planes of this section that came too late through the ring from the run's folder; return how many."""
        run.refresh()
        late = [
            (slot, record.header)
            for slot, record in run.planes.items()
            if record.header.section == self._section and record.header.band == 0
        ]
        missing = [(slot, header) for slot, header in late if header.plane not in self._z_um][:most]
        for slot, header in missing:
            pixels = run.read(slot)
            self._put(header.plane, pixels if pixels.ndim == 2 else pixels[..., 1], header.z_um)
        return len(missing)

    def _put(self, plane: int, pixels: Array, z_um: float) -> None:
        if not self._grow(plane):
            return
        assert self._planes is not None
        self._planes[plane] = pixels
        self._in_order = self._in_order and plane >= self.count
        if self._in_order and self._sweep is not None:
            self._sweep.add(self._planes[plane])
        self._z_um[plane] = z_um
        self.count = max(self.count, plane + 1)

    def volume(self, pixel_um: float | None = None) -> Volume | None:
        """Return what is there of the stack as a volume, the plane at the highest z nearest; None before the first."""
        if self._planes is None or not self.count:
            return None
        values = np.ascontiguousarray(self._planes[: self.count])
        z_um = [self._z_um[k] for k in sorted(self._z_um)]
        rising = len(z_um) > 1 and z_um[-1] > z_um[0]
        step = abs(z_um[-1] - z_um[0]) / max(max(self._z_um) - min(self._z_um), 1) if len(z_um) > 1 else 0.0
        known = bool(pixel_um) and step > 0
        spacing = (step, pixel_um, pixel_um) if known and pixel_um else (1.0, 1.0, 1.0)
        shown = np.ascontiguousarray(values[::-1]) if rising else values
        return Volume((Band(shown, limits_of(shown)),), spacing, "µm" if known else "voxels")

    def focus(self) -> tuple[Array, Array] | None:
        """Return extended focus and range (µm, as read back) so far; None before there are enough planes."""
        if self._sweep is None or len(self._z_um) < FEWEST or self._planes is None:
            return None
        taken = sorted(self._z_um)
        planes = [self._planes[k] for k in taken]
        if not self._in_order:  # planes came late: the focus is measured anew, in their order
            self._sweep, self._in_order = FocusSweep(self._sweep.shape), True
            for plane in planes:
                self._sweep.add(plane)
        image = self._sweep.preview()
        z_um = [self._z_um[k] for k in taken]
        range_um = np.interp(image.range_, np.arange(len(z_um)), z_um).astype(np.float32)
        return gather(planes, image, gather_reach(image)), range_um

    def _begin(self, pixels: Array, section: int) -> None:
        self._planes = np.zeros((ROOM, *pixels.shape), pixels.dtype)
        self._z_um, self.count, self._section, self._in_order = {}, 0, section, True
        height, width = pixels.shape
        self._sweep = FocusSweep((height, width))

    def _grow(self, plane: int) -> bool:
        """Make room for a plane; False when memory would not do."""
        assert self._planes is not None
        while plane >= len(self._planes):
            if 2 * self._planes.nbytes > MOST_BYTES:
                return False
            self._planes = np.concatenate([self._planes, np.zeros_like(self._planes)])
        return True


def range_band(range_um: Array) -> Band:
    """Return a range image as a band of one plane, in colours; its bar is in µm."""
    low, high = float(range_um.min()), float(range_um.max())
    levels = np.rint((range_um - low) * (65535 / max(high - low, 1e-6))).astype(np.uint16)
    return Band(levels[None], (0, 65535), "range so far", "µm", RANGE_COLOURS, stand_for=(low, high))
