"""How often the window is drawn while planes are taken: as often as costs the run nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

FULL_HZ, LEAST_HZ = 30.0, 1.0
SHARE = 0.1  # of a core; with a graphics processor a frame takes so little of one that 30 a second fit into it
FOLLOW = 0.2


class Thrift:
    """Watches what a frame costs, the looking at what is new included.

    Parameters
    ----------
    spent_s : callable
        Returns the processor time of this process so far, in s, that of all its threads.
    """

    def __init__(self, spent_s: Callable[[], float]) -> None:
        self._spent_s = spent_s
        self._before_s = spent_s()
        self._frame_s = 0.0

    def rate_hz(self) -> float:
        """Return how many frames a second take no more than `SHARE`; to be asked once in each."""
        now_s = self._spent_s()
        self._frame_s += FOLLOW * (now_s - self._before_s - self._frame_s)
        self._before_s = now_s
        return min(max(SHARE / max(self._frame_s, 1e-6), LEAST_HZ), FULL_HZ)
