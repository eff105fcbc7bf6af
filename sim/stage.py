"""The simulated axis as a plain stage: no wire, no controller, any clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.errors import StageStalled, StageTimeout

if TYPE_CHECKING:
    from devices.values import Limits
    from sim.motion import Axis

POLL_S = 0.01
STALL_S = 1.0
ARRIVED_UM = 0.05


class SimStage:
    """A `devices.protocols.Stage` upon an `Axis`."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._clock = axis.clock
        self._target_um: float | None = None

    @property
    def limits(self) -> Limits:
        """Soft limits in µm."""
        return self._axis.limits

    def move_to(self, z_um: float) -> None:
        """Start an absolute move; raises `LimitError` and does nothing for a target outside the limits."""
        self.limits.check(z_um)
        self._target_um = z_um
        self._axis.move_to(z_um)

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis neither moves nor rings and return where it is, in µm.

        Raises
        ------
        StageStalled
            It stands elsewhere than it was sent: blocked, or halted.
        StageTimeout
            Still moving after ``timeout_s``.
        """
        deadline = self._clock.now() + timeout_s
        while (left_s := self._axis.rests_at_s - self._clock.now()) > 0:
            if self._clock.now() >= deadline:
                raise StageTimeout(
                    f"z stage: still moving after {timeout_s:g} s; it is at {self.position_um():+.2f} µm."
                )
            self._clock.sleep(min(left_s, POLL_S))
        return self._arrived()

    def position_um(self) -> float:
        """Return the encoder's position in µm."""
        return self._axis.encoder_um()

    def halt(self) -> None:
        """Brake to rest."""
        self._axis.halt()

    def close(self) -> None:
        """Nothing to release."""

    def _arrived(self) -> float:
        z_um = self.position_um()
        if self._target_um is not None and abs(z_um - self._target_um) > ARRIVED_UM:
            if self._axis.moving():
                self._clock.sleep(STALL_S)
            raise StageStalled(f"z stage: stopped at {z_um:+.2f} µm on the way to {self._target_um:+.2f} µm.")
        return z_um
