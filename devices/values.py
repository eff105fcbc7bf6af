"""Values shared by all devices. Frozen; lengths are in µm, times of frames in monotonic nanoseconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from devices.errors import LimitError

if TYPE_CHECKING:
    import numpy as np

TriggerKind = Literal["software", "free-run", "external"]

NM_PER_UM = 1000


def to_nm(z_um: float) -> int:
    """Return a length in whole nanometres, the unit in which plans count."""
    return round(z_um * NM_PER_UM)


def to_um(z_nm: int) -> float:
    """Return a length of whole nanometres in µm."""
    return z_nm / NM_PER_UM


@dataclass(frozen=True)
class Limits:
    """Soft limits of an axis in µm, ends included."""

    min_um: float
    max_um: float

    def check(self, z_um: float, axis: str = "Z") -> None:
        """Raise `LimitError` unless ``min_um <= z_um <= max_um``; a NaN is outside."""
        if not math.isfinite(z_um) or not self.min_um <= z_um <= self.max_um:
            raise LimitError(
                f"{axis}: {z_um:+.2f} µm is outside the soft limits {self.min_um:g} … {self.max_um:g} µm. "
                "Nothing moved.",
                fix="choose a position inside the limits, or change limits in the instrument file.",
            )


@dataclass(frozen=True)
class Roi:
    """A part of a camera's frame in pixels: its upper left corner from the frame's, and its size."""

    x: int
    y: int
    width: int
    height: int

    def check(self, caps: CameraCaps) -> None:
        """Raise `LimitError` unless it is a part of the frames ``caps`` speaks of."""
        across = 0 <= self.x < self.x + self.width <= caps.width
        down = 0 <= self.y < self.y + self.height <= caps.height
        if not (across and down):
            raise LimitError(
                f"camera: {self.width} x {self.height} px at ({self.x}, {self.y}) is no part of a frame of "
                f"{caps.width} x {caps.height} px; it stays as it is.",
                fix="choose a part inside the frame.",
            )

    def of(self, pixels: np.ndarray) -> np.ndarray:
        """Return this part of a frame as a view."""
        return pixels[self.y : self.y + self.height, self.x : self.x + self.width]


@dataclass(frozen=True)
class CameraCaps:
    """What a camera delivers as it is configured now.

    Attributes
    ----------
    height, width : int
        Size of a frame in pixels.
    bands : int
        1 for grey frames of shape (height, width), 3 for RGB frames of shape (height, width, 3).
    dtype : str
        ``"uint8"`` or ``"uint16"``.
    bit_depth : int
        Significant bits of a pixel.
    timed : bool
        Whether `FrameStamp.exposure_start_ns` is measured (True) or must be bounded from the arrival (False).
    readout_ms : float
        Longest time from the end of an exposure to the arrival of its frame.
    buffered_frames : int
        Frames the driver may hold back and deliver late (UVC: about 4; triggered cameras: 0).
    triggers : frozenset of str
        ``"software"``: a frame upon each `Camera.trigger`; ``"free-run"``: frames as they come; ``"external"``: upon
        a pulse at its input. A camera with ``"free-run"`` alone ignores triggers.
    numbered : bool
        Whether `FrameStamp.hw_id` counts, so that a lost frame shows.
    roi_in_camera : bool
        A part of the frame is cut out by the camera, which then is faster, or else by the driver.
    bit_depths : tuple of int
        Depths the camera can be set to; empty when it has only the one it is at.
    """

    name: str
    height: int
    width: int
    bands: int
    dtype: str
    bit_depth: int
    timed: bool
    readout_ms: float = 0.0
    buffered_frames: int = 0
    triggers: frozenset[TriggerKind] = frozenset({"software"})
    numbered: bool = False
    roi_in_camera: bool = False
    bit_depths: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one frame: (height, width) or (height, width, bands)."""
        return (self.height, self.width) if self.bands == 1 else (self.height, self.width, self.bands)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return self.height * self.width * self.bands * (1 if self.dtype == "uint8" else 2)


@dataclass(frozen=True)
class FrameStamp:
    """When a frame was exposed and by whom, all times CLOCK_MONOTONIC nanoseconds.

    Attributes
    ----------
    hw_id : int or None
        The camera's own frame counter; a gap in it is a frame lost by the camera.
    exposure_start_ns, exposure_end_ns : int or None
        Measured by the camera, or None when it cannot tell (`CameraCaps.timed` is False).
    arrival_ns : int
        When the driver received the frame.
    """

    arrival_ns: int
    hw_id: int | None = None
    exposure_start_ns: int | None = None
    exposure_end_ns: int | None = None


@dataclass(frozen=True)
class StageSequence:
    """Where an axis will stand while its sequence is stepped through.

    Attributes
    ----------
    positions_um : tuple of float
        Where it is while frame 0, 1, … is exposed, and at the end where it rests after the last frame.
    lead_frames : int
        Frames exposed before the first position that was asked for.
    """

    positions_um: tuple[float, ...]
    lead_frames: int = 0

    @property
    def frames(self) -> int:
        """Frames from the first pulse to the last."""
        return len(self.positions_um) - 1
