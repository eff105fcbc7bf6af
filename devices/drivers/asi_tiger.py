"""Opens the Z axis of an ASI Tiger, whose cards have addresses of their own."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from devices.drivers.asi import BAUDS
from devices.drivers.asi_triggered import AsiTriggeredStage
from devices.drivers.polled import open_polled
from devices.errors import DeviceError, Refused
from devices.wire import asi
from devices.wire.asi_identity import tiger_card

if TYPE_CHECKING:
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec

DECIMALS = 2
COMM = "0 "


class TigerStage(AsiTriggeredStage):
    """An `AsiTriggeredStage` that asks the communication card which of the others drives Z."""

    def identity(self) -> str:
        """Return the firmware's name, of a Tiger that has a Z axis.

        Raises
        ------
        DeviceError
            It is none, or has none (device-unknown).
        """
        self._find_card()
        return super().identity()

    def _find_card(self) -> None:
        try:
            build = self._link.ask(asi.build(COMM))
        except Refused as refusal:  # an MS-2000 knows no addresses
            build = (refusal.what,)
        card = tiger_card(build)
        if card is None:
            raise DeviceError(
                "z stage: what answers is no Tiger with a Z axis.",
                why=f"It says: {build[0]}",
                fix='an MS-2000 has a driver of its own: set stage.z.driver = "asi-ms2000"',
                code="device-unknown",
            )
        self._card = card

    def _prepare(self) -> None:
        """Ask for finer positions than tenths of a µm as well; older firmware cannot, and need not."""
        with suppress(Refused):
            self._link.ask(asi.set_decimals(DECIMALS, self._card.address))
        super()._prepare()


def open_stage(table: AxisSpec, context: DeviceContext) -> TigerStage:
    """Open the port, ask the Tiger which card drives Z, and set the speed if the file gives one.

    Raises
    ------
    DeviceError
        As of `open_polled`, and device-unknown when what answers is no Tiger or has no Z.
    """
    return open_polled(
        table, context, lambda link: TigerStage(link, table, context.clock), terminator=asi.TERMINATOR, fix=BAUDS
    )
