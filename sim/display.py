"""A display on simulated time: refreshes, swaps that wait for them, and a computer that is late now and then."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.glasses_timing import Edge

if TYPE_CHECKING:
    from devices.glasses_timing import Eye
    from devices.protocols import Clock

DRAW_S = 0.8e-3
RETURN_JITTER_S = 0.3e-3


class SimDisplay:
    """What `display.presenter.Screen` asks for, and the truth about what was seen.

    Parameters
    ----------
    clock : Clock
        Simulated.
    refresh_hz : float
        As the display names it.
    off_ppm : float
        By how much its refreshes are farther apart than that.
    late_share : float
        Share of the pictures at which the computer is held up for up to two and a half refreshes: while it draws, or
        after the picture was swapped in.
    seed : int
        Of what happens by chance.

    Attributes
    ----------
    waits : bool
        Whether a swap waits for a refresh; False as without vertical synchronisation.
    """

    def __init__(
        self, clock: Clock, refresh_hz: float = 120.0, *, off_ppm: float = 0.0, late_share: float = 0.0, seed: int = 0
    ) -> None:
        self._clock = clock
        self._begin_s = clock.now() + 1e-3
        self._chance = np.random.default_rng(seed)
        self.refresh_hz = refresh_hz
        self.period_s = (1 + off_ppm / 1e6) / refresh_hz
        self.late_share = late_share
        self.waits = True
        self.hold_ups = 0
        self._drawn: Eye | None = None
        self._shown: list[tuple[int, Eye | None]] = []

    def draw(self, turn: Any) -> None:
        """Draw the picture of ``turn.eye``, or darkness for None."""
        self._drawn = None if turn is None else turn.eye
        self._clock.sleep(DRAW_S + (self._held_up_s() if self._chance.random() < self.late_share / 2 else 0.0))

    def swap(self) -> None:
        """Show what was drawn from the next refresh on."""
        if not self.waits:
            self._clock.sleep(DRAW_S)
            return
        number = math.floor((self._clock.now() - self._begin_s) / self.period_s) + 1
        self._shown.append((number, self._drawn))
        self._clock.sleep(self.time_of(number) - self._clock.now() + RETURN_JITTER_S * self._chance.random())
        if self._chance.random() < self.late_share / 2:
            self._clock.sleep(self._held_up_s())

    def time_of(self, number: int) -> float:
        """Return when a refresh begins."""
        return self._begin_s + number * self.period_s

    def flips(self) -> list[Edge]:
        """Return since when whose picture was seen, darkness left out."""
        return [Edge(round(self.time_of(number) * 1e9), eye) for number, eye in self._shown if eye is not None]

    def seen(self) -> list[tuple[int, Eye]]:
        """Return for every refresh, from the first that was not dark, whose picture was seen."""
        found: list[tuple[int, Eye]] = []
        ends = [number for number, _ in self._shown[1:]] + [self._shown[-1][0] + 1]
        for (number, eye), end in zip(self._shown, ends, strict=True):
            if eye is not None:
                found += [(k, eye) for k in range(number, end)]
        return found

    def _held_up_s(self) -> float:
        self.hold_ups += 1
        return self.period_s * float(self._chance.uniform(0.5, 2.5))


def longest_wrong(seen: list[tuple[int, Eye]], *, even: Eye = "left") -> tuple[int, int]:
    """Return in how many refreshes the picture was not that of their number's eye, and the most in a row."""
    wrong = [(eye == even) == bool(number % 2) for number, eye in seen]
    longest = run = 0
    for bad in wrong:
        run = run + 1 if bad else 0
        longest = max(longest, run)
    return sum(wrong), longest
