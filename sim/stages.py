"""The twins of stage controllers by the name of the driver that talks to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from devices.errors import RigError, did_you_mean
from devices.values import Limits
from sim.motion import Axis

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.rig import AxisSpec

IDLE_AXES = Limits(-50_000.0, 50_000.0)


class Twin(Protocol):
    """A controller without wires."""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come and return the replies that are ready."""
        ...

    def power_cycle(self) -> None:
        """Be switched off and on: what was not saved is lost."""
        ...


@dataclass(frozen=True)
class StageKind:
    """How the twin of a driver is made, and what it says to bytes of another baud."""

    make: Callable[[Axis, AxisSpec], Twin]
    misheard: bytes = b""


class AsiTwin:
    """An ASI controller behind its power switch: at power-up it counts from where it stands."""

    def __init__(self, z: Axis, *, tiger: bool = False) -> None:
        self._tiger = tiger
        self._axes = {"X": Axis(z.clock, IDLE_AXES), "Y": Axis(z.clock, IDLE_AXES), "Z": z}
        self._saved = (z.speed_um_s, z.ramp_s, z.limits)
        self._switch_on()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and return replies."""
        return self._controller.feed(data)

    def ttl_in(self) -> None:
        """Take a pulse at the TTL input."""
        self._controller.ttl_in()

    def ttl_out_s(self) -> float | None:
        """Return when the TTL output rose last or will rise at the end of a move."""
        return self._controller.ttl_out_s()

    def power_cycle(self) -> None:
        """Stop, forget all settings, and count from here."""
        for axis in self._axes.values():
            axis.halt()
        z = self._axes["Z"]
        z.speed_um_s, z.ramp_s, z.limits = self._saved
        self._switch_on()
        self._controller.feed(b"Z\r")

    def _switch_on(self) -> None:
        from sim.controllers.asi import Ms2000  # noqa: PLC0415  only the twin in use is loaded
        from sim.controllers.asi_tiger import Tiger  # noqa: PLC0415

        self._controller = (Tiger if self._tiger else Ms2000)(self._axes)


def _ms2000(axis: Axis, _table: AxisSpec) -> Twin:
    return AsiTwin(axis)


def _tiger(axis: Axis, _table: AxisSpec) -> Twin:
    return AsiTwin(axis, tiger=True)


def _pi(axis: Axis, table: AxisSpec) -> Twin:
    from sim.controllers.pi_gcs import PiE709  # noqa: PLC0415

    if table.units_per_um < MILLIMETRES_PER_UM * 1.01:
        return PiE709.c863(axis)
    return PiE709(axis, axis_id=table.axis or "1", um_per_unit=1 / table.units_per_um)


def _prior(axis: Axis, table: AxisSpec) -> Twin:
    from sim.controllers.prior import ProScan  # noqa: PLC0415

    return ProScan(axis, step_um=1 / table.units_per_um)


MILLIMETRES_PER_UM = 0.001
KINDS = {
    "asi-ms2000": StageKind(_ms2000, misheard=b":N-1 \r\n"),
    "asi-tiger": StageKind(_tiger, misheard=b":N-1\r\n"),
    "pi-gcs2": StageKind(_pi),
    "prior-proscan": StageKind(_prior, misheard=b"E,5\r"),
}


def stage_kind(driver: str) -> StageKind:
    """Return the twin for a driver.

    Raises
    ------
    RigError
        There is none.
    """
    if driver not in KINDS:
        raise RigError(f"no simulated stage for the driver '{driver}'{did_you_mean(driver, list(KINDS))}")
    return KINDS[driver]
