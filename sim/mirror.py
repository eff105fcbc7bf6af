"""A varifocal mirror: where it really throws the picture, and the sync pulses it gives."""

from __future__ import annotations

import math

import numpy as np


class SimMirror:
    """A mirror that swings as a sine, not quite at the rate it was told.

    Parameters
    ----------
    hz, reach_um : float
        As it was told.
    off_ppm : float
        By how much it is slower.
    lag_s : float
        How much later than its pulse it passes the middle.
    jitter_s : float
        Spread of its pulses, evenly.
    wander : float
        By how much its reach changes, as a share, over some seconds.
    """

    def __init__(
        self,
        hz: float,
        reach_um: float,
        *,
        off_ppm: float = 0.0,
        lag_s: float = 0.0,
        jitter_s: float = 0.0,
        wander: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.period_s = (1 + off_ppm / 1e6) / hz
        self._reach_um = reach_um
        self._lag_s = lag_s
        self._jitter_s = jitter_s
        self._wander = wander
        self._chance = np.random.default_rng(seed)

    def depth_um(self, at_s: float) -> float:
        """Return where the picture is."""
        reach = self._reach_um * (1 + self._wander * math.sin(at_s * 1.3))
        return reach * math.sin(2 * math.pi * (at_s - self._lag_s) / self.period_s)

    def pulse_s(self, number: int) -> float:
        """Return when a sync pulse arrives."""
        return number * self.period_s + self._jitter_s * float(self._chance.uniform(-0.5, 0.5))
