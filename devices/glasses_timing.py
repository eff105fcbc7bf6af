"""When shutters opened against when pictures were shown: pure arithmetic on two lists of edges.

A flip is the moment from which a picture for one eye is on the display; an edge is the moment at which the shutter of
one eye was told to open (and the other to close). Times are CLOCK_MONOTONIC nanoseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Eye = Literal["left", "right"]
FEWEST = 8
FOLLOWED = 0.1  # share of a turn's lateness by which the next one is expected later
PPM = 1e6


def other(eye: Eye) -> Eye:
    """Return the other eye."""
    return "right" if eye == "left" else "left"


@dataclass(frozen=True)
class Edge:
    """One eye's turn begins: the shutter told to open, or the picture shown."""

    at_ns: int
    eye: Eye


@dataclass(frozen=True)
class Lock:
    """One start of a free run.

    Attributes
    ----------
    refresh_hz : float
        Turns a second, of both eyes together.
    left_s : float
        When the left eye's turn began, CLOCK_MONOTONIC seconds.
    uncertainty_s : float
        By how much that may be wrong, either way: half of what its exchange took longer than the quickest.
    """

    refresh_hz: float
    left_s: float
    uncertainty_s: float = 0.0

    def phase_s(self, left_flip_s: float) -> float:
        """Return how far a flip of the left eye is from a turn of the left eye, within half a cycle of two turns."""
        return math.remainder(left_flip_s - self.left_s, 2 / self.refresh_hz)


@dataclass(frozen=True)
class EyewearTiming:
    """What a driver sent, and when.

    Attributes
    ----------
    edges : tuple of Edge
        The latest turns given one by one by the host, oldest first; a device that runs free by itself adds none.
    sent : int
        How many there were since the device was opened.
    locks : tuple of Lock
        The latest starts of a free run, oldest first.
    locked : bool
        Whether a free run is known to go on as the last of ``locks`` says.
    latency_s : float
        From the host's call to the device, as far as the driver can know it.
    """

    edges: tuple[Edge, ...] = ()
    sent: int = 0
    locks: tuple[Lock, ...] = ()
    locked: bool = False
    latency_s: float = 0.0


def turns_of(timing: EyewearTiming, until_s: float, *, delay_s: float = 0.0) -> list[Edge]:
    """Return when each eye was told to open, as far as the driver knows: given one by one, or counted from each lock.

    Parameters
    ----------
    timing : EyewearTiming
        What was sent.
    until_s : float
        End of the last free run, CLOCK_MONOTONIC seconds.
    delay_s : float
        From the turn to the opening of the shutter.
    """
    ends_s = [lock.left_s for lock in timing.locks[1:]] + [until_s]
    counted = [edge for lock, end_s in zip(timing.locks, ends_s, strict=False) for edge in _counted(lock, end_s)]
    told = sorted([*timing.edges, *counted], key=lambda edge: edge.at_ns)
    return [Edge(edge.at_ns + round(delay_s * 1e9), edge.eye) for edge in told]


def _counted(lock: Lock, end_s: float) -> list[Edge]:
    eyes: tuple[Eye, Eye] = ("left", "right")
    count = max(math.floor((end_s - lock.left_s) * lock.refresh_hz + 0.5), 0)
    return [Edge(round((lock.left_s + n / lock.refresh_hz) * 1e9), eyes[n % 2]) for n in range(count)]


@dataclass(frozen=True)
class PhaseReport:
    """How well the shutters kept to the pictures.

    Attributes
    ----------
    period_s : float
        From flip to flip.
    edges, flips : int
        How many were compared.
    bias_ms, rms_ms, p95_ms, p99_ms, max_ms : float
        Of the phase edge - flip - delay; bias is signed, the others are of its magnitude.
    jitter_p99_ms : float
        As p99, after a line was fitted to the edges' times: what is left without drift and without bias.
    drift_ppm : float
        By how much the edges' period is longer than the flips'.
    missed, duplicated : int
        Flips with no edge, and edges beyond the first at a flip.
    alternation_faults : int
        Edges of the other eye than the flip they belong to.
    crosstalk : float
        Share of the time of open shutters during which the picture was the other eye's.
    """

    period_s: float
    edges: int
    flips: int
    bias_ms: float
    rms_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float
    jitter_p99_ms: float
    drift_ppm: float
    missed: int
    duplicated: int
    alternation_faults: int
    crosstalk: float

    @property
    def beat_s(self) -> float:
        """Time in which the drift carries the shutters once through both eyes' turns; infinite without drift."""
        per_s = abs(self.drift_ppm) / PPM
        return 2 * self.period_s / per_s if per_s else math.inf


def phase_report(
    edges: Sequence[Edge], flips: Sequence[Edge], *, delay_s: float = 0.0, open_s: float | None = None
) -> PhaseReport:
    """Compare shutters with pictures.

    Parameters
    ----------
    edges, flips : sequence of Edge
        In the order of time. Edges before the first flip less half a turn, and after the last one, are left out.
    delay_s : float
        How much later than its flip an edge is meant to be.
    open_s : float, optional
        How long a shutter stays open; None: until the other one opens.

    Raises
    ------
    InputError
        Fewer than 8 edges or flips to compare.
    """
    shown, told = _train(flips), _train(edges, delay_s)
    if len(shown.at_s) < FEWEST:
        raise _too_few(len(shown.at_s), "flips")
    period_s = period_of(shown.at_s)
    told = told.between(shown.at_s[0] - period_s / 2, shown.at_s[-1] + period_s / 2)
    if len(told.at_s) < FEWEST:
        raise _too_few(len(told.at_s), "edges")
    nearest = np.clip(np.searchsorted(shown.at_s, told.at_s - period_s / 2), 0, len(shown.at_s) - 1)
    met = np.bincount(nearest, minlength=len(shown.at_s))
    return PhaseReport(
        period_s=period_s,
        edges=len(told.at_s),
        flips=len(shown.at_s),
        **_spread_ms(told.at_s - shown.at_s[nearest]),
        jitter_p99_ms=float(np.percentile(np.abs(_residual_s(told.at_s)), 99)) * 1e3,
        drift_ppm=(period_of(told.at_s) / period_s - 1) * PPM,
        missed=int((met == 0).sum()),
        duplicated=int((met - 1).clip(0).sum()),
        alternation_faults=int((told.left != shown.left[nearest]).sum()),
        crosstalk=_crosstalk(told.later(delay_s), shown, period_s, open_s),
    )


@dataclass(frozen=True)
class _Train:
    """Turns as arrays: when each begins, in seconds, and whether it is the left eye's."""

    at_s: NDArray[np.float64]
    left: NDArray[np.bool_]

    def later(self, by_s: float) -> _Train:
        return _Train(self.at_s + by_s, self.left)

    def between(self, first_s: float, last_s: float) -> _Train:
        inside = (self.at_s >= first_s) & (self.at_s <= last_s)
        return _Train(self.at_s[inside], self.left[inside])


def _train(edges: Sequence[Edge], delay_s: float = 0.0) -> _Train:
    at_s = np.array([edge.at_ns for edge in edges], dtype=np.int64) / 1e9 - delay_s
    return _Train(at_s, np.array([edge.eye == "left" for edge in edges], dtype=bool))


def _spread_ms(phase_s: NDArray[np.float64]) -> dict[str, float]:
    size_ms = np.abs(phase_s) * 1e3
    return {
        "bias_ms": float(phase_s.mean()) * 1e3,
        "rms_ms": float(np.sqrt((size_ms**2).mean())),
        "p95_ms": float(np.percentile(size_ms, 95)),
        "p99_ms": float(np.percentile(size_ms, 99)),
        "max_ms": float(size_ms.max()),
    }


def period_of(times_s: NDArray[np.float64]) -> float:
    """Return the period of a train of times by least squares; gaps and doubles in the train do no harm."""
    return _line(times_s)[0]


def _residual_s(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    slope, offset = _line(times_s)
    residual: NDArray[np.float64] = times_s - times_s[0] - slope * _numbers(times_s) - offset
    return residual


def _line(times_s: NDArray[np.float64]) -> tuple[float, float]:
    slope, offset = np.polyfit(_numbers(times_s), times_s - times_s[0], 1)
    return float(slope), float(offset)


def _numbers(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Count the turns against where each is expected, so that one late turn does not count as two, nor none as one."""
    period_s = float(np.median(np.diff(times_s)))
    numbers, number, expected_s = [], 0, float(times_s[0])
    for at_s in times_s.tolist():
        turns = round((at_s - expected_s) / period_s)
        number += turns
        expected_s += turns * period_s
        expected_s += FOLLOWED * (at_s - expected_s)
        numbers.append(number)
    return np.array(numbers, dtype=np.float64)


def _crosstalk(told: _Train, shown: _Train, period_s: float, open_s: float | None) -> float:
    """Return the share of the open time in which the other eye's picture was shown.

    The time for which left pictures have been shown up to t is linear between flips; so the overlap of a window with
    left pictures is the difference of two interpolations.
    """
    ends_s = np.append(shown.at_s, shown.at_s[-1] + period_s)
    left_so_far_s = np.concatenate([[0.0], np.cumsum(np.diff(ends_s) * shown.left)])
    start_s = np.clip(told.at_s, ends_s[0], ends_s[-1])
    stop_s = np.append(told.at_s[1:], ends_s[-1])
    if open_s is not None:
        stop_s = np.minimum(stop_s, told.at_s + open_s)
    stop_s = np.clip(stop_s, start_s, ends_s[-1])
    with_left_s = np.interp(stop_s, ends_s, left_so_far_s) - np.interp(start_s, ends_s, left_so_far_s)
    window_s = stop_s - start_s
    wrong_s = np.where(told.left, window_s - with_left_s, with_left_s)
    return float(wrong_s.sum() / window_s.sum()) if window_s.sum() else 0.0


def _too_few(count: int, what: str) -> InputError:
    return InputError(f"glasses: {count} {what} are too few for statistics.", fix=f"take at least {FEWEST}.")
