"""Which eye's turn it is: from the number of the display's refresh, never from a toggle. Pure arithmetic on times.

A swap takes effect at the next refresh. A program that alternates eyes at each swap has them exchanged for good after a
single late frame; here the number of the refresh decides, so that a late frame costs the refreshes it was late by and
no more. Numbers come from the times at which swaps returned: they lie on a line, and the line is followed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import DisplayError
from devices.glasses_timing import Edge

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from devices.glasses_timing import Eye

LEAST_HZ = 96.0  # 48 pictures a second for each eye: below, everybody sees flicker
SELDOM = 0.3  # share of swaps that must have returned one refresh after the one before
NEAR_S = 0.6e-3  # a swap that returned farther from a refresh tells of the computer, not of the display
GUARD_S = 0.6e-3  # a swap so shortly before a refresh may fall on either side of it
PHASE_GAIN, PERIOD_GAIN = 0.1, 0.002
STRAYS = 24  # more swaps near no refresh than twice those near one: the display runs differently now


@dataclass(frozen=True)
class Beat:
    """The display's refreshes as a line: number ``number`` began at ``at_s``, the others every ``period_s``."""

    at_s: float
    period_s: float
    number: int = 0

    def begun(self, now_s: float) -> int:
        """Return the number of the refresh that lasts at that time."""
        return self.number + math.floor((now_s - self.at_s) / self.period_s)

    def nearest(self, now_s: float) -> int:
        """Return the number of the refresh that began, or will begin, nearest to that time."""
        return self.number + round((now_s - self.at_s) / self.period_s)

    def time_of(self, number: int) -> float:
        """Return when a refresh begins."""
        return self.at_s + (number - self.number) * self.period_s

    def followed(self, at_s: float) -> Beat:
        """Return the line drawn a little nearer to a refresh seen at that time."""
        number = self.nearest(at_s)
        off_s = at_s - self.time_of(number)
        here_s = self.time_of(number) + PHASE_GAIN * off_s
        return Beat(here_s, self.period_s + PERIOD_GAIN * off_s, number)


def measured_beat(returns_s: Sequence[float], named_hz: float) -> Beat:
    """Return the refreshes of a display from the times at which swaps in a row returned, each waiting for a refresh.

    Raises
    ------
    DisplayError
        ``no-vsync``: they did not wait for the display; ``refresh-too-slow``: see `check_rate`.
    """
    times = np.asarray(returns_s, np.float64)
    turns = np.rint(np.diff(times) * named_hz)
    if np.mean(turns == 1) < SELDOM:
        raise _not_waited(named_hz, times)
    numbers = np.concatenate([[0.0], np.cumsum(turns)])
    period_s = float(np.polyfit(numbers, times - times[0], 1)[0])
    check_rate(1 / period_s)
    return Beat(float(np.median(times - numbers * period_s)), period_s)


def _not_waited(named_hz: float, times: NDArray[np.float64]) -> DisplayError:
    changed_hz = (len(times) - 1) / max(times[-1] - times[0], 1e-6)
    return DisplayError(
        f"the display says {named_hz:g} Hz, but pictures changed {changed_hz:.0f} times a second.",
        why="The driver does not wait for the display, a compositor stands between, or the computer is too busy.",
        fix=(
            "switch vertical synchronisation on in the driver.",
            "show full screen: without --window.",
            "close what else works on this computer.",
        ),
        code="no-vsync",
    )


def check_rate(refresh_hz: float) -> None:
    """Raise `DisplayError` (refresh-too-slow) for a display that is too slow for two eyes in turn."""
    if refresh_hz >= LEAST_HZ:
        return
    shows = f"shows {refresh_hz:.4g} pictures a second" if refresh_hz > 0 else "does not say how often it is refreshed"
    raise DisplayError(
        f"the display {shows}; shutter glasses need {LEAST_HZ:g} times a second or more.",
        why="Each eye sees every other one: below 48 a second it flickers.",
        fix=("set the display to 120 Hz.", "see it without shutters: --stereo parallel, rows or anaglyph-grey"),
        code="refresh-too-slow",
    )


@dataclass(frozen=True)
class Turn:
    """What has to be swapped in next.

    Attributes
    ----------
    number : int
        The refresh at which it will be seen.
    eye : str
        Whose picture that is.
    not_before_s : float
        An earlier swap might be seen one refresh too soon.
    """

    number: int
    eye: Eye
    not_before_s: float


@dataclass(frozen=True)
class PaceReport:
    """What became of the refreshes.

    Attributes
    ----------
    refreshes, flips : int
        How many passed, and how many of them brought a new picture.
    late : int
        Flips that were seen later than meant.
    wrong_eye, longest_wrong : int
        Refreshes in which the picture was not that of the refresh's eye, and the most of them in a row.
    redrawn : int
        Pictures replaced before they were swapped in, for they had become too late for their eye.
    strays : int
        Swaps that returned when the display was nowhere near a refresh: the computer was busy.

    Notes
    -----
    Of a swap that returned late, but by chance at a refresh, it cannot be told whether the picture was late or the
    program: it is counted as late. So ``late``, ``wrong_eye`` and ``longest_wrong`` are what it was at worst.
    """

    refreshes: int = 0
    flips: int = 0
    late: int = 0
    wrong_eye: int = 0
    longest_wrong: int = 0
    redrawn: int = 0
    strays: int = 0


@dataclass
class Pacer:
    """Gives the turns and keeps the books; knows no clock but the times it is told.

    Parameters
    ----------
    beat : Beat
        The display's.
    swap : bool
        The odd refreshes are the left eye's, instead of the even ones.
    """

    beat: Beat
    swap: bool = False
    report: PaceReport = field(default_factory=PaceReport)
    _shown: Turn | None = None
    _wrong_run: int = 0
    _astray: int = 0

    def eye_of(self, number: int) -> Eye:
        """Return whose refresh that is."""
        return "right" if (number + self.swap) % 2 else "left"

    def upcoming(self, now_s: float) -> Turn:
        """Return the turn that a swap from now on can serve."""
        number = self.beat.begun(now_s + GUARD_S) + 1
        return Turn(number, self.eye_of(number), self.beat.time_of(number - 1))

    def redrawn(self) -> None:
        """Count a picture that was replaced before its swap."""
        self.report = replace(self.report, redrawn=self.report.redrawn + 1)

    def flipped(self, turn: Turn, returned_s: float) -> Edge:
        """Take note of a swap that returned, follow the display, and return what is now shown since when."""
        seen = self._landed(turn, returned_s)
        if self._shown is not None:
            self._keep_books(turn, seen)
        self._shown = replace(turn, number=seen)
        return Edge(round(self.beat.time_of(seen) * 1e9), turn.eye)

    @property
    def lost(self) -> bool:
        """Whether the display does not keep to the beat any more; measure it anew."""
        return self._astray >= STRAYS

    def left_flip_s(self) -> float:
        """Return when a refresh of the left eye began, a recent one."""
        number = self.beat.number
        return self.beat.time_of(number if self.eye_of(number) == "left" else number - 1)

    def _landed(self, turn: Turn, returned_s: float) -> int:
        """Return the refresh at which a picture came to be seen; follow the display where the return tells of it."""
        nearest = self.beat.nearest(returned_s)
        stray = abs(returned_s - self.beat.time_of(nearest)) > NEAR_S
        self._astray = self._astray + 1 if stray else max(self._astray - 2, 0)
        if stray:
            self.report = replace(self.report, strays=self.report.strays + 1)
            return turn.number
        self.beat = self.beat.followed(returned_s)
        return max(nearest, turn.number)

    def _keep_books(self, turn: Turn, seen: int) -> None:
        assert self._shown is not None
        before = self._shown
        for number in range(before.number + 1, seen):
            self._count(before.eye, number)
        self._count(turn.eye, seen)
        self.report = replace(
            self.report,
            refreshes=self.report.refreshes + seen - before.number,
            flips=self.report.flips + 1,
            late=self.report.late + (seen > before.number + 1),
        )

    def _count(self, eye: Eye, number: int) -> None:
        wrong = eye != self.eye_of(number)
        self._wrong_run = self._wrong_run + 1 if wrong else 0
        self.report = replace(
            self.report,
            wrong_eye=self.report.wrong_eye + wrong,
            longest_wrong=max(self.report.longest_wrong, self._wrong_run),
        )
