"""Planes shown one by one in step with a mirror that moves: a volume in space, without glasses. Pure arithmetic.

A mirror that bulges to and fro throws the picture of a screen to a depth that follows its movement (Rawson 1968, Appl.
Opt. 7, 1505; Sher 1978). A plane is drawn in the frame during which the mirror passes its depth, on the way out and on
the way back; frames in which it passes none stay dark. Where the mirror is follows from its sync pulses, one for each
period, on a line as refreshes are (`display.pacing.Beat`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from devices.errors import DisplayError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from display.pacing import Beat

    Array = NDArray[np.float64]

Waveform = Literal["sine", "triangle", "sawtooth"]
LEAST_VOLUMES_HZ = 30.0
FLYBACK = 0.1  # of a sawtooth's period: the way back, on which nothing is shown


@dataclass(frozen=True)
class Mirror:
    """How the depth of the picture moves.

    Attributes
    ----------
    hz : float
        Periods a second.
    reach_um : float
        Greatest depth either way from the middle.
    waveform : {"sine", "triangle", "sawtooth"}
        From the sync pulse on: up through the middle; up from the lowest; up from the lowest, and back in a tenth.
    lag : float
        How much later than its pulse the mirror is there, as a share of a period.
    """

    hz: float
    reach_um: float
    waveform: Waveform = "sine"
    lag: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.hz) and self.hz > 0 and math.isfinite(self.reach_um) and self.reach_um > 0):
            raise DisplayError(f"no mirror moves {self.hz:g} times a second by {self.reach_um:g} µm.", code="sweep")
        if self.volumes_hz < LEAST_VOLUMES_HZ:
            raise DisplayError(
                f"a mirror at {self.hz:g} Hz shows {self.volumes_hz:g} volumes a second; they flicker below "
                f"{LEAST_VOLUMES_HZ:g}.",
                fix=f"run it at {self.hz * LEAST_VOLUMES_HZ / self.volumes_hz:g} Hz or more.",
                code="sweep",
            )

    @property
    def passes(self) -> int:
        """How often in a period each depth is passed with something to be shown."""
        return 1 if self.waveform == "sawtooth" else 2

    @property
    def volumes_hz(self) -> float:
        """Volumes a second."""
        return self.hz * self.passes

    def depth_um(self, phase: Array) -> Array:
        """Return the depth at phases of a period, counted from the sync pulse."""
        p = np.mod(np.asarray(phase, np.float64) - self.lag, 1.0)
        if self.waveform == "sine":
            return self.reach_um * np.sin(2 * np.pi * p)
        rise = 0.5 if self.waveform == "triangle" else 1 - FLYBACK
        return self.reach_um * np.where(p < rise, 2 * p / rise - 1, 1 - 2 * (p - rise) / (1 - rise))

    def crossings(self, depths_um: Array) -> Array:
        """Return the phases, (passes, planes), at which each depth is passed, on the way up and on the way down."""
        share = np.asarray(depths_um, np.float64) / self.reach_um
        if self.waveform == "sine":
            up = np.arcsin(share) / (2 * np.pi)
            both = np.stack([up, 0.5 - up])
        else:
            up = (share + 1) / 2 * (0.5 if self.waveform == "triangle" else 1 - FLYBACK)
            both = np.stack([up, 1 - up])[: self.passes]
        return np.asarray(np.mod(both + self.lag, 1.0))


@dataclass(frozen=True, eq=False)
class Sweep:
    """Which plane is due when.

    Attributes
    ----------
    mirror : Mirror
    depths_um : array (planes,)
        Of the planes; all within the mirror's reach.
    frame_s : float
        How long a frame is lit.

    Raises
    ------
    DisplayError
        ``sweep``: planes out of reach, or passed faster than one a frame.
    """

    mirror: Mirror
    depths_um: Array
    frame_s: float

    def __post_init__(self) -> None:
        depths = np.asarray(self.depths_um, np.float64)
        if depths.ndim != 1 or not len(depths) or not np.all(np.abs(depths) < self.mirror.reach_um):
            raise DisplayError(
                f"the planes do not lie within ± {self.mirror.reach_um:g} µm.",
                fix="a mirror that moves farther, or planes nearer to each other.",
                code="sweep",
            )
        if len(depths) > 1 and self.frame_s > self.shortest_s * (1 + 1e-9):
            raise DisplayError(
                f"{len(depths)} planes are passed every {self.shortest_s * 1e3:.3g} ms; a frame lasts "
                f"{self.frame_s * 1e3:.3g} ms.",
                fix=f"at most {self.most_planes()} evenly spaced planes, or a display of {1 / self.shortest_s:.0f} Hz.",
                code="sweep",
            )

    @cached_property
    def timetable(self) -> tuple[Array, NDArray[np.intp]]:
        """Phases in order, and the plane that is passed at each."""
        phases = self.mirror.crossings(self.depths_um)
        planes = np.broadcast_to(np.arange(len(self.depths_um)), phases.shape).ravel()
        order = np.argsort(phases.ravel())
        return phases.ravel()[order], planes[order]

    @cached_property
    def shortest_s(self) -> float:
        """Shortest time between two different planes."""
        phases, planes = self.timetable
        gaps = np.diff(np.append(phases, phases[0] + 1))
        differ = planes != np.roll(planes, -1)  # the outermost plane is passed twice in a row
        return float(gaps[differ].min()) / self.mirror.hz if differ.any() else math.inf

    @property
    def blur_um(self) -> Array:
        """How far the mirror moves while each plane is lit, (planes,)."""
        phases = self.mirror.crossings(self.depths_um)
        half = self.frame_s * self.mirror.hz / 2
        travel = np.abs(self.mirror.depth_um(phases + half) - self.mirror.depth_um(phases - half))
        return np.asarray(travel.max(axis=0))

    def due(self, beat: Beat, begin_s: float) -> int | None:
        """Return the plane for the frame that begins then: the one whose depth is passed during it; None is dark.

        Parameters
        ----------
        beat : Beat
            Of the mirror's sync pulses.
        begin_s : float
            When the frame is lit.
        """
        phases, planes = self.timetable
        begin = (begin_s - beat.time_of(beat.begun(begin_s))) / beat.period_s
        ahead = np.mod(phases - begin, 1.0)
        nearest = int(np.argmin(ahead))
        return int(planes[nearest]) if ahead[nearest] < self.frame_s / beat.period_s else None

    def most_planes(self) -> int:
        """Return how many evenly spaced planes within the same depths could be shown."""
        low, high = float(np.min(self.depths_um)), float(np.max(self.depths_um))

        def too_many(count: int) -> bool:
            up = np.sort(np.mod(self.mirror.crossings(np.linspace(low, high, count))[0] - self.mirror.lag + 0.25, 1.0))
            return bool(np.diff(up).min() / self.mirror.hz < self.frame_s)

        counts = range(2, len(self.depths_um) + 1)
        return 1 + bisect_left(counts, True, key=too_many)  # noqa: FBT003  the first that is too many


def even_planes(count: int, mirror: Mirror, share: float = 0.9) -> Array:
    """Return depths of planes evenly spaced over a share of the mirror's reach."""
    return np.linspace(-share, share, count) * mirror.reach_um if count > 1 else np.zeros(1)
