"""The lamp: as bright as it ought to be, unless a fault says otherwise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sim.faults import Faults

TOO_BRIGHT = 4.0
PERCENT = 100


class Lamp:
    """Call it for the brightness during one exposure: 1 as a rule.

    ``lamp.bright`` drives most of a picture into saturation, ``lamp.flicker@N%`` spreads it by so much around 1.
    """

    def __init__(self, faults: Faults, *, seed: int = 0) -> None:
        self._faults = faults
        self._rng = np.random.default_rng(seed)

    def __call__(self) -> float:
        """Return the brightness."""
        level = 1.0 if self._faults.number("lamp.bright") is None else TOO_BRIGHT
        spread = (self._faults.number("lamp.flicker") or 0.0) / PERCENT
        return max(0.0, level * (1 + spread * float(self._rng.normal())) if spread else level)
