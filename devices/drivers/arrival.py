"""When a stage has arrived: the rule every driver of a polled axis follows."""

from __future__ import annotations

from typing import ClassVar


class Arrival:
    """Judges successive readings of a position.

    An axis rests when its controller says so and two readings in a row, at least ``AGREE_S`` apart, lie within the
    tolerance of the target (of each other, when there is no target). It is stalled when no reading came closer to
    anywhere than the tolerance for ``STALL_S``.

    Parameters
    ----------
    target_um : float or None
        Where it was sent.
    tolerance_um : float
        Resolution of the readings.
    now : float
        Time of the start in seconds.
    """

    AGREE_S: ClassVar = 0.010
    STALL_S: ClassVar = 1.0
    ROUNDING: ClassVar = 1.001
    SHORTEST_S: ClassVar = 1e-4  # a wait of less may be lost in the rounding of a clock's time

    def __init__(self, target_um: float | None, *, tolerance_um: float, now: float) -> None:
        self._target_um = target_um
        self._tolerance_um = tolerance_um * self.ROUNDING
        self._candidate: tuple[float, float] | None = None
        self._progress: tuple[float, float] | None = None
        self._started = now

    def reached(self, z_um: float, now: float, *, moving: bool) -> bool:
        """Take one reading and tell whether the axis rests."""
        self._watch_progress(z_um, now)
        if moving or not self._near(z_um, self._target_um):
            self._candidate = None
            return False
        if self._candidate is None or not self._near(z_um, self._candidate[0]):
            self._candidate = (z_um, now)
            return False
        return now - self._candidate[1] >= self.AGREE_S

    def stalled(self, now: float) -> bool:
        """Tell whether there was no progress for ``STALL_S``; not while a good reading waits to be confirmed."""
        if self._candidate is not None:
            return False
        since = self._progress[1] if self._progress else self._started
        return now - since >= self.STALL_S

    def wait_s(self, now: float, poll_s: float) -> float:
        """Return how long to wait for the next reading: until it can confirm a first good one, else ``poll_s``."""
        return poll_s if self._candidate is None else max(self.SHORTEST_S, self._candidate[1] + self.AGREE_S - now)

    def _near(self, z_um: float, other_um: float | None) -> bool:
        return other_um is None or abs(z_um - other_um) <= self._tolerance_um

    def _watch_progress(self, z_um: float, now: float) -> None:
        if self._progress is None or abs(z_um - self._progress[0]) > self._tolerance_um:
            self._progress = (z_um, now)
