"""What a frame carries through the ring to every reader: its pixels and where, when and for which plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class FrameHeader:
    """Everything known about one frame beside its pixels.

    Attributes
    ----------
    plane : int
        Index of the planned plane, counted from 0 within its section.
    section, band, attempt : int
        Section of the specimen or point in time, band within it, and how often this plane was exposed before.
    setpoint_um, z_um : float
        Where the stage was sent, and where it was read back at rest before the exposure.
    exposure_ms : float
        Exposure asked for.
    exposure_start_ns, exposure_end_ns, arrival_ns : int
        CLOCK_MONOTONIC; 0 where the camera cannot tell.
    utc_ns : int
        Wall-clock time of the arrival.
    hw_id : int
        The camera's own frame counter, -1 without one.
    crc32 : int
        zlib.crc32 of the pixels, 0 when not computed yet.
    """

    plane: int
    setpoint_um: float
    z_um: float
    exposure_ms: float
    exposure_start_ns: int = 0
    exposure_end_ns: int = 0
    arrival_ns: int = 0
    utc_ns: int = 0
    section: int = 0
    attempt: int = 0
    hw_id: int = -1
    crc32: int = 0
    band: int = 0


@dataclass(frozen=True)
class Frame:
    """A frame as a reader sees it. ``pixels`` is read-only, (height, width[, bands]) uint8 or uint16."""

    number: int
    header: FrameHeader
    pixels: np.ndarray


@dataclass(frozen=True)
class Missed:
    """A plane that could not be taken: it keeps its place and says why."""

    plane: int
    reason: str
    section: int = 0
    band: int = 0
