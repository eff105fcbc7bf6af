"""A move by hand: sent, waited for as long as the slowest sensible speed takes, and read back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from devices.protocols import Stage
    from devices.rig import AxisSpec

SLOWEST_UM_S = 10.0
LEAST_TIMEOUT_S = 10.0


@runtime_checkable
class CanZero(Protocol):
    """A stage whose controller can call the present place zero."""

    def zero_here(self) -> None:
        """Call the present place 0 µm."""
        ...


def travel(stage: Stage, table: AxisSpec, to_um: float) -> float:
    """Move to a position in µm, wait until the axis rests there, and return where it rests.

    Raises
    ------
    LimitError
        Outside the soft limits; nothing was sent.
    DeviceError
        It stalled, was halted, or is too slow.
    """
    way_um = abs(to_um - stage.position_um())
    stage.move_to(to_um)
    return stage.settle(LEAST_TIMEOUT_S + way_um / (table.speed_um_s or SLOWEST_UM_S))
